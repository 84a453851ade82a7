#include "tangent.h"

#include <cmath>

#include "wide.h"

namespace splatax {
namespace {

// Directions of one walk, for one part of the channels.
struct Directions {
  const Direction2d* of;
  int count;
  Part part;
};

// Tangents of a splat's exponent along one direction. With t = u dx + v dy, s = w dy and alpha = o exp(-(t^2 + s^2) / 2),
//
//   dalpha / alpha = do / o - t dt - s ds,   dt = du dx + dv dy - u dmx - v dmy,   ds = dw dy - w dmy .
struct ShapeTangent {
  float du, dv, dw, t, s, level;  // t and s: the parts of dt and ds that are the same at all pixels; level: do / o
};

// Tangents of a chunk's splats, from the rows of the inputs.
template <int K>
struct ChunkTangents {
  ShapeTangent shapes[K][CHUNK];
  ChunkChannels<NARROW_WALK> channels, d_channels[K];

  void gather(const Input& input, const Tile& tile, int first_pair, int count, const Directions& directions) {
    channels.gather(input, tile, first_pair, count, directions.part);
    for (int k = 0; k < directions.count; ++k) {
      const Direction2d& to = directions.of[k];
      Input moved = input;
      moved.channels = to.channels;
      d_channels[k].gather(moved, tile, first_pair, count, directions.part);
      for (int i = 0; i < count; ++i) {
        const size_t row = tile.splats[tile.pairs[first_pair + i].splat].row;
        const float *root = input.sqrt_conics + 3 * row, *d_root = to.sqrt_conics + 3 * row, *d_mean = to.means2d + 2 * row;
        shapes[k][i] = {d_root[0],
                        d_root[1],
                        d_root[2],
                        -(root[0] * d_mean[0] + root[1] * d_mean[1]),
                        -(root[2] * d_mean[1]),
                        to.opacities[row] / input.opacities[row]};
      }
    }
  }
};

// Splats of a chunk that are drawn in a block.
struct Steps : Weights {
  alignas(64) float free[CHUNK][LANES];  // 1 where alpha depends on the splat, else 0
  alignas(64) float odds[CHUNK][LANES];  // alpha / (1 - alpha), else 0
  alignas(64) float t[CHUNK][LANES], s[CHUNK][LANES];  // of the formula above
};

// Derivatives of a tile's image.
template <int K>
struct TileTangent {
  alignas(64) float transmittance[BLOCKS][LANES];  // as in `TileImage`
  alignas(64) float logs[K][BLOCKS][LANES];        // dT / T
  alignas(64) float sums[K][BLOCKS][NARROW_WALK][LANES];

  void clear(const Input& input, const Tile& tile) {
    std::memset(static_cast<void*>(this), 0, sizeof *this);
    let_light_through(input, tile, transmittance);
  }

  void blend(const Input& input, const Tile& tile, const Directions& directions) {
    uint32_t live = live_blocks(transmittance);
    ChunkTangents<K> tangents;
    each_chunk<0>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first_pair) {
      tangents.gather(input, tile, first_pair, chunk.size, directions);
      for (int b = 0; b < BLOCKS; ++b) {
        if (!(live >> b & 1) || !touching[b]) continue;
        Steps list;
        if (!weigh(chunk, touching[b], b, tile, list)) live &= ~(1u << b);
        for (int k = 0; k < directions.count; ++k) push(chunk, tangents, list, b, k, tile, directions.part.size);
      }
    });
  }

 private:
  bool weigh(const Chunk& chunk, uint64_t touching, int b, const Tile& tile, Steps& list) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    const Lanes before = load(transmittance[b]), scale = broadcast(1 / ROOT_HALF_LOG2_E);
    Mask alive = broadcast(0) <= before;
    Lanes T = max(before, broadcast(0) - before);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching), k = list.count;
      const Blend step(chunk, i, x, y, T, alive);
      const Mask flexible = step.drawn & (step.raw <= broadcast(MAX_ALPHA));
      store(list.weight[k], step.weight);
      store(list.free[k], or_zero(flexible, broadcast(1)));
      store(list.odds[k], or_zero(flexible, step.alpha * reciprocal(broadcast(1) - step.alpha)));
      store(list.t[k], or_zero(flexible, step.t * scale)), store(list.s[k], or_zero(flexible, step.s * scale));
      list.splat[k] = i;
      list.count += any(step.drawn);
      T = step.after, alive = step.alive;
      if (!any(alive)) break;
    }
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    return any(alive);
  }

  // Adds the derivative along direction k: of a weight T alpha, T alpha (dT / T + dalpha / alpha).
  void push(const Chunk& chunk, const ChunkTangents<K>& tangents, const Steps& list, int b, int k, const Tile& tile,
            int channel_count) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    alignas(64) float d_weights[CHUNK][LANES];
    Lanes log_T = load(logs[k][b]);
    for (int j = 0; j < list.count; ++j) {
      const int i = list.splat[j];
      const ShapeTangent& shape = tangents.shapes[k][i];
      const Lanes dx = x - broadcast(chunk.x[i]), dy = y - broadcast(chunk.y[i]);
      const Lanes dt = multiply_add(broadcast(shape.du), dx, multiply_add(broadcast(shape.dv), dy, broadcast(shape.t)));
      const Lanes ds = multiply_add(broadcast(shape.dw), dy, broadcast(shape.s));
      const Lanes log_alpha = multiply_subtract_from(
          load(list.t[j]), dt, multiply_subtract_from(load(list.s[j]), ds, load(list.free[j]) * broadcast(shape.level)));
      store(d_weights[j], load(list.weight[j]) * (log_T + log_alpha));
      log_T = multiply_subtract_from(load(list.odds[j]), log_alpha, log_T);
    }
    store(logs[k][b], log_T);
    for (int c = 0; c < channel_count; c += 4) add(tangents, list, d_weights, c, k, sums[k][b] + c);
  }

  static void add(const ChunkTangents<K>& tangents, const Steps& list, const float (*d_weights)[LANES], int first, int k,
                  float (*to)[LANES]) {
    Lanes sum[4];
    for (int c = 0; c < 4; ++c) sum[c] = load(to[c]);
    for (int j = 0; j < list.count; ++j) {
      const float* channels = tangents.channels.rows[list.splat[j]] + first;
      const float* moving = tangents.d_channels[k].rows[list.splat[j]] + first;
      const Lanes weight = load(list.weight[j]), d_weight = load(d_weights[j]);
#pragma GCC unroll 4
      for (int c = 0; c < 4; ++c) {
        sum[c] = multiply_add(d_weight, broadcast(channels[c]), multiply_add(weight, broadcast(moving[c]), sum[c]));
      }
    }
    for (int c = 0; c < 4; ++c) store(to[c], sum[c]);
  }
};

template <int K>
void push_part(const Input& input, const Directions& directions, Workers& workers, Scratch& scratch) {
  const Part part = directions.part;
  TileStates<TileTangent<K>> states(scratch.binning, scratch);
  each_round(scratch.binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, TileTangent<K>& state) {
      if (round.begin == 0) state.clear(input, tile);
      state.blend(input, tile, directions);
      if (round.end < scratch.binning.visible) return;
      each_pixel(input, tile, [&](int b, int lane, size_t pixel) {
        const float T = std::abs(state.transmittance[b][lane]);
        for (int k = 0; k < directions.count; ++k) {
          float* sums = directions.of[k].sums + pixel * input.channel_count + part.first;
          for (int c = 0; c < part.size; ++c) sums[c] = state.sums[k][b][c][lane];
          if (part.first == 0) directions.of[k].alpha[pixel] = -T * state.logs[k][b][lane];  // alpha is 1 - T
        }
      });
    });
  });
}

}  // namespace

void rasterize_tangent(const Input& input, const Direction2d* directions, int count, Workers& workers, Scratch& scratch,
                       int64_t max_pairs) {
  scratch.binning.collect(input, workers, max_pairs);
  // In several rounds the states of all tiles are kept: those of one direction are small enough.
  const int together = scratch.binning.rounds.size() == 1 ? MOST_DIRECTIONS : 1;
  for (int first = 0; first < count; first += together) {
    Part part{0, 0};
    do {
      part.size = std::min(NARROW_WALK, input.channel_count - part.first);
      const Directions some{directions + first, std::min(together, count - first), part};
      (some.count == 1 ? push_part<1> : push_part<MOST_DIRECTIONS>)(input, some, workers, scratch);
      part.first += NARROW_WALK;
    } while (part.first < input.channel_count);
  }
}

}  // namespace splatax
