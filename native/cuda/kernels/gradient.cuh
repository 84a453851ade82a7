// Gradient of a tile's chunk of splats: one block for a chunk, one thread for a pixel, front to back from the
// blend's checkpoint and its final sums.
//
// Let s_i = <c_i, dL/dC> + dL/dA, for sums C and alpha A, and weights w_i = T_i a_i. The sum of all w_i s_i is
// known: <C, dL/dC> + A dL/dA. The sum over the splats behind splat i is this total minus the sum up to i, so
//
//   g_i = a_i dL/da_i = w_i s_i - a_i / (1 - a_i) sum_{j>i} w_j s_j .
//
// A pair's record holds sums over pixels of g, g s, g t, g s dx, g s dy, g t dy, then dL/d channels, then, if
// requested, |dL/dx| and |dL/dy|. `add_records` makes gradients of them. No two threads add to one place.
#pragma once

#include "pixels.cuh"
#include "reduction.cuh"
#include "sorting.cuh"

constexpr int MOMENTS = 6;
constexpr int SLICE = 64;  // splats whose sums of each warp fit into shared memory at a time

// Tile of a chunk: the last one whose chunks begin at or before it.
INLINE int tile_of_chunk(const TileLists& lists, int tiles, int chunk) {
  int low = 0, high = tiles;
  while (high - low > 1) {
    const int middle = (low + high) / 2;
    if ((int)lists.first_chunks[middle] <= chunk) {
      low = middle;
    } else {
      high = middle;
    }
  }
  return low;
}

// State of one pixel between splats.
template <int C>
struct Ray {
  float T;           // transmittance
  float behind;      // sum of w_j s_j over the splats yet to come
  float d_sums[C], d_alpha;
  bool alive;

  INLINE Ray(const Pixel& pixel, const Frame& frame, const SplatRows& splats, const float* saved,
             const ImageGradient& image) : T(0), behind(0), d_sums{}, d_alpha(0), alive(false) {
    if (!pixel.inside) return;
    const size_t index = pixel.index(frame), at = index * splats.channel_count + image.first;
    alive = saved[pixel.in_tile] > 0;
    T = fabsf(saved[pixel.in_tile]);
    if (image.first == 0) d_alpha = image.d_alpha[index];  // counted once, with the first channels
    behind = d_alpha * (T - (1 - image.alpha[index]));
    for (int c = 0; c < C; ++c) {
      d_sums[c] = image.d_sums[at + c];
      const float before = saved[(1 + image.first + c) * PIXELS + pixel.in_tile];
      behind = fmaf(d_sums[c], image.sums[at + c] - before, behind);
    }
  }

  // Sets the sums of a splat at this pixel, and moves behind it.
  template <int N>
  INLINE void pass(const Ellipse& e, const float* channels, const Blend& step, float (&sums)[N]) {
    float value = d_alpha;
    for (int c = 0; c < C; ++c) {
      value = fmaf(channels[c], d_sums[c], value);
      sums[MOMENTS + c] = step.weight * d_sums[c];
    }
    const float own = step.weight * value;
    behind -= own;
    T = step.after;
    const float odds = __fdividef(step.alpha, 1 - step.alpha);
    const float g = step.clamped ? 0.0f : fmaf(-odds, behind, own), gs = g * step.s, gt = g * step.t;
    sums[0] = g;
    sums[1] = gs;
    sums[2] = gt;
    sums[3] = gs * step.dx;
    sums[4] = gs * step.dy;
    sums[5] = gt * step.dy;
    if constexpr (N > MOMENTS + C) {
      sums[MOMENTS + C] = fabsf(e.u * gs);
      sums[MOMENTS + C + 1] = fabsf(fmaf(e.v, gs, e.w * gt));
    }
  }
};

template <int C, bool PULLED>
INLINE void blend_gradient(const SplatRows& splats, const Frame& frame, const Items& items, const TileLists& lists,
                           const ImageGradient& image, const PairRecords& out) {
  constexpr int N = MOMENTS + C + (PULLED ? 2 : 0);
  static_assert(N <= RECORD, "a record is too short");
  __shared__ Ellipse ellipses[SLICE];
  __shared__ float channels[SLICE][C];
  __shared__ float partial[WARPS][SLICE][N];
  __shared__ unsigned found[WARPS][SLICE / WARP_SIZE];  // splats with a partial sum
  const int tiles = frame.columns * frame.rows, chunk = blockIdx.x;
  if (count_of(items) == 0 || chunk >= (int)lists.first_chunks[tiles]) return;
  const int tile = tile_of_chunk(lists, tiles, chunk), number = chunk - lists.first_chunks[tile];
  if (number >= (int)lists.last_chunks[tile]) return;
  const int begin = lists.starts[tile] + number * CHUNK, end = min((int)lists.starts[tile + 1], begin + CHUNK);
  const Pixel pixel(frame, tile);
  Ray<C> ray(pixel, frame, splats, lists.checkpoints + chunk * checkpoint_size(splats), image);
  const int lane = lane_number(), warp = warp_number(), own_value = summed_value<N>(lane);

  for (int base = begin; base < end; base += SLICE) {
    const int count = min(SLICE, end - base);
    load_splats<C>(splats, lists, lists.pairs + base, count, image.first, ellipses, channels);
    __syncthreads();
    for (int k = 0; k < SLICE; k += WARP_SIZE) {
      unsigned summed = 0;
      const bool any_alive = __any_sync(ALL_LANES, ray.alive);
      for (unsigned hits = any_alive && k < count ? touching(ellipses, k, count, pixel) : 0; hits; hits &= hits - 1) {
        const int bit = __ffs(hits) - 1, i = k + bit;
        const Blend step(ellipses[i], pixel, ray.T);
        const bool drawn = ray.alive && step.drawn && !step.finished;
        if (step.drawn && step.finished) ray.alive = false;
        if (!__any_sync(ALL_LANES, drawn)) continue;
        float sums[N] = {};
        if (drawn) ray.pass(ellipses[i], channels[i], step, sums);
        const float total = sum_over_lanes<N>(sums, lane);
        if (own_value >= 0) partial[warp][i][own_value] = total;
        summed |= 1u << bit;
      }
      if (lane == 0) found[warp][k / WARP_SIZE] = summed;
    }
    __syncthreads();
    for (int k = threadIdx.x; k < count; k += BLOCK_SIZE) {
      float sums[RECORD] = {};
      bool drawn = false;
      for (int w = 0; w < WARPS; ++w) {
        if (!(found[w][k / WARP_SIZE] >> k % WARP_SIZE & 1)) continue;
        drawn = true;
        for (int q = 0; q < N; ++q) sums[q] += partial[w][k][q];
      }
      if (!drawn) continue;
      const uint32_t pair = lists.pairs[base + k];
      float4* record = (float4*)(out.records + (size_t)pair * RECORD);
      for (int q = 0; q < RECORD / 4; ++q) {
        record[q] = make_float4(sums[4 * q], sums[4 * q + 1], sums[4 * q + 2], sums[4 * q + 3]);
      }
      out.written[pair] = 1;
    }  // the next slice overwrites the partial sums after its barrier
  }
}

#define BLEND_GRADIENT(NAME, C, PULLED)                                                                          \
  KERNEL __launch_bounds__(BLOCK_SIZE, RESIDENT) NAME(SplatRows splats, Frame frame, Items items, TileLists lists,         \
                                            ImageGradient image, PairRecords out) {                              \
    blend_gradient<C, PULLED>(splats, frame, items, lists, image, out);                                          \
  }
BLEND_GRADIENT(blend_gradient_1, 1, false)
BLEND_GRADIENT(blend_gradient_3, 3, false)
BLEND_GRADIENT(blend_gradient_4, 4, false)
BLEND_GRADIENT(blend_gradient_pulled_1, 1, true)
BLEND_GRADIENT(blend_gradient_pulled_3, 3, true)
BLEND_GRADIENT(blend_gradient_pulled_4, 4, true)
