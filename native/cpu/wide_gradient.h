// Gradient of a tile for more channels than fit in registers; the formulas are those of gradient.h.
//
// The blocks are visited one after the other. In each, one walk lists the weights; then
//
//   values      s_i = <c_i, dL/dC> + dL/dA at each pixel, several splats side by side
//   moments     of g_i, which needs the sums of w_j s_j behind each splat
//   channels    dL/dc_i = sum of w_i dL/dC over pixels, in lanes of channels instead of pixels
#pragma once

#include "gradient.h"
#include "wide.h"

namespace splatax {

constexpr int WIDE_SUMS = MOMENTS + 2;  // moments, and sums of |dL/dx|, |dL/dy|: the partials before the channels

template <int W, bool PULLED>
struct WideGradient {
  alignas(64) float transmittance[BLOCKS][LANES];  // as in `TileGradient`
  alignas(64) float behind[BLOCKS][LANES];
  alignas(64) float d_alpha[BLOCKS][LANES];
  alignas(64) float d_sums[BLOCKS][W][LANES];
  alignas(64) float d_pixels[BLOCKS][LANES][W];  // the same, pixel by pixel

  static constexpr int STRIDE = WIDE_SUMS + W;
  static Layout layout(Part part) { return {WIDE_SUMS + part.size, WIDE_SUMS, MOMENTS}; }

  void clear(Part part) {
    const int padded = (part.size + LANES - 1) / LANES * LANES;
    std::memset(d_alpha, 0, sizeof d_alpha), std::memset(behind, 0, sizeof behind);
    for (auto& block : d_sums) std::memset(block, 0, padded * sizeof block[0]);
    for (auto& block : d_pixels) {
      for (auto& pixel : block) std::memset(pixel, 0, padded * sizeof pixel[0]);
    }
  }

  // Writes the partials of each pair, WIDE_SUMS + W floats, and sets its flag, if the splat is drawn in the tile.
  void accumulate(const Input& input, const Tile& tile, Part part, float* partials, uint8_t* flags) {
    uint32_t live = live_blocks(transmittance);
    ChunkChannels<W> channels;
    Totals totals;
    each_chunk<0>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first_pair) {
      channels.gather(input, tile, first_pair, chunk.size, part);
      uint64_t drawn = 0;
      for (int b = 0; b < BLOCKS; ++b) {
        if (!(live >> b & 1) || !touching[b]) continue;
        List list;
        if (!weigh(chunk, touching[b], b, tile, list)) live &= ~(1u << b);
        if (list.count == 0) continue;
        drawn = totals.begin(list, drawn, part.size);
        add_values(channels, list, b, part.size);
        add_moments(chunk, list, b, totals);
        for (int c = 0; c < part.size; c += LANES) add_channels(list, b, c, totals);
      }
      for (; drawn; drawn &= drawn - 1) {
        const int i = __builtin_ctzll(drawn);
        const int32_t index = tile.pairs[first_pair + i].index;
        float* to = partials + static_cast<size_t>(index) * STRIDE;
        write(totals, i, tile.left + TILE / 2 - chunk.x[i], tile.top + TILE / 2 - chunk.y[i], part.size, to);
        flags[index] = 1;
      }
    });
  }

 private:
  struct List : Weights {
    alignas(64) float free[CHUNK][LANES];   // weight where alpha depends on the splat, else 0
    alignas(64) float odds[CHUNK][LANES];   // alpha / (1 - alpha) there, else 0
    alignas(64) float value[CHUNK][LANES];
    alignas(64) float t[PULLED ? CHUNK : 1][LANES], s[PULLED ? CHUNK : 1][LANES];
  };

  // Sums over blocks for the splats of a chunk.
  struct Totals {
    alignas(64) float moments[CHUNK][WIDE_SUMS][LANES];
    alignas(64) float channels[CHUNK][W];

    // Clears the sums of listed splats that no block before has drawn; returns all that are drawn now.
    uint64_t begin(const List& list, uint64_t drawn, int size) {
      for (int k = 0; k < list.count; ++k) {
        const int i = list.splat[k];
        if (drawn >> i & 1) continue;
        drawn |= uint64_t{1} << i;
        std::memset(moments[i], 0, sizeof moments[i]);
        std::memset(channels[i], 0, (size + LANES - 1) / LANES * LANES * sizeof(float));
      }
      return drawn;
    }
  };

  bool weigh(const Chunk& chunk, uint64_t touching, int b, const Tile& tile, List& list) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    const Lanes before = load(transmittance[b]);
    Mask alive = broadcast(0) <= before;
    Lanes T = max(before, broadcast(0) - before);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching), k = list.count;
      const Blend step(chunk, i, x, y, T, alive);
      // A clamped alpha does not depend on the splat.
      const Mask flexible = step.drawn & (step.raw <= broadcast(MAX_ALPHA));
      store(list.weight[k], step.weight);
      store(list.free[k], or_zero(flexible, step.weight));
      store(list.odds[k], or_zero(flexible, step.alpha * reciprocal(broadcast(1) - step.alpha)));
      if (PULLED) {
        store(list.t[k], step.t);
        store(list.s[k], step.s);
      }
      list.splat[k] = i;
      list.count += any(step.drawn);
      T = step.after;
      alive = step.alive;
      if (!any(alive)) break;
    }
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    return any(alive);
  }

  void add_values(const ChunkChannels<W>& channels, List& list, int b, int size) const {
    for (int k = 0; k < list.count; k += SIDE_BY_SIDE) {
      const float* rows[SIDE_BY_SIDE];
      Lanes value[SIDE_BY_SIDE];
#pragma GCC unroll 8
      for (int j = 0; j < SIDE_BY_SIDE; ++j) rows[j] = channels.rows[list.splat[k + j]], value[j] = load(d_alpha[b]);
      for (int c = 0; c < size; ++c) {
        const Lanes d = load(d_sums[b][c]);
#pragma GCC unroll 8
        for (int j = 0; j < SIDE_BY_SIDE; ++j) value[j] = multiply_add(broadcast(rows[j][c]), d, value[j]);
      }
#pragma GCC unroll 8
      for (int j = 0; j < SIDE_BY_SIDE; ++j) store(list.value[k + j], value[j]);
    }
  }

  void add_moments(const Chunk& chunk, const List& list, int b, Totals& totals) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(block_left(b) - TILE / 2), y = centres.y + broadcast(block_top(b) - TILE / 2);
    Lanes still_behind = load(behind[b]);
    for (int k = 0; k < list.count; ++k) {
      const int i = list.splat[k];
      const Lanes value = load(list.value[k]);
      still_behind = still_behind - load(list.weight[k]) * value;
      const Lanes g = multiply_subtract_from(load(list.odds[k]), still_behind, load(list.free[k]) * value);
      const Lanes gx = g * x, gy = g * y;
      auto& total = totals.moments[i];
      const auto add = [&](int m, Lanes part) { store(total[m], load(total[m]) + part); };
      add(0, g);
      add(1, gx);
      add(2, gy);
      add(3, gx * x);
      add(4, gx * y);
      add(5, gy * y);
      if (PULLED) {
        const Lanes t = load(list.t[k]), s = load(list.s[k]);
        const Lanes across = multiply_add(broadcast(chunk.v[i]), t, broadcast(chunk.w[i]) * s);
        add(MOMENTS, absolute(g * broadcast(chunk.u[i]) * t));
        add(MOMENTS + 1, absolute(g * across));
      }
    }
    store(behind[b], still_behind);
  }

  // Adds to the gradients of channels [first, first + LANES).
  void add_channels(const List& list, int b, int first, Totals& totals) const {
    for (int k = 0; k < list.count; k += SIDE_BY_SIDE) {
      const int count = std::min(SIDE_BY_SIDE, list.count - k);
      Lanes sum[SIDE_BY_SIDE];
#pragma GCC unroll 8
      for (int j = 0; j < SIDE_BY_SIDE; ++j) sum[j] = broadcast(0);
      for (int lane = 0; lane < LANES; ++lane) {
        const Lanes d = load(d_pixels[b][lane] + first);
#pragma GCC unroll 8
        for (int j = 0; j < SIDE_BY_SIDE; ++j) sum[j] = multiply_add(broadcast(list.weight[k + j][lane]), d, sum[j]);
      }
      for (int j = 0; j < count; ++j) {
        float* to = totals.channels[list.splat[k + j]] + first;
        store(to, load(to) + sum[j]);
      }
    }
  }

  // Writes the partials of a pair, with the moments moved to the splat's mean as in `write_partials`.
  static void write(const Totals& totals, int i, float dx, float dy, int size, float* to) {
    constexpr int LEAST = 9;  // vectors that `add_up` adds at once
    Lanes vectors[LEAST];
    for (int k = 0; k < LEAST; ++k) vectors[k] = k < WIDE_SUMS ? load(totals.moments[i][k]) : broadcast(0);
    alignas(64) float sums[LANES];
    add_up<LEAST>(vectors, sums);
    move_moments(sums, dx, dy, to);
    for (int k = MOMENTS; k < WIDE_SUMS; ++k) to[k] = sums[k];
    std::memcpy(to + WIDE_SUMS, totals.channels[i], size * sizeof(float));
  }
};

}  // namespace splatax
