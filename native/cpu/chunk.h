// Up to 64 splats of a tile's list, field by field, and the blocks of pixels that each splat touches.
#pragma once

#include "binning.h"
#include "columns.h"
#include "splats.h"

namespace splatax {

struct Chunk {
  alignas(64) float x[CHUNK], y[CHUNK], u[CHUNK], v[CHUNK], w[CHUNK], level[CHUNK], reach[CHUNK];
  alignas(64) float x_per_y[CHUNK], y_per_x[CHUNK];
  alignas(64) float channels[GROUP][CHUNK];
  int size;

  template <int C>
  void gather(const Splat* splats, const Pair* pairs, int count) {
    size = count;
    for (int first = 0; first < count; first += LANES) {
      const float* rows[LANES];
      for (int lane = 0; lane < LANES; ++lane) rows[lane] = &splats[pairs[std::min(first + lane, count - 1)].splat].x;
      float* const fields[] = {x, y, u, v, w, level, reach, x_per_y, y_per_x, channels[0], channels[1], channels[2], channels[3]};
      const auto read = [&](int from, int columns) {
        read_columns([&](int lane) { return rows[lane] + from; }, columns, [&](int k) { return fields[from + k] + first; });
      };
      read(0, 4);
      read(4, 4);
      read(8, std::min(C + 1, 4));
      if (C > 3) read(12, C - 3);
    }
    // Vectors read past the end, up to the next multiple of sixteen; splats there reach no pixel.
    for (int i = count; i % LANES != 0; ++i) reach[i] = -1;
  }

  // Sets bit i of touching[b] where the ellipse of splat i reaches a pixel centre's rectangle of
  // block b. `left` and `top` are the tile's corner.
  //
  // t^2 + s^2 is convex, so its minimum over a rectangle is on an edge that faces the mean. On each of
  // these edges one coordinate is fixed, and the other is clipped to its optimum.
  void find_blocks(float left, float top, uint64_t touching[BLOCKS]) const {
    for (int b = 0; b < BLOCKS; ++b) touching[b] = 0;
    const Lanes zero = broadcast(0), side = broadcast(BLOCK - 1);
    for (int i = 0; i < size; i += LANES) {
      const Lanes su = load(u + i), sv = load(v + i), sw = load(w + i), limit = load(reach + i);
      const Lanes slope_x = load(x_per_y + i), slope_y = load(y_per_x + i);
      const Lanes from_left = broadcast(left + 0.5f) - load(x + i), from_top = broadcast(top + 0.5f) - load(y + i);
      for (int row = 0; row < BLOCKS_A_SIDE; ++row) {
        const Lanes near_y = from_top + broadcast(row * BLOCK), far_y = near_y + side;
        const Lanes edge_y = min(max(zero, near_y), far_y);
        const Lanes ideal_x = slope_x * edge_y, v_edge = sv * edge_y, s_edge = sw * edge_y;
        for (int column = 0; column < BLOCKS_A_SIDE; ++column) {
          const Lanes near_x = from_left + broadcast(column * BLOCK), far_x = near_x + side;
          const Lanes edge_x = min(max(zero, near_x), far_x);
          const Lanes best_x = min(max(ideal_x, near_x), far_x);
          const Lanes best_y = min(max(slope_y * edge_x, near_y), far_y);
          const Lanes t1 = multiply_add(su, best_x, v_edge);
          const Lanes t2 = multiply_add(su, edge_x, sv * best_y), s2 = sw * best_y;
          const Lanes q1 = multiply_add(t1, t1, s_edge * s_edge), q2 = multiply_add(t2, t2, s2 * s2);
          touching[row * BLOCKS_A_SIDE + column] |= static_cast<uint64_t>(bits(min(q1, q2) <= limit)) << i;
        }
      }
    }
  }
};

// Blocks with unfinished pixels, one bit each.
inline uint32_t live_blocks(const float (*transmittance)[LANES]) {
  uint32_t live = 0;
  for (int b = 0; b < BLOCKS; ++b) live |= any(broadcast(0) <= load(transmittance[b])) ? 1u << b : 0;
  return live;
}

// Turns the splats that touch each live block into the blocks that each splat touches, one bit each.
inline void find_live_blocks(const uint64_t* touching, uint32_t live, uint16_t blocks[CHUNK]) {
  std::fill_n(blocks, CHUNK, uint16_t{0});
  for (int b = 0; b < BLOCKS; ++b) {
    if (!(live >> b & 1)) continue;
    for (uint64_t left_over = touching[b]; left_over; left_over &= left_over - 1) {
      blocks[__builtin_ctzll(left_over)] |= static_cast<uint16_t>(1u << b);
    }
  }
}

// Calls body(chunk, touching, first) for each chunk of a tile's list in order, while a block is live.
// `first` is the position of the chunk's first splat in the list.
template <int C, class Body>
SPLATAX_INLINE void each_chunk(const Tile& tile, const uint32_t& live, const Body& body) {
  Chunk chunk;
  uint64_t found[BLOCKS];
  for (int first = 0; first < tile.count && live; first += CHUNK) {
    chunk.gather<C>(tile.splats, tile.pairs + first, std::min(CHUNK, tile.count - first));
    if (!tile.seen) chunk.find_blocks(tile.left, tile.top, found);
    body(chunk, tile.seen ? tile.seen + first / CHUNK * BLOCKS : found, first);
  }
}

// Centres of a block's pixels, relative to its corner.
struct PixelCentres {
  Lanes x, y;

  SPLATAX_INLINE PixelCentres() {
    alignas(64) float columns[LANES], rows[LANES];
    for (int lane = 0; lane < LANES; ++lane) {
      columns[lane] = lane % BLOCK + 0.5f;
      rows[lane] = lane / BLOCK + 0.5f;
    }
    x = load(columns);
    y = load(rows);
  }
};

// Effect of a splat on a block of pixels; forward and backward passes must agree bit by bit.
struct Effect {
  Lanes raw, alpha, weight, after;  // opacity G; clamped, garbage where not drawn; T alpha; T behind it
  Mask seen, drawn, alive;          // where it counts; of these, where it is drawn; where later splats may be

 protected:
  // From log2 of its raw alpha. Each splat needs the transmittance left by the one before, so few operations depend on it: where nothing is seen,
  // an alpha of 0 leaves it as it is, so an unfinished pixel stays one, without a test of its own.
  SPLATAX_INLINE void blend(Lanes exponent, Lanes transmittance, Mask alive_before) {
    const Mask visible = broadcast(LOG2_MIN_ALPHA) <= exponent;
    raw = exp2(exponent);
    alpha = min(raw, broadcast(MAX_ALPHA));
    const Lanes shown = or_zero(visible, alpha);
    const Lanes left = multiply_subtract_from(shown, transmittance, transmittance);
    seen = visible & alive_before;
    alive = (broadcast(MIN_TRANSMITTANCE) <= left) & alive_before;
    drawn = visible & alive;
    weight = or_zero(alive, shown * transmittance);
    after = where(alive, left, transmittance);
  }
};

// Effect of an ellipse.
struct Blend : Effect {
  Lanes t, s;  // along the axes of its square root

  SPLATAX_INLINE Blend(const Chunk& chunk, int i, Lanes x, Lanes y, Lanes transmittance, Mask alive_before) {
    const Lanes dx = x - broadcast(chunk.x[i]), dy = y - broadcast(chunk.y[i]);
    t = multiply_add(broadcast(chunk.u[i]), dx, broadcast(chunk.v[i]) * dy);
    s = broadcast(chunk.w[i]) * dy;
    const Lanes exponent = multiply_subtract_from(s, s, multiply_subtract_from(t, t, broadcast(chunk.level[i])));
    blend(exponent, transmittance, alive_before);
  }
};

// The splats of a chunk as ellipses, with C channels in the chunk itself.
template <int C>
class Ellipses {
 public:
  static constexpr int CHANNELS = C;  // that a chunk gathers

  void gather(const Input&, const Tile&, const Chunk& chunk, int) { chunk_ = &chunk; }
  SPLATAX_INLINE Blend blend(int i, Lanes x, Lanes y, Lanes transmittance, Mask alive) const {
    return Blend(*chunk_, i, x, y, transmittance, alive);
  }
  SPLATAX_INLINE Lanes channel(int i, int c) const { return broadcast(chunk_->channels[c][i]); }

 private:
  const Chunk* chunk_ = nullptr;
};

}  // namespace splatax
