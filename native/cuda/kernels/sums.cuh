// Exclusive prefix sums of 32-bit counts. A sum that would exceed 32 bits stays at the largest number.
#pragma once

#include "arguments.cuh"
#include "device.cuh"

INLINE uint32_t saturating_sum(uint32_t a, uint32_t b) {
  const uint32_t sum = a + b;
  return sum < a ? ~0u : sum;
}

// Returns the sum of the values of the threads before this one in the block, and sets the sum of all.
INLINE uint32_t sum_before(uint32_t value, uint32_t* total) {
  __shared__ uint32_t warp_sums[WARPS];
  const int lane = lane_number(), warp = warp_number();
  uint32_t sum = value;
  for (int distance = 1; distance < WARP_SIZE; distance *= 2) {
    const uint32_t other = __shfl_up_sync(ALL_LANES, sum, distance);
    if (lane >= distance) sum = saturating_sum(sum, other);
  }
  if (lane == WARP_SIZE - 1) warp_sums[warp] = sum;
  __syncthreads();
  uint32_t before = 0, all = 0;
  for (int w = 0; w < WARPS; ++w) {
    if (w == warp) before = all;
    all = saturating_sum(all, warp_sums[w]);
  }
  __syncthreads();
  *total = all;
  return before + sum - value;
}

// Sums up each run of SCAN numbers on its own; `out` may be `in`.
KERNEL __launch_bounds__(BLOCK_SIZE) sum_runs(int n, const uint32_t* in, uint32_t* out, uint32_t* run_sums) {
  uint32_t carry = 0;
  for (int i = blockIdx.x * SCAN + threadIdx.x, left = SCAN; left > 0; i += BLOCK_SIZE, left -= BLOCK_SIZE) {
    uint32_t total;
    const uint32_t before = sum_before(i < n ? in[i] : 0, &total);
    if (i < n) out[i] = carry + before;
    carry = saturating_sum(carry, total);
  }
  if (threadIdx.x == 0) run_sums[blockIdx.x] = carry;
}

// Sums up the sums of the runs, in one block.
KERNEL __launch_bounds__(BLOCK_SIZE) sum_run_sums(int runs, uint32_t* run_sums, uint32_t* grand_total) {
  uint32_t carry = 0;
  for (int base = 0; base < runs; base += BLOCK_SIZE) {
    const int i = base + threadIdx.x;
    uint32_t total;
    const uint32_t before = sum_before(i < runs ? run_sums[i] : 0, &total);
    if (i < runs) run_sums[i] = carry + before;
    carry = saturating_sum(carry, total);
  }
  if (threadIdx.x == 0) *grand_total = carry;
}

KERNEL __launch_bounds__(BLOCK_SIZE) add_run_sums(int n, uint32_t* out, const uint32_t* run_sums) {
  const int i = thread_number();
  if (i < n) out[i] += run_sums[i / SCAN];
}
