// Adds the records of a splat's pairs in their order, and makes gradients of the sums: one thread for a splat.
//
// With k = sqrt(log2(e) / 2) and s, t scaled by it (see `Ellipse`), alpha = o exp(-(s^2 + t^2) / (2 k^2)), so
//
//   dL/dx = u sum(g s) / k             dL/du = -sum(g s dx) / k       dL/do = sum(g) / o
//   dL/dy = (v sum(g s) + w sum(g t)) / k    dL/dv = -sum(g s dy) / k    dL/dw = -sum(g t dy) / k
//
// where u, v and w are those of `Splats`.
#pragma once

#include "gradient.cuh"

// Adds to what earlier groups of channels contributed; the first group sets.
INLINE void contribute(float* to, float value, bool first) { *to = first ? value : *to + value; }

template <int C>
INLINE void add_records(const SplatRows& splats, const DepthOrder& by_depth, const Round& round,
                        const PairRecords& in, const SplatGradients& out) {
  const int rank = round.begin + thread_number();
  if (rank >= round.end) return;
  const size_t row = by_depth.order[rank];
  float sums[RECORD] = {};
  float root[3] = {}, per_opacity = 0;
  const uint32_t base = by_depth.offsets[round.begin];
  const uint32_t begin = by_depth.offsets[rank] - base, end = by_depth.offsets[rank + 1] - base;
  if (count_of(round.pairs) > 0 && begin < end) {  // the numbers of culled splats may be anything
    for (uint32_t pair = begin; pair < end; ++pair) {
      if (!in.written[pair]) continue;
      const float4* record = (const float4*)(in.records + (size_t)pair * RECORD);
      for (int q = 0; q < RECORD / 4; ++q) {
        const float4 part = record[q];
        sums[4 * q] += part.x;
        sums[4 * q + 1] += part.y;
        sums[4 * q + 2] += part.z;
        sums[4 * q + 3] += part.w;
      }
    }
    for (int k = 0; k < 3; ++k) root[k] = splats.sqrt_conics[3 * row + k] * (1 / ROOT_HALF_LOG2_E);
    per_opacity = splats.opacities[row] > 0 ? 1 / splats.opacities[row] : 0.0f;
  }
  const bool first = out.first == 0;
  contribute(out.means2d + 2 * row, root[0] * sums[1], first);
  contribute(out.means2d + 2 * row + 1, root[1] * sums[1] + root[2] * sums[2], first);
  for (int k = 0; k < 3; ++k) {
    contribute(out.sqrt_conics + 3 * row + k, -sums[3 + k] * (1 / ROOT_HALF_LOG2_E), first);
  }
  contribute(out.opacities + row, sums[0] * per_opacity, first);
  for (int c = 0; c < C; ++c) out.channels[row * splats.channel_count + out.first + c] = sums[MOMENTS + c];
  if (!out.pull) return;
  for (int k = 0; k < 2; ++k) {
    out.pull[2 * row + k] = sums[MOMENTS + C + k] * (1 / (ROOT_HALF_LOG2_E * ROOT_HALF_LOG2_E));
  }
}

#define ADD_RECORDS(C)                                                                                          \
  KERNEL __launch_bounds__(BLOCK_SIZE) add_records_##C(SplatRows splats, DepthOrder by_depth, Round round,      \
                                                       PairRecords in, SplatGradients out) {                    \
    add_records<C>(splats, by_depth, round, in, out);                                                           \
  }
ADD_RECORDS(1)
ADD_RECORDS(3)
ADD_RECORDS(4)
