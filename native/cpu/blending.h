// Image of a tile: its splats blended front to back.
//
//   C = sum_i T_i alpha_i c_i,   T_i = prod_{j<i} (1 - alpha_j)         (Kerbl et al. 2023, Eq. 3)
#pragma once

#include "tiles.h"

namespace splatax {

// Watches a blend, and does nothing with what it sees.
struct NoWatch {
  void begin(int) {}                             // a chunk, whose first splat has this position in the list
  SPLATAX_INLINE void see(const Effect&, int) {}  // the effect of a splat of the chunk on a block
  void end(int) {}                               // a block of the chunk
};

// Keeps what `Binning::keep_seen` describes.
class SeenOfTile {
 public:
  explicit SeenOfTile(uint64_t* words) : words_(words) {}

  void begin(int first) {
    own_ = words_ + first / CHUNK * BLOCKS;
    std::fill_n(own_, BLOCKS, uint64_t{0});
  }
  SPLATAX_INLINE void see(const Effect& step, int i) { seen_ |= uint64_t{any(step.seen)} << i; }
  void end(int b) { own_[b] = seen_, seen_ = 0; }

 private:
  uint64_t *words_, *own_ = nullptr, seen_ = 0;
};

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

  // Blends the tile's list, and shows each effect to a watch such as `NoWatch`.
  template <class Watch>
  void blend(const Input& input, const Tile& tile, Watch watch) {
    uint32_t live = live_blocks(transmittance);
    Shapes shapes;
    each_chunk<Shapes::CHANNELS>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first) {
      shapes.gather(input, tile, chunk, first);
      watch.begin(first);
      for (int b = 0; b < BLOCKS; ++b) {
        if (!(live >> b & 1) || !touching[b]) continue;
        if (!blend_block(shapes, touching[b], b, tile, watch)) live &= ~(1u << b);
        watch.end(b);
      }
    });
  }

 private:
  // Blends the splats whose bits are set; returns false once all pixels of the block are finished.
  template <class Watch>
  bool blend_block(const Shapes& shapes, uint64_t touching, int b, const Tile& tile, Watch& watch) {
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
      watch.see(step, i);
      for (int c = 0; c < C; ++c) sum[c] = multiply_add(step.weight, shapes.channel(i, c), sum[c]);
      T = step.after;
      alive = step.alive;
      if (!any(alive)) break;
    }
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    for (int c = 0; c < C; ++c) store(sums[c][b], sum[c]);
    return any(alive);
  }
};

// Draws C channels, of which the image has the first `size`, and alpha. If the gradient follows, it gets to know what was
// seen.
template <int C, class Shapes = Ellipses<C>>
void draw_tiles(const Input& input, const Image& image, int size, Workers& workers, Scratch& scratch) {
  Binning& binning = scratch.binning;
  TileStates<TileImage<C, Shapes>> states(binning, scratch);
  const bool keeps = scratch.expected && binning.rounds.size() == 1;
  each_round(binning, workers, [&](const Round& round) {
    if (keeps) binning.make_room_for_seen();
    states.each_tile(workers, [&](const Tile& tile, TileImage<C, Shapes>& state) {
      if (round.begin == 0) state.clear(input, tile);
      if (keeps) {
        state.blend(input, tile, SeenOfTile(binning.seen_of(tile.number)));
      } else {
        state.blend(input, tile, NoWatch());
      }
      if (round.end < binning.visible) return;
      write_pixels(input, tile, image.sums, size, size, [&](int b, int c) { return state.sums[c][b]; });
      for (auto& block : state.transmittance) store(block, broadcast(1) - absolute(load(block)));
      write_pixels(input, tile, image.alpha, 1, 1, [&](int b, int) { return state.transmittance[b]; });
    });
  });
  if (keeps) binning.keep_seen();
}

}  // namespace splatax
