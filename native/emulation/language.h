// The part of CUDA C++ that the kernels use, for C++17 compilers; see fibers.h.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "fibers.h"

namespace emulation {

// All lanes of a warp exchange a value. Returns read(slot), where slot(lane) is a lane's value.
template <class T, class Read>
auto exchange(T value, const Read& read) {
  static_assert(sizeof(T) <= sizeof(uint64_t), "a slot has 8 bytes");
  Block& block = *running_block;
  WarpState& warp = block.warp();
  uint64_t* slots = warp.slots[warp.barrier.generation & 1];
  std::memcpy(&slots[block.thread() % WARP], &value, sizeof value);
  block.wait(warp.barrier);
  return read([slots](int lane) {
    T other;
    std::memcpy(&other, &slots[lane & (WARP - 1)], sizeof other);
    return other;
  });
}

template <class T, class Holds>
unsigned lanes_where(T value, const Holds& holds) {
  return exchange(value, [&](auto slot) {
    unsigned lanes = 0;
    for (int lane = 0; lane < WARP; ++lane) lanes |= static_cast<unsigned>(holds(slot(lane))) << lane;
    return lanes;
  });
}

inline int lane() { return static_cast<int>(running_block->thread() % WARP); }

}  // namespace emulation

#define KERNEL static void
#define INLINE inline
#define __shared__ static thread_local
#define __launch_bounds__(...)
#define threadIdx (emulation::running_block->thread_index())
#define blockIdx (emulation::running_block->index)
#define blockDim (emulation::running_block->size)
#define gridDim (emulation::running_block->grid)

struct alignas(16) float4 {
  float x, y, z, w;
};
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }

inline void __syncthreads() { emulation::running_block->wait(emulation::running_block->barrier); }
inline int __syncthreads_or(int value) {
  emulation::Block& block = *emulation::running_block;
  const uint64_t generation = block.barrier.generation;
  emulation::Vote& vote = block.votes[generation & 1];
  if (vote.generation != generation) vote = {generation, false};
  vote.result |= value != 0;
  block.wait(block.barrier);
  return vote.result;
}
inline void __syncwarp() { emulation::exchange(0, [](auto) { return 0; }); }
template <class T>
T __shfl_up_sync(unsigned, T value, int distance) {
  const int lane = emulation::lane();
  return emulation::exchange(value, [=](auto slot) { return lane < distance ? value : slot(lane - distance); });
}
template <class T>
T __shfl_xor_sync(unsigned, T value, int mask) {
  const int lane = emulation::lane();
  return emulation::exchange(value, [=](auto slot) { return slot(lane ^ mask); });
}
inline unsigned __ballot_sync(unsigned, int vote) {
  return emulation::lanes_where(vote, [](int other) { return other != 0; });
}
inline int __any_sync(unsigned lanes, int vote) { return __ballot_sync(lanes, vote) != 0; }
inline unsigned __match_any_sync(unsigned, unsigned value) {
  return emulation::lanes_where(value, [=](unsigned other) { return other == value; });
}

inline unsigned atomicAdd(unsigned* at, unsigned value) {  // fibers take turns, so nothing comes between
  const unsigned before = *at;
  *at += value;
  return before;
}
inline int __popc(unsigned bits) { return __builtin_popcount(bits); }
inline int __ffs(int bits) { return __builtin_ffs(bits); }
inline unsigned __float_as_uint(float x) {
  unsigned bits;
  std::memcpy(&bits, &x, sizeof bits);
  return bits;
}
inline float __uint_as_float(unsigned bits) {
  float x;
  std::memcpy(&x, &bits, sizeof x);
  return x;
}
inline float __fmul_rn(float a, float b) { return a * b; }  // products are not contracted; see tests/emulated.py
inline float __fadd_rn(float a, float b) { return a + b; }
inline float __fdividef(float a, float b) { return a / b; }
inline float fast_exp2(float x) { return std::exp2(x); }
template <class T>
T min(T a, T b) {
  return b < a ? b : a;
}
template <class T>
T max(T a, T b) {
  return a < b ? b : a;
}
