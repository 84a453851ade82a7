// The image of a tile: its splats blended front to back.
//
//   C = sum_i T_i alpha_i c_i,   T_i = prod_{j<i} (1 - alpha_j)         (Kerbl et al. 2023, Eq. 3)
#pragma once

#include "chunk.h"

namespace splatax {

// Of a tile, block by block, between rounds and in the end.
template <int C>
struct TileImage {
  // Of a pixel that is done, or outside the image: negated.
  alignas(64) float transmittance[BLOCKS][LANES];
  alignas(64) float sums[C][BLOCKS][LANES];

  void clear(int width, int height, int left, int top) {
    for (int b = 0; b < BLOCKS; ++b) {
      for (int lane = 0; lane < LANES; ++lane) {
        const int x = left + b % BLOCKS_A_SIDE * BLOCK + lane % BLOCK;
        const int y = top + b / BLOCKS_A_SIDE * BLOCK + lane / BLOCK;
        transmittance[b][lane] = x < width && y < height ? 1 : -1;
        for (int c = 0; c < C; ++c) sums[c][b][lane] = 0;
      }
    }
  }

  // Blends a list into the tile whose corner is at (left, top).
  void blend(const Splat* splats, const Pair* pairs, int count, float left, float top) {
    uint32_t live = live_blocks(transmittance);
    each_chunk<C>(splats, pairs, count, left, top, live, [&](const Chunk& chunk, const uint64_t* touching, int) {
      for (int b = 0; b < BLOCKS; ++b) {
        if ((live >> b & 1) && touching[b] && !blend_block(chunk, touching[b], b, left, top)) {
          live &= ~(1u << b);
        }
      }
    });
  }

 private:
  // Blends the splats whose bits are set; false once all its pixels are done.
  bool blend_block(const Chunk& chunk, uint64_t touching, int b, float left, float top) {
    const PixelCentres centres;
    const Lanes x = centres.x + all(left + b % BLOCKS_A_SIDE * BLOCK);
    const Lanes y = centres.y + all(top + b / BLOCKS_A_SIDE * BLOCK);
    const Lanes before = load(transmittance[b]);
    Mask alive = all(0) <= before;
    Lanes T = max(before, all(0) - before);
    Lanes sum[C];
    for (int c = 0; c < C; ++c) sum[c] = load(sums[c][b]);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching);
      const Blend step(chunk, i, x, y, T, alive);
      for (int c = 0; c < C; ++c) sum[c] = multiply_add(step.weight, all(chunk.channels[c][i]), sum[c]);
      T = step.after, alive = step.alive;
      if (!any(alive)) break;
    }
    store(transmittance[b], where(alive, T, all(0) - T));
    for (int c = 0; c < C; ++c) store(sums[c][b], sum[c]);
    return any(alive);
  }
};

}  // namespace splatax
