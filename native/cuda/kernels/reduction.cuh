// Sums N values over the lanes of a warp together: at each of five steps, lanes exchange half of the values
// that they still hold, so nine values take 12 shuffles instead of 45. The order of additions is fixed.
#pragma once

#include "device.cuh"

// Returns the sum over the lanes of the value whose number is `summed_value<N>(lane)`.
template <int N, int DISTANCE = WARP_SIZE / 2>
INLINE float sum_over_lanes(const float (&values)[N], int lane) {
  if constexpr (DISTANCE == 0) {
    static_assert(N == 1, "more values than lanes");
    return values[0];
  } else if constexpr (N == 1) {
    const float sum[1] = {values[0] + __shfl_xor_sync(ALL_LANES, values[0], DISTANCE)};
    return sum_over_lanes<1, DISTANCE / 2>(sum, lane);
  } else {
    constexpr int HALF = (N + 1) / 2;
    const bool upper = lane & DISTANCE;
    float kept[HALF];
#pragma unroll
    for (int k = 0; k < HALF; ++k) {
      const float low = values[k], high = k + HALF < N ? values[k + HALF < N ? k + HALF : k] : 0.0f;
      kept[k] = (upper ? high : low) + __shfl_xor_sync(ALL_LANES, upper ? low : high, DISTANCE);
    }
    return sum_over_lanes<HALF, DISTANCE / 2>(kept, lane);
  }
}

// Returns the number of the value whose sum `sum_over_lanes` leaves in a lane, or -1 if the lane holds padding
// or a copy. A lane holds the values [first, end).
template <int N, int DISTANCE = WARP_SIZE / 2>
INLINE int summed_value(int lane, int first = 0, int end = N) {
  if constexpr (DISTANCE == 0) {
    return first < end ? first : -1;
  } else if constexpr (N == 1) {
    return first < end && (lane & (2 * DISTANCE - 1)) == 0 ? first : -1;
  } else {
    constexpr int HALF = (N + 1) / 2;
    if (lane & DISTANCE) {
      first += HALF;
    } else {
      end = min(end, first + HALF);
    }
    return summed_value<HALF, DISTANCE / 2>(lane, first, end);
  }
}
