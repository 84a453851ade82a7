#include "rasterize.h"

#include "blending.h"
#include "tiles.h"

namespace splatax {
namespace {

// Draws channels [first, first + size); with the first ones, alpha.
template <int C>
void draw_group(const Input& input, const Image& image, int first, int size, Workers& workers,
                Scratch& scratch) {
  Binning& binning = scratch.binning;
  binning.load_channels(input, first, size, workers);
  TileStates<TileImage<C>> states(binning, scratch);
  for (size_t number = 0; number < binning.rounds.size(); ++number) {
    const Round round = binning.rounds[number];
    binning.list(static_cast<int>(number), workers);
    workers.each(binning.tiles(), [&](int tile) {
      const int left = binning.left(tile), top = binning.top(tile), begin = binning.starts[tile];
      TileImage<C> local, &state = states.of(tile, local);
      if (round.begin == 0) state.clear(input.width, input.height, left, top);
      const Pair* list = binning.pairs.get() + begin;
      state.blend(binning.splats.get(), list, binning.starts[tile + 1] - begin, left, top);
      if (round.end < binning.visible) return;
      each_pixel(input, left, top, [&](int b, int lane, size_t pixel) {
        float* sums = image.sums + pixel * input.channel_count + first;
        for (int c = 0; c < size; ++c) sums[c] = state.sums[c][b][lane];
        const float T = state.transmittance[b][lane];
        if (first == 0) image.alpha[pixel] = 1 - (T < 0 ? -T : T);
      });
    });
  }
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
