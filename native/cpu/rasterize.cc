#include "rasterize.h"

#include "blending.h"
#include "wide.h"

namespace splatax {
namespace {

// Draws one part of the channels; with the first part, alpha.
template <int W>
void draw_part(const Input& input, const Image& image, Part part, Workers& workers, Scratch& scratch) {
  Binning& binning = scratch.binning;
  TileStates<WideImage<W>> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, WideImage<W>& state) {
      if (round.begin == 0) state.clear(input, tile, part);
      state.blend(input, tile, part);
      if (round.end < binning.visible) return;
      each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
        float* sums = image.sums + pixel * input.channel_count + part.first;
        for (int c = 0; c < part.size; ++c) sums[c] = state.sums[b][c][lane];
        const float T = state.transmittance[b][lane];
        if (part.first == 0) image.alpha[pixel] = 1 - (T < 0 ? -T : T);
      });
    });
  });
}

}  // namespace

void rasterize(const Input& input, const Image& image, Workers& workers, Scratch& scratch,
               int64_t max_pairs) {
  scratch.binning.collect(input, workers, pairs_in_round(input, max_pairs));
  if (input.channel_count <= GROUP) {
    const auto draw = input.channel_count == 3 ? draw_tiles<3> : draw_tiles<GROUP>;
    return draw(input, image, input.channel_count, workers, scratch);
  }
  const int width = walk_width(input, scratch.binning, max_pairs);
  const auto draw = width == WIDE_WALK ? draw_part<WIDE_WALK> : draw_part<NARROW_WALK>;
  each_part_of_channels(input, width, [&](Part part) { draw(input, image, part, workers, scratch); });
}

}  // namespace splatax
