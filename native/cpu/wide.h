// Blend of more channels than fit in registers: one walk finds the weights of all splats at a block of pixels,
// and the channels are added from this list afterwards, some registers full at a time.
#pragma once

#include "tiles.h"

namespace splatax {

#if defined(__AVX512F__)
constexpr int AT_ONCE = 16, SIDE_BY_SIDE = 8;  // channels, and splats, whose sums stay in registers together
#else
constexpr int AT_ONCE = 4, SIDE_BY_SIDE = 4;
#endif

// Channels of a chunk's splats, splat by splat, padded with zeros to whole registers.
template <int W>
struct ChunkChannels {
  alignas(64) float rows[CHUNK][W];

  void gather(const Input& input, const Tile& tile, int first_pair, int count, Part part) {
    const int padded = (part.size + LANES - 1) / LANES * LANES;
    for (int i = 0; i < count; ++i) {
      const size_t row = tile.splats[tile.pairs[first_pair + i].splat].row;
      std::memcpy(rows[i], input.channels + row * input.channel_count + part.first, part.size * sizeof(float));
      std::fill(rows[i] + part.size, rows[i] + padded, 0.0f);
    }
  }
};

// Splats of a chunk that are drawn in a block, and their weights there.
struct Weights {
  alignas(64) float weight[CHUNK][LANES];
  uint8_t splat[CHUNK] = {};
  int count = 0;
};

// Image of a tile for one part of the channels.
template <int W>
struct WideImage {
  alignas(64) float transmittance[BLOCKS][LANES];  // as in `TileImage`
  alignas(64) float sums[BLOCKS][W][LANES];

  void clear(const Input& input, const Tile& tile, Part part) {
    const int padded = (part.size + LANES - 1) / LANES * LANES;
    for (auto& block : sums) std::memset(block, 0, padded * sizeof block[0]);
    let_light_through(input, tile, transmittance);
  }

  void blend(const Input& input, const Tile& tile, Part part) {
    uint32_t live = live_blocks(transmittance);
    ChunkChannels<W> channels;
    each_chunk<0>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first_pair) {
      channels.gather(input, tile, first_pair, chunk.size, part);
      for (int b = 0; b < BLOCKS; ++b) {
        if (!(live >> b & 1) || !touching[b]) continue;
        Weights list;
        if (!weigh(chunk, touching[b], b, tile, list)) live &= ~(1u << b);
        for (int c = 0; c < part.size; c += AT_ONCE) add(list, channels.rows, c, sums[b] + c);
      }
    });
  }

 private:
  // Lists the weights of the splats whose bits are set; returns false once all pixels of the block are finished.
  bool weigh(const Chunk& chunk, uint64_t touching, int b, const Tile& tile, Weights& list) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    const Lanes before = load(transmittance[b]);
    Mask alive = broadcast(0) <= before;
    Lanes T = max(before, broadcast(0) - before);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching);
      const Blend step(chunk, i, x, y, T, alive);
      store(list.weight[list.count], step.weight);
      list.splat[list.count] = i;
      list.count += any(step.drawn);
      T = step.after;
      alive = step.alive;
      if (!any(alive)) break;
    }
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    return any(alive);
  }

  static void add(const Weights& list, const float (*rows)[W], int first, float (*to)[LANES]) {
    Lanes sum[AT_ONCE];
#pragma GCC unroll 16
    for (int c = 0; c < AT_ONCE; ++c) sum[c] = load(to[c]);
    for (int k = 0; k < list.count; ++k) {
      const Lanes weight = load(list.weight[k]);
      const float* row = rows[list.splat[k]] + first;
#pragma GCC unroll 16
      for (int c = 0; c < AT_ONCE; ++c) sum[c] = multiply_add(weight, broadcast(row[c]), sum[c]);
    }
#pragma GCC unroll 16
    for (int c = 0; c < AT_ONCE; ++c) store(to[c], sum[c]);
  }
};

// Largest number of pairs in a round, so that partial gradients take as much memory for all numbers of channels.
inline int64_t pairs_in_round(const Input& input, int64_t max_pairs) {
  return input.channel_count <= GROUP ? max_pairs : std::max<int64_t>(max_pairs / 2, 1);
}

// Channels of each walk: wide if there are few pairs, because each of them has a partial gradient for each channel.
inline int walk_width(const Input& input, const Binning& binning, int64_t max_pairs) {
  const bool few = binning.rounds.size() == 1 && binning.pairs_at_most <= max_pairs / Binning::FEW;
  return few && input.channel_count > NARROW_WALK ? WIDE_WALK : NARROW_WALK;
}

// Calls body(part) for parts of at most `width` channels.
template <class Body>
void each_part_of_channels(const Input& input, int width, const Body& body) {
  for (int first = 0; first < input.channel_count; first += width) {
    body(Part{first, std::min(width, input.channel_count - first)});
  }
}

}  // namespace splatax
