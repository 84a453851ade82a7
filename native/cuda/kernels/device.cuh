// Shared by all kernels. NVRTC compiles the kernels for GPUs, without any CUDA header; any C++17 compiler
// compiles them for the host with native/emulation/language.h.
//
// Rules for kernels: results do not depend on the order in which blocks or warps run, so no two threads add
// floats to the same place.
#pragma once

#ifdef __CUDACC_RTC__
typedef unsigned char uint8_t;
typedef unsigned int uint32_t;
#define KERNEL extern "C" __global__ void
#define INLINE __device__ __forceinline__
// 2^x; relative error at most 2^-22.
INLINE float fast_exp2(float x) {
  float result;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(result) : "f"(x));
  return result;
}
#else
#include "language.h"
#endif

constexpr unsigned ALL_LANES = 0xffffffffu;
constexpr int WARP_SIZE = 32;
constexpr int BLOCK_SIZE = 256;  // threads in a block of every kernel
constexpr int WARPS = BLOCK_SIZE / WARP_SIZE;

// Number of this thread among all threads of the launch.
INLINE int thread_number() { return blockIdx.x * BLOCK_SIZE + threadIdx.x; }
INLINE int lane_number() { return threadIdx.x & (WARP_SIZE - 1); }
INLINE int warp_number() { return threadIdx.x / WARP_SIZE; }

// Whether a number is neither infinite nor NaN.
INLINE bool is_finite(float x) { return fabsf(x) <= 3.402823466e38f; }
