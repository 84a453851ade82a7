// Image of a tile: its splats blended front to back.
//
//   C = sum_i T_i alpha_i c_i,   T_i = prod_{j<i} (1 - alpha_j)         (Kerbl et al. 2023, Eq. 3)
#pragma once

#include "tiles.h"

namespace splatax {

// State of a tile, block by block, between rounds and at the end. `Shapes` tells the effect and the channels of the
// splats of a chunk.
template <int C, class Shapes = Ellipses<C>>
struct TileImage {
  // Negated for a pixel that is finished or outside the image.
  alignas(64) float transmittance[BLOCKS][LANES];
  alignas(64) float sums[C][BLOCKS][LANES];

  void clear(const Input& input, const Tile& tile) {
    for (auto& channel : sums) std::memset(channel, 0, sizeof channel);
    let_light_through(input, tile, transmittance);
  }

  // Blends the tile's list, and calls count(step) for each splat at a block of pixels.
  template <class Count>
  void blend(const Input& input, const Tile& tile, const Count& count) {
    uint32_t live = live_blocks(transmittance);
    Shapes shapes;
    each_chunk<Shapes::CHANNELS>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first) {
      shapes.gather(input, tile, chunk, first);
      for (int b = 0; b < BLOCKS; ++b) {
        if ((live >> b & 1) && touching[b] && !blend_block(shapes, touching[b], b, tile, count)) {
          live &= ~(1u << b);
        }
      }
    });
  }

 private:
  // Blends the splats whose bits are set; returns false once all pixels of the block are finished.
  template <class Count>
  bool blend_block(const Shapes& shapes, uint64_t touching, int b, const Tile& tile, const Count& count) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    const Lanes before = load(transmittance[b]);
    Mask alive = broadcast(0) <= before;
    Lanes T = max(before, broadcast(0) - before);
    Lanes sum[C];
    for (int c = 0; c < C; ++c) sum[c] = load(sums[c][b]);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching);
      const auto step = shapes.blend(i, x, y, T, alive);
      count(step);
      for (int c = 0; c < C; ++c) sum[c] = multiply_add(step.weight, shapes.channel(i, c), sum[c]);
      T = step.after, alive = step.alive;
      if (!any(alive)) break;
    }
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    for (int c = 0; c < C; ++c) store(sums[c][b], sum[c]);
    return any(alive);
  }
};

// Draws C channels, of which the image has the first `size`, and alpha.
template <int C, class Shapes = Ellipses<C>>
void draw_tiles(const Input& input, const Image& image, int size, Workers& workers, Scratch& scratch) {
  Binning& binning = scratch.binning;
  TileStates<TileImage<C, Shapes>> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, TileImage<C, Shapes>& state) {
      if (round.begin == 0) state.clear(input, tile);
      state.blend(input, tile, [](const Effect&) {});
      if (round.end < binning.visible) return;
      each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
        float* sums = image.sums + pixel * size;
        for (int c = 0; c < size; ++c) sums[c] = state.sums[c][b][lane];
        const float T = state.transmittance[b][lane];
        image.alpha[pixel] = 1 - (T < 0 ? -T : T);
      });
    });
  });
}

}  // namespace splatax
