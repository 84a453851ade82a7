#include "rasterize.h"

#include "blending.h"

namespace splatax {
namespace {

// Draws channels [first, first + size); with the first ones, alpha.
template <int C>
void draw_group(const Input& input, const Image& image, int first, int size, Workers& workers,
                Scratch& scratch) {
  Binning& binning = scratch.binning;
  binning.load_channels(input, first, size, workers);
  TileStates<TileImage<C>> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, TileImage<C>& state) {
      if (round.begin == 0) state.clear(input, tile);
      state.blend(tile, [](const Blend&) {});
      if (round.end < binning.visible) return;
      each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
        float* sums = image.sums + pixel * input.channel_count + first;
        for (int c = 0; c < size; ++c) sums[c] = state.sums[c][b][lane];
        const float T = state.transmittance[b][lane];
        if (first == 0) image.alpha[pixel] = 1 - (T < 0 ? -T : T);
      });
    });
  });
}

}  // namespace

void rasterize(const Input& input, const Image& image, Workers& workers, Scratch& scratch,
               int64_t max_pairs) {
  scratch.binning.collect(input, workers, max_pairs);
  each_group(input.channel_count, [&](int first, int size) {
    const auto draw = size == 3 ? draw_group<3> : draw_group<GROUP>;
    draw(input, image, first, size, workers, scratch);
  });
}

}  // namespace splatax
