#include "slanted.h"

#include <cstring>

#include "blending.h"
#include "gradient.h"

namespace splatax {
namespace {

// Effect of a slanted splat, as `Blend` that of an ellipse.
struct SlantedBlend : Effect {
  Lanes dx, dy, t, s, ahead, hx, hy;  // (hx, hy) = H d
  Lanes inverse, q;                   // of the denominator, 1 where the blur is drawn
  Mask met;                           // false where the blur is drawn

  SPLATAX_INLINE SlantedBlend(const SlantedShape& row, Lanes x, Lanes y, Lanes transmittance, Mask alive_before) {
    dx = x - broadcast(row.x);
    dy = y - broadcast(row.y);
    t = multiply_add(broadcast(row.u), dx, broadcast(row.v) * dy);
    s = broadcast(row.w) * dy;
    ahead = multiply_add(broadcast(row.gx), dx, multiply_add(broadcast(row.gy), dy, broadcast(1)));
    hx = multiply_add(broadcast(row.a), dx, broadcast(row.b) * dy);
    hy = multiply_add(broadcast(row.b), dx, broadcast(row.c) * dy);
    const Lanes along = multiply_add(ahead, ahead, multiply_add(dx, hx, dy * hy));
    const Lanes across = multiply_add(t, t, s * s);
    const Lanes blur = broadcast(row.blur) * multiply_add(dx, dx, dy * dy);
    met = (broadcast(0) < ahead) & (across < blur * along);
    inverse = reciprocal(where(met, along, broadcast(1)));
    q = where(met, across * inverse, blur);
    blend(max(broadcast(row.level) - q, broadcast(-100)), transmittance, alive_before);
  }
};

// The rows of a chunk's splats, as `Ellipses`.
template <int C>
struct SlantedChunk {
  static constexpr int CHANNELS = 0;
  alignas(64) SlantedRow<C> rows[CHUNK];

  void gather(const Input& input, const Tile& tile, const Chunk& chunk, int first) {
    for (int i = 0; i < chunk.size; ++i) {
      const size_t row = tile.splats[tile.pairs[first + i].splat].row;
      std::memcpy(&rows[i], input.channels + row * (SLANTED_SHAPE + C), sizeof rows[i]);
    }
  }
  SPLATAX_INLINE SlantedBlend blend(int i, Lanes x, Lanes y, Lanes transmittance, Mask alive) const {
    return SlantedBlend(rows[i], x, y, transmittance, alive);
  }
  SPLATAX_INLINE Lanes channel(int i, int c) const { return broadcast(rows[i].channels[c]); }
};

// Front to back from the final sums, as `TileGradient`.
template <int C, bool PULLED>
struct SlantedGradient {
  static constexpr int SUMS = slanted_sums(C);

  alignas(64) float transmittance[BLOCKS][LANES];
  alignas(64) float behind[BLOCKS][LANES];
  alignas(64) float d_sums[C][BLOCKS][LANES];
  alignas(64) float d_alpha[BLOCKS][LANES];

  void start(const Input& input, const Cotangents& cotangents, const Tile& tile) {
    std::memset(static_cast<void*>(this), 0, sizeof *this);
    let_light_through(input, tile, transmittance);
    each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
      d_alpha[b][lane] = cotangents.d_alpha[pixel];
      float all = cotangents.d_alpha[pixel] * cotangents.alpha[pixel];
      for (int c = 0; c < C; ++c) {
        d_sums[c][b][lane] = cotangents.d_sums[pixel * C + c];
        all += cotangents.d_sums[pixel * C + c] * cotangents.sums[pixel * C + c];
      }
      behind[b][lane] = all;
    });
  }

  // Writes the sums of each pair, and sets its flag, if the splat is drawn at any pixel of the tile.
  void accumulate(const Input& input, const Tile& tile, float* partials, uint8_t* flags) {
    uint32_t live = live_blocks(transmittance);
    SlantedChunk<C> rows;
    each_chunk<0>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first) {
      rows.gather(input, tile, chunk, first);
      uint16_t blocks[CHUNK];
      find_live_blocks(touching, live, blocks);
      for (int i = 0; i < chunk.size && live; ++i) {
        if (!(blocks[i] & live)) continue;
        const int32_t index = tile.pairs[first + i].index;
        live = accumulate_splat(rows.rows[i], blocks[i] & live, live, tile, partials + static_cast<size_t>(index) * SUMS);
        flags[index] = 1;
      }
    });
  }

 private:
  static constexpr int AT_ONCE = 10, PARTS = (SUMS + AT_ONCE - 1) / AT_ONCE;  // vectors that `add_up` adds at once

  // Sums over some blocks for one splat; returns the blocks that still have unfinished pixels.
  uint32_t accumulate_splat(const SlantedRow<C>& row, uint32_t blocks, uint32_t live, const Tile& tile, float* sums) {
    const PixelCentres centres;
    Lanes total[PARTS * AT_ONCE];
    for (Lanes& sum : total) sum = broadcast(0);
    for (; blocks; blocks &= blocks - 1) {
      const int b = __builtin_ctz(blocks);
      const Lanes before = load(transmittance[b]);
      const Mask alive = broadcast(0) <= before;
      const Lanes T = max(before, broadcast(0) - before);
      const SlantedBlend step(row, centres.x + broadcast(tile.left + block_left(b)),
                              centres.y + broadcast(tile.top + block_top(b)), T, alive);
      Lanes value = load(d_alpha[b]);
      for (int c = 0; c < C; ++c) {
        const Lanes d = load(d_sums[c][b]);
        value = multiply_add(broadcast(row.channels[c]), d, value);
        total[SLANTED_MOMENTS + c] = multiply_add(step.weight, d, total[SLANTED_MOMENTS + c]);
      }
      const Lanes own = step.weight * value, still_behind = load(behind[b]) - own;
      const Lanes g = opacity_gradient(step, own, still_behind);
      const Lanes k = or_zero(step.met, g * step.inverse), l = k * step.q, e = where(step.met, broadcast(0), g);
      const Lanes kx = k * step.dx, ky = k * step.dy, lx = l * step.dx, ly = l * step.dy;
      const Lanes ex = e * step.dx, ey = e * step.dy;
      total[0] += g;
      total[1] += kx;
      total[2] += ky;
      total[3] = multiply_add(kx, step.dx, total[3]);
      total[4] = multiply_add(kx, step.dy, total[4]);
      total[5] = multiply_add(ky, step.dy, total[5]);
      total[6] += l;
      total[7] += lx;
      total[8] += ly;
      total[9] = multiply_add(lx, step.dx, total[9]);
      total[10] = multiply_add(lx, step.dy, total[10]);
      total[11] = multiply_add(ly, step.dy, total[11]);
      total[12] += ex;
      total[13] += ey;
      if (PULLED) {
        const Lanes across = multiply_add(broadcast(row.v), step.t, broadcast(row.w) * step.s);
        const Lanes along_x = multiply_add(step.ahead, broadcast(row.gx), step.hx);
        const Lanes along_y = multiply_add(step.ahead, broadcast(row.gy), step.hy);
        const Lanes x = multiply_subtract_from(l, along_x, k * broadcast(row.u) * step.t) + row.blur * ex;
        const Lanes y = multiply_subtract_from(l, along_y, k * across) + row.blur * ey;
        total[SUMS - 2] += absolute(x);
        total[SUMS - 1] += absolute(y);
      }

      store(transmittance[b], where(step.alive, step.after, broadcast(0) - step.after));
      store(behind[b], still_behind);  // own is zero where it is not drawn
      if (!any(step.alive)) live &= ~(1u << b);
    }
    alignas(64) float added[PARTS][LANES];
    for (int part = 0; part < PARTS; ++part) add_up<AT_ONCE>(total + part * AT_ONCE, added[part]);
    for (int k = 0; k < SUMS; ++k) sums[k] = added[k / AT_ONCE][k % AT_ONCE];
    return live;
  }
};

// Adds up the partials of a round's pairs, pair after pair, whichever thread made them.
template <int SUMS>
void gather(const Binning& binning, const Round& round, const Scratch& scratch, float* sums, Workers& workers) {
  const float* partials = scratch.partial_sums.get();
  const uint8_t* flags = scratch.flags.get();
  workers.ranges(round.end - round.begin, [&](int, int begin, int end) {
    for (int i = begin; i < end; ++i) {
      float* own = sums + static_cast<size_t>(binning.splats[round.begin + i].row) * SUMS;
      for (int32_t index = binning.first_pair[i]; index < binning.first_pair[i + 1]; ++index) {
        if (!flags[index]) continue;
        for (int k = 0; k < SUMS; ++k) own[k] += partials[static_cast<size_t>(index) * SUMS + k];
      }
    }
  });
}

template <int C, bool PULLED>
void add_gradient(const Input& input, const Cotangents& cotangents, float* sums, Workers& workers, Scratch& scratch) {
  constexpr int SUMS = slanted_sums(C);
  std::fill_n(sums, static_cast<size_t>(input.count) * SUMS, 0.0f);
  Binning& binning = scratch.binning;
  TileStates<SlantedGradient<C, PULLED>> states(binning, scratch);
  each_round(binning, workers, [&](const Round& round) {
    const size_t pairs = binning.pair_count();
    float* partials = scratch.partial_sums.at_least(pairs * SUMS);
    uint8_t* flags = scratch.flags.at_least(pairs);
    std::fill_n(flags, pairs, uint8_t{0});
    states.each_tile(workers, [&](const Tile& tile, SlantedGradient<C, PULLED>& state) {
      if (round.begin == 0) state.start(input, cotangents, tile);
      state.accumulate(input, tile, partials, flags);
    });
    gather<SUMS>(binning, round, scratch, sums, workers);
  });
}

}  // namespace

void slanted(const Input& input, const Image& image, Workers& workers, Scratch& scratch, int64_t max_pairs) {
  scratch.binning.collect(input, workers, std::max<int64_t>(max_pairs / 2, 1));
  const bool wide = input.channel_count > SLANTED_SHAPE + GROUP;
  const auto draw = wide ? draw_tiles<WIDE_GROUP, SlantedChunk<WIDE_GROUP>> : draw_tiles<GROUP, SlantedChunk<GROUP>>;
  draw(input, image, wide ? WIDE_GROUP : GROUP, workers, scratch);
}

void slanted_gradient(const Input& input, const Cotangents& cotangents, bool pulled, float* sums, Workers& workers,
                      Scratch& scratch, bool binned, int64_t max_pairs) {
  if (!binned) scratch.binning.collect(input, workers, std::max<int64_t>(max_pairs / 2, 1));
  const bool wide = input.channel_count > SLANTED_SHAPE + GROUP;
  const auto add = wide ? add_gradient<WIDE_GROUP, false> : pulled ? add_gradient<GROUP, true> : add_gradient<GROUP, false>;
  add(input, cotangents, sums, workers, scratch);
}

}  // namespace splatax
