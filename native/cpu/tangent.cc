#include "tangent.h"

#include <cmath>

#include "wide.h"

namespace splatax {
namespace {

#if defined(__AVX512F__)
constexpr int DIRECTIONS_AT_ONCE = 3;  // whose sums stay in registers together
#else
constexpr int DIRECTIONS_AT_ONCE = 1;
#endif
constexpr int SHAPE = 6;  // numbers of the tangent of a splat's exponent
constexpr float UNSCALED = 1 / ROOT_HALF_LOG2_E;  // of t and s, which `Blend` scales

// Keeps numbers in a register. Compilers would read them from memory again for each direction, and loads are the bottleneck.
SPLATAX_INLINE Lanes held(Lanes a) {
#if defined(__AVX512F__)
  asm("" : "+v"(a.v));
#endif
  return a;
}

// Directions of one walk, for one part of the channels.
struct Directions {
  const Direction2d* of;
  int count;
  int together;  // of `together_of`
  Part part;

  // Channels of a row: RGB, or whole groups, padded with zeros.
  int channels() const { return part.size == 3 ? 3 : std::max((part.size + GROUP - 1) / GROUP, 1) * GROUP; }
};

// The number of directions to write at a time: all, if their derivatives are next to each other in one image, else one.
int together_of(const Direction2d* directions, int count) {
  for (int k = 1; k < count; ++k) {
    if (directions[k].alpha != directions[0].alpha || directions[k].number != directions[0].number + k) return 1;
  }
  return count;
}

// What a walk needs of each splat, in the order of the input: channels, then shape and channels of each direction. One
// walk reads the rows of a splat at many places; rows of the arrays of all directions would be as many cache misses.
//
// With t = u dx + v dy, s = w dy and alpha = o exp(-(t^2 + s^2) / 2), the shape has the numbers by which dalpha / alpha is
//
//   do / o + t (u dmx + v dmy - du dx - dv dy) + s (w dmy - dw dy) .
class Rows {
 public:
  Rows(const Input& input, const Directions& directions, Workers& workers, Buffer<float>& memory)
      : size_(directions.channels()), stride_(size_ + directions.count * (SHAPE + size_)) {
    first_ = memory.at_least(static_cast<size_t>(input.count) * stride_);
    workers.ranges(input.count, [&](int, int begin, int end) {
      for (int row = begin; row < end; ++row) {
        if (input.extents[2 * static_cast<size_t>(row)] > 0) write(input, directions, row, first_ + row * stride_);
      }
    });
  }

  const float* channels(int row) const { return first_ + row * stride_; }
  // Begins to load the row of a splat whose channels these are.
  void prefetch(const float* channels) const {
    for (size_t i = 0; i < stride_; i += 64 / sizeof(float)) __builtin_prefetch(channels + i);
  }
  // Tangents of that splat's shape along direction k.
  const float* shape(const float* channels, int k) const { return channels + size_ + k * (SHAPE + size_); }

 private:
  void write(const Input& input, const Directions& directions, size_t row, float* to) const {
    const float* root = input.sqrt_conics + 3 * row;
    to = copy(input, directions.part, input.channels, row, to);
    for (int k = 0; k < directions.count; ++k) {
      const Direction2d& along = directions.of[k];
      const float *d_root = along.sqrt_conics + 3 * row, *d_mean = along.means2d + 2 * row;
      const float shape[SHAPE] = {along.opacities[row] / input.opacities[row],
                                  -UNSCALED * d_root[0],
                                  -UNSCALED * d_root[1],
                                  -UNSCALED * d_root[2],
                                  UNSCALED * (root[0] * d_mean[0] + root[1] * d_mean[1]),
                                  UNSCALED * (root[2] * d_mean[1])};
      to = copy(input, directions.part, along.channels, row, std::copy_n(shape, SHAPE, to));
    }
  }
  float* copy(const Input& input, Part part, const float* channels, size_t row, float* to) const {
    std::copy_n(channels + row * input.channel_count + part.first, part.size, to);
    std::fill(to + part.size, to + size_, 0.0f);
    return to + size_;
  }

  const int size_;
  const size_t stride_;
  float* first_;
};

// Splats of a chunk that are drawn in a block.
struct Steps {
  const float* rows[CHUNK];  // of `Rows`
  int count = 0;
  alignas(64) float weight[CHUNK][LANES];        // T alpha
  alignas(64) float odds[CHUNK][LANES];          // alpha / (1 - alpha)
  alignas(64) float dx[CHUNK][LANES], dy[CHUNK][LANES], t[CHUNK][LANES], s[CHUNK][LANES];  // as in `Blend`
  Mask flexible[CHUNK];                          // where alpha depends on the splat
};

// Derivatives of a tile's image along up to K directions, by up to W channels.
template <int K, int W>
struct TileTangent {
  alignas(64) float transmittance[BLOCKS][LANES];  // as in `TileImage`
  alignas(64) float logs[BLOCKS][K][LANES];        // dT / T
  alignas(64) float sums[BLOCKS][K][W][LANES];

  void clear(const Input& input, const Tile& tile, int channels) {
    std::memset(static_cast<void*>(logs), 0, sizeof logs);
    for (auto& block : sums) {
      for (auto& sum : block) std::memset(static_cast<void*>(sum), 0, channels * sizeof sum[0]);
    }
    let_light_through(input, tile, transmittance);
  }

  void blend(const Tile& tile, const Rows& rows, const Directions& directions) {
    uint32_t live = live_blocks(transmittance);
    const float* of_chunk[CHUNK];
    each_chunk<0>(tile, live, [&](const Chunk& chunk, const uint64_t* touching, int first_pair) {
      for (int i = 0; i < chunk.size; ++i) {
        of_chunk[i] = rows.channels(tile.splats[tile.pairs[first_pair + i].splat].row);
        rows.prefetch(of_chunk[i]);
      }
      for (int b = 0; b < BLOCKS; ++b) {
        if (!(live >> b & 1) || !touching[b]) continue;
        Steps list;
        if (!weigh(chunk, of_chunk, touching[b], b, tile, list)) live &= ~(1u << b);
        int k = 0;
        if constexpr (K >= DIRECTIONS_AT_ONCE) {
          for (; k + DIRECTIONS_AT_ONCE <= directions.count; k += DIRECTIONS_AT_ONCE) {
            push<DIRECTIONS_AT_ONCE>(rows, list, b, k, directions);
          }
        }
        for (; k < directions.count; ++k) push<1>(rows, list, b, k, directions);
      }
    });
  }

 private:
  bool weigh(const Chunk& chunk, const float* const* rows, uint64_t touching, int b, const Tile& tile, Steps& list) {
    const PixelCentres centres;
    const Lanes x = centres.x + broadcast(tile.left + block_left(b)), y = centres.y + broadcast(tile.top + block_top(b));
    const Lanes before = load(transmittance[b]);
    Mask alive = broadcast(0) <= before;
    Lanes T = max(before, broadcast(0) - before);
    for (; touching; touching &= touching - 1) {
      const int i = __builtin_ctzll(touching), j = list.count;
      const Blend step(chunk, i, x, y, T, alive);
      list.flexible[j] = step.drawn & (step.raw <= broadcast(MAX_ALPHA));
      store(list.dx[j], x - broadcast(chunk.x[i]));
      store(list.dy[j], y - broadcast(chunk.y[i]));
      store(list.t[j], step.t);
      store(list.s[j], step.s);
      store(list.weight[j], step.weight);
      store(list.odds[j], step.alpha * reciprocal(broadcast(1) - step.alpha));
      list.rows[j] = rows[i];
      list.count += any(step.drawn);
      T = step.after;
      alive = step.alive;
      if (!any(alive)) break;
    }
    store(transmittance[b], where(alive, T, broadcast(0) - T));
    return any(alive);
  }

  // Adds the derivatives along D directions from k on.
  template <int D>
  void push(const Rows& rows, const Steps& list, int b, int k, const Directions& directions) {
    alignas(64) float rates[D][CHUNK][LANES];  // for further channels
    if (directions.channels() == 3) return add<D, 3, true>(rows, list, b, k, 0, rates);
    add<D, GROUP, true>(rows, list, b, k, 0, rates);
    for (int c = GROUP; c < directions.part.size; c += GROUP) add<D, GROUP, false>(rows, list, b, k, c, rates);
  }

  // Adds C channels, and if they are the first ones, finds the relative derivatives of the weights: of T alpha,
  // dT / T + dalpha / alpha.
  template <int D, int C, bool FIRST>
  SPLATAX_INLINE void add(const Rows& rows, const Steps& list, int b, int k, int first, float (*rates)[CHUNK][LANES]) {
    Lanes log_T[D], sum[D][C];
    for (int d = 0; d < D; ++d) {
      log_T[d] = load(logs[b][k + d]);
      for (int c = 0; c < C; ++c) sum[d][c] = load(sums[b][k + d][first + c]);
    }
    for (int j = 0; j < list.count; ++j) {
      const Lanes weight = held(load(list.weight[j])), odds = held(load(list.odds[j]));
      const Lanes dx = held(load(list.dx[j])), dy = held(load(list.dy[j]));
      const Lanes t = held(load(list.t[j])), s = held(load(list.s[j]));
      const Mask flexible = list.flexible[j];
      const float* channels = list.rows[j];
      Lanes own[C];
      for (int c = 0; c < C; ++c) own[c] = held(broadcast(channels[first + c]));
#pragma GCC unroll 3
      for (int d = 0; d < D; ++d) {
        const float* shape = rows.shape(channels, k + d);
        Lanes rate;
        if constexpr (FIRST) {
          const Lanes across = multiply_add(dx, broadcast(shape[1]), multiply_add(dy, broadcast(shape[2]), broadcast(shape[4])));
          const Lanes down = multiply_add(dy, broadcast(shape[3]), broadcast(shape[5]));
          const Lanes log_alpha = or_zero(flexible, multiply_add(t, across, multiply_add(s, down, broadcast(shape[0]))));
          rate = log_T[d] + log_alpha;
          log_T[d] = multiply_subtract_from(odds, log_alpha, log_T[d]);
          if constexpr (W > GROUP) store(rates[d][j], rate);
        } else {
          rate = load(rates[d][j]);
        }
        const float* moving = shape + SHAPE + first;
#pragma GCC unroll 4
        for (int c = 0; c < C; ++c) {
          const Lanes d_channel = multiply_add(rate, own[c], broadcast(moving[c]));
          sum[d][c] = multiply_add(weight, d_channel, sum[d][c]);
        }
      }
    }
    for (int d = 0; d < D; ++d) {
      store(logs[b][k + d], log_T[d]);
      for (int c = 0; c < C; ++c) store(sums[b][k + d][first + c], sum[d][c]);
    }
  }
};

template <int K, int W>
void write_sums(const Input& input, const Tile& tile, const Directions& directions, const float (&sums)[BLOCKS][K][W][LANES]) {
  const Part part = directions.part;
  const int together = directions.together;
  for (int k = 0; k < directions.count; k += together) {
    const Direction2d& to = directions.of[k];
    const size_t stride = static_cast<size_t>(input.channel_count) * to.spacing;
    float* image = to.sums + static_cast<size_t>(part.first) * to.spacing + to.number;
    if (together == to.spacing) {  // all numbers of a pixel are next to each other
      write_pixels(input, tile, image, stride, part.size * together,
                   [&](int b, int i) { return sums[b][k + i % together][i / together]; });
      continue;
    }
    for (int c = 0; c < part.size; ++c, image += to.spacing) {
      write_pixels(input, tile, image, stride, together, [&](int b, int i) { return sums[b][k + i][c]; });
    }
  }
}

// The derivative of alpha, which is 1 - T.
template <int K>
void write_alpha(const Input& input, const Tile& tile, const Directions& directions, const float (&transmittance)[BLOCKS][LANES],
                 const float (&logs)[BLOCKS][K][LANES]) {
  alignas(64) float alphas[BLOCKS][K][LANES];
  for (int b = 0; b < BLOCKS; ++b) {
    const Lanes T = absolute(load(transmittance[b]));
    for (int k = 0; k < directions.count; ++k) store(alphas[b][k], -(T * load(logs[b][k])));
  }
  const int together = directions.together;
  for (int k = 0; k < directions.count; k += together) {
    const Direction2d& to = directions.of[k];
    write_pixels(input, tile, to.alpha + to.number, to.spacing, together, [&](int b, int i) { return alphas[b][k + i]; });
  }
}

template <int K, int W>
void push_part(const Input& input, const Directions& directions, Workers& workers, Scratch& scratch) {
  const Part part = directions.part;
  const Rows rows(input, directions, workers, scratch.partial_sums);
  TileStates<TileTangent<K, W>> states(scratch.binning, scratch);
  each_round(scratch.binning, workers, [&](const Round& round) {
    states.each_tile(workers, [&](const Tile& tile, TileTangent<K, W>& state) {
      if (round.begin == 0) state.clear(input, tile, directions.channels());
      state.blend(tile, rows, directions);
      if (round.end < scratch.binning.visible) return;
      write_sums(input, tile, directions, state.sums);
      if (part.first == 0) write_alpha(input, tile, directions, state.transmittance, state.logs);
    });
  });
}

}  // namespace

void rasterize_tangent(const Input& input, const Direction2d* directions, int count, Workers& workers, Scratch& scratch,
                       int64_t max_pairs) {
  scratch.binning.collect(input, workers, max_pairs);
  // In several rounds the states of all tiles are kept: those of one direction are small enough.
  const int most = scratch.binning.rounds.size() == 1 ? MOST_DIRECTIONS : 1;
  for (int first = 0; first < count; first += most) {
    const int size = std::min(most, count - first);
    const int together = together_of(directions + first, size);
    Part part{0, 0};
    do {
      part.size = std::min(NARROW_WALK, input.channel_count - part.first);
      const Directions some{directions + first, size, together, part};
      const bool few = part.size <= GROUP;
      const auto push = some.count == 1 ? (few ? push_part<1, GROUP> : push_part<1, NARROW_WALK>)
                                        : (few ? push_part<MOST_DIRECTIONS, GROUP> : push_part<MOST_DIRECTIONS, NARROW_WALK>);
      push(input, some, workers, scratch);
      part.first += NARROW_WALK;
    } while (part.first < input.channel_count);
  }
}

}  // namespace splatax
