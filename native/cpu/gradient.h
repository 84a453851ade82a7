// Gradient of a tile, front to back like the blend, from the blend's final sums.
//
// Let s_i = <c_i, dL/dC> + dL/dA, for sums C and alpha A, and weights w_i = T_i alpha_i. The sum of all
// w_i s_i is known in advance: <C, dL/dC> + A dL/dA. The sum over the splats behind splat i is this total
// minus the sum up to splat i, so
//
//   g_i = alpha_i dL/d alpha_i = w_i s_i - alpha_i / (1 - alpha_i) sum_{j>i} w_j s_j .
//
// The gradient of a splat's shape needs only the moments of g over pixels; see `add_moments` in
// gradient.cc.
#pragma once

#include "reduction.h"
#include "tiles.h"

namespace splatax {

constexpr int MOMENTS = 6;           // g, g x, g y, g x^2, g x y, g y^2, about the tile's centre
constexpr int PULL = MOMENTS + GROUP;  // offset of the sums of |dL/dx|, |dL/dy|, if requested
constexpr int PARTIALS = PULL + 2;     // floats for a pair: the moments, dL/d channels, and those

// Moves moments from the tile's centre to the splat's mean, which is at (-dx, -dy) from the centre. The code uses
// scalars only: a vector load from freshly stored scalars stalls, and so does the reverse.
SPLATAX_INLINE void move_moments(const float* sums, float dx, float dy, float* partials) {
  const float g = sums[0], gx = sums[1] + dx * g, gy = sums[2] + dy * g;
  partials[0] = g;
  partials[1] = gx;
  partials[2] = gy;
  partials[3] = sums[3] + dx * (sums[1] + gx);
  partials[4] = sums[4] + dx * sums[2] + dy * gx;
  partials[5] = sums[5] + dy * (sums[2] + gy);
}

// Partials of a pair: its sums, with the moments about the splat's mean.
SPLATAX_INLINE void write_partials(const float* sums, float dx, float dy, float* partials) {
  move_moments(sums, dx, dy, partials);
  for (int k = MOMENTS; k < PARTIALS; ++k) partials[k] = sums[k];
}

// g_i, from w_i s_i and the sum of w_j s_j behind.
SPLATAX_INLINE Lanes opacity_gradient(const Effect& step, Lanes own, Lanes behind) {
  // A clamped alpha does not depend on the splat.
  const Mask flexible = step.drawn & (step.raw <= broadcast(MAX_ALPHA));
  const Lanes odds = step.alpha * reciprocal(broadcast(1) - step.alpha);
  return or_zero(flexible, multiply_subtract_from(odds, behind, own));
}

// Where the sums of a pair are in its partials, after the moments; only the first `used` floats are written.
struct Layout {
  int used, channels, pull;
};

// Centres of the pixels of each block, relative to the tile's corner.
struct CentresOfBlocks {
  alignas(64) float x[BLOCKS][LANES], y[BLOCKS][LANES];

  CentresOfBlocks() {
    for (int b = 0; b < BLOCKS; ++b) {
      for (int lane = 0; lane < LANES; ++lane) {
        x[b][lane] = block_left(b) + lane % BLOCK + 0.5f;
        y[b][lane] = block_top(b) + lane / BLOCK + 0.5f;
      }
    }
  }
};
inline const CentresOfBlocks CENTRES;

template <int C, bool PULLED>
struct TileGradient {
  alignas(64) float transmittance[BLOCKS][LANES];  // as in `TileImage`
  alignas(64) float behind[BLOCKS][LANES];         // sum of w_j s_j over splats yet to come
  alignas(64) float d_sums[C][BLOCKS][LANES];
  alignas(64) float d_alpha[BLOCKS][LANES];

  static constexpr int STRIDE = PARTIALS;
  static Layout layout(Part) { return {PARTIALS, MOMENTS, PULL}; }

  // Writes the partials of each pair, and sets its flag, if the splat is drawn at any pixel of the tile.
  void accumulate(const Input&, const Tile& tile, Part, float* all_partials, uint8_t* flags) {
    auto* partials = reinterpret_cast<float(*)[PARTIALS]>(all_partials);
    uint32_t live = live_blocks(transmittance);
    each_chunk<C>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first) {
      uint16_t blocks[CHUNK];
      find_live_blocks(touching, live, blocks);
      const Pair* const pairs = tile.pairs + first;
      for (int i = 0; i < chunk.size && live; ++i) {
        if (i + AHEAD < chunk.size && blocks[i + AHEAD]) {
          const int32_t later = pairs[i + AHEAD].index;
          __builtin_prefetch(partials[later], 1);
          __builtin_prefetch(partials[later] + PARTIALS - 1, 1);
          __builtin_prefetch(flags + later, 1);
        }
        if (!(blocks[i] & live)) continue;
        const int32_t index = pairs[i].index;
        alignas(64) float sums[LANES];
        live = accumulate_splat(chunk, i, blocks[i] & live, live, tile, sums);
        write_partials(sums, tile.left + TILE / 2 - chunk.x[i], tile.top + TILE / 2 - chunk.y[i], partials[index]);
        flags[index] = 1;
      }
    });
  }

 private:
  static constexpr int AHEAD = 8;  // splats whose partials are prefetched: they are anywhere in memory

  // Sums over some blocks for one splat; returns the blocks that still have unfinished pixels.
  uint32_t accumulate_splat(const Chunk& chunk, int i, uint32_t blocks, uint32_t live, const Tile& tile,
                            float* sums) {
    const Lanes left = broadcast(tile.left), top = broadcast(tile.top), half = broadcast(TILE / 2);
    constexpr int SUMS = PULLED ? PARTIALS : MOMENTS + C;
    Lanes total[SUMS];
    for (Lanes& sum : total) sum = broadcast(0);
    for (; blocks; blocks &= blocks - 1) {
      const int b = __builtin_ctz(blocks);
      const Lanes before = load(transmittance[b]);
      const Mask alive = broadcast(0) <= before;
      const Lanes T = max(before, broadcast(0) - before);
      const Lanes across_tile = load(CENTRES.x[b]), down_tile = load(CENTRES.y[b]);
      const Blend step(chunk, i, across_tile + left, down_tile + top, T, alive);

      Lanes value = load(d_alpha[b]);
      for (int c = 0; c < C; ++c) {
        const Lanes d = load(d_sums[c][b]);
        value = multiply_add(broadcast(chunk.channels[c][i]), d, value);
        total[MOMENTS + c] = multiply_add(step.weight, d, total[MOMENTS + c]);
      }
      const Lanes own = step.weight * value, still_behind = load(behind[b]) - own;
      const Lanes g = opacity_gradient(step, own, still_behind);
      const Lanes x = across_tile - half, y = down_tile - half;
      const Lanes gx = g * x, gy = g * y;
      total[0] = total[0] + g;
      total[1] = total[1] + gx;
      total[2] = total[2] + gy;
      total[3] = multiply_add(gx, x, total[3]);
      total[4] = multiply_add(gx, y, total[4]);
      total[5] = multiply_add(gy, y, total[5]);
      if (PULLED) {
        const Lanes across = multiply_add(broadcast(chunk.v[i]), step.t, broadcast(chunk.w[i]) * step.s);
        total[SUMS - 2] = total[SUMS - 2] + absolute(g * broadcast(chunk.u[i]) * step.t);
        total[SUMS - 1] = total[SUMS - 1] + absolute(g * across);
      }

      store(transmittance[b], where(step.alive, step.after, broadcast(0) - step.after));
      store(behind[b], still_behind);  // own is zero where it is not drawn
      if (!any(step.alive)) live &= ~(1u << b);
    }
    add_up<SUMS>(total, sums);
    return live;
  }
};

}  // namespace splatax
