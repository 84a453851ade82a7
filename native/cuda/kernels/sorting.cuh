// Stable radix sort of (key, value) items, 8 bits of the keys in a pass.
//
//   1. count_digits   each block counts its items of each digit
//   2. prefix sums    over [digit][block]: where the items of a digit of a block go
//   3. move_items     to those places. Items of one warp stand together, so their order is kept.
#pragma once

#include "sums.cuh"

INLINE int count_of(const Items& items) {
  if (!items.end) return items.most;
  const uint32_t count = *items.end - *items.begin;
  return count <= (uint32_t)items.most ? count : 0;
}

KERNEL __launch_bounds__(BLOCK_SIZE) count_digits(Items items, int shift, const uint32_t* keys, uint32_t* counts) {
  __shared__ uint32_t digits[DIGITS];
  const int n = count_of(items), first = blockIdx.x * SORTED;
  digits[threadIdx.x] = 0;
  __syncthreads();
  for (int i = first + threadIdx.x; i < min(n, first + SORTED); i += BLOCK_SIZE) {
    atomicAdd(&digits[keys[i] >> shift & (DIGITS - 1)], 1u);
  }
  __syncthreads();
  counts[threadIdx.x * gridDim.x + blockIdx.x] = digits[threadIdx.x];
}

KERNEL __launch_bounds__(BLOCK_SIZE) move_items(Items items, int shift, const uint32_t* keys, const uint32_t* values,
                                                const uint32_t* places, uint32_t* sorted_keys,
                                                uint32_t* sorted_values) {
  __shared__ uint32_t next[WARPS][DIGITS];  // place of the next item of a digit of a warp
  constexpr int EACH = SORTED / WARPS;
  const int n = count_of(items);
  if ((int)blockIdx.x * SORTED >= n) return;
  const int lane = lane_number(), warp = warp_number();
  const int first = blockIdx.x * SORTED + warp * EACH;
  for (int digit = lane; digit < DIGITS; digit += WARP_SIZE) next[warp][digit] = 0;
  __syncwarp();
  for (int i = first + lane; i < first + EACH; i += WARP_SIZE) {
    const uint32_t digit = i < n ? keys[i] >> shift & (DIGITS - 1) : DIGITS;
    const unsigned same = __match_any_sync(ALL_LANES, digit);
    if (i < n && __ffs(same) - 1 == lane) next[warp][digit] += __popc(same);
    __syncwarp();
  }
  __syncthreads();
  uint32_t place = places[threadIdx.x * gridDim.x + blockIdx.x];  // one thread for each digit
  for (int w = 0; w < WARPS; ++w) {
    const uint32_t count = next[w][threadIdx.x];
    next[w][threadIdx.x] = place;
    place += count;
  }
  __syncthreads();
  for (int i = first + lane; i < first + EACH; i += WARP_SIZE) {
    const uint32_t key = i < n ? keys[i] : 0;
    const uint32_t digit = i < n ? key >> shift & (DIGITS - 1) : DIGITS;
    const unsigned same = __match_any_sync(ALL_LANES, digit);
    uint32_t own = 0;
    if (i < n) own = next[warp][digit] + __popc(same & ((1u << lane) - 1));
    __syncwarp();
    if (i < n) {
      if (__ffs(same) - 1 == lane) next[warp][digit] += __popc(same);
      sorted_keys[own] = key;
      sorted_values[own] = values[i];
    }
    __syncwarp();
  }
}
