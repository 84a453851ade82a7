// Sixteen floats at once: the pixels of a 4 x 4 block, or sixteen splats.
//
// Vectors have the width of the machine: one register of AVX-512, two of AVX2, four of SSE2 or
// NEON. (Asked for a vector wider than the machine's, GCC splits it into code 4 to 5 times slower.)
// This file is compiled once for each instruction set, into a library of its own.
#pragma once

#ifdef SPLATAX_HANDLERS
#error "Handlers are shared between builds, whose lanes differ: see CMakeLists.txt"
#endif

#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#endif

namespace splatax {

// Passing vectors to a function through memory would cost more than the function itself.
#define SPLATAX_INLINE inline __attribute__((always_inline))

constexpr int LANES = 16;
constexpr int MANTISSA = 23;               // bits
constexpr uint32_t ROOT_HALF = 0x3f3504f3;  // the bits of sqrt(1/2)

#if defined(__AVX512F__)

struct Lanes {
  __m512 v;
};
struct Mask {
  __mmask16 m;
};

SPLATAX_INLINE Lanes broadcast(float x) { return {_mm512_set1_ps(x)}; }
SPLATAX_INLINE Lanes load(const float* from) { return {_mm512_loadu_ps(from)}; }
SPLATAX_INLINE void store(float* to, Lanes a) { _mm512_storeu_ps(to, a.v); }
SPLATAX_INLINE Lanes operator+(Lanes a, Lanes b) { return {_mm512_add_ps(a.v, b.v)}; }
SPLATAX_INLINE Lanes operator-(Lanes a, Lanes b) { return {_mm512_sub_ps(a.v, b.v)}; }
SPLATAX_INLINE Lanes operator*(Lanes a, Lanes b) { return {_mm512_mul_ps(a.v, b.v)}; }
SPLATAX_INLINE Lanes operator/(Lanes a, Lanes b) { return {_mm512_div_ps(a.v, b.v)}; }
SPLATAX_INLINE Lanes sqrt(Lanes a) { return {_mm512_sqrt_ps(a.v)}; }
SPLATAX_INLINE Lanes ceil(Lanes a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_POS_INF)}; }
SPLATAX_INLINE Lanes floor(Lanes a) { return {_mm512_roundscale_ps(a.v, _MM_FROUND_TO_NEG_INF)}; }
SPLATAX_INLINE Lanes multiply_add(Lanes a, Lanes b, Lanes c) { return {_mm512_fmadd_ps(a.v, b.v, c.v)}; }
SPLATAX_INLINE Lanes multiply_subtract_from(Lanes a, Lanes b, Lanes c) { return {_mm512_fnmadd_ps(a.v, b.v, c.v)}; }
SPLATAX_INLINE Lanes min(Lanes a, Lanes b) { return {_mm512_min_ps(a.v, b.v)}; }
SPLATAX_INLINE Lanes max(Lanes a, Lanes b) { return {_mm512_max_ps(a.v, b.v)}; }
SPLATAX_INLINE Mask operator<=(Lanes a, Lanes b) { return {_mm512_cmp_ps_mask(a.v, b.v, _CMP_LE_OQ)}; }
SPLATAX_INLINE Mask operator&(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & b.m)}; }
SPLATAX_INLINE Mask and_not(Mask a, Mask b) { return {static_cast<__mmask16>(a.m & ~b.m)}; }
SPLATAX_INLINE uint32_t bits(Mask a) { return a.m; }
SPLATAX_INLINE Lanes where(Mask mask, Lanes a, Lanes b) { return {_mm512_mask_mov_ps(b.v, mask.m, a.v)}; }
SPLATAX_INLINE Lanes or_zero(Mask mask, Lanes a) { return {_mm512_maskz_mov_ps(mask.m, a.v)}; }

// 1 / x to within one bit of float32 rounding: an estimate and a Newton step.
SPLATAX_INLINE Lanes reciprocal(Lanes x) {
  const Lanes estimate{_mm512_rcp14_ps(x.v)};
  return estimate * multiply_subtract_from(x, estimate, broadcast(2));
}

SPLATAX_INLINE Lanes round(Lanes x) { return {_mm512_roundscale_ps(x.v, _MM_FROUND_TO_NEAREST_INT)}; }
SPLATAX_INLINE Lanes times_power_of_two(Lanes x, Lanes integer) { return {_mm512_scalef_ps(x.v, integer.v)}; }

#else

#if defined(__AVX2__)
constexpr int WIDTH = 8;
#else
constexpr int WIDTH = 4;
#endif
constexpr int PARTS = LANES / WIDTH;
typedef float Floats __attribute__((vector_size(4 * WIDTH)));
typedef int32_t Ints __attribute__((vector_size(4 * WIDTH)));
typedef uint32_t Words __attribute__((vector_size(4 * WIDTH)));  // differences of these wrap around

struct Lanes {
  Floats v[PARTS];
};
struct Mask {
  Ints m[PARTS];
};

// Calls operation(part) for each native vector; unrolled, because PARTS is a constant.
template <class Result, class Operation>
SPLATAX_INLINE Result each_part(Operation operation) {
  Result result;
#pragma GCC unroll 4
  for (int part = 0; part < PARTS; ++part) operation(result, part);
  return result;
}
#define SPLATAX_LANES(expression) \
  each_part<Lanes>([&](Lanes& result, int k) __attribute__((always_inline)) { result.v[k] = expression; })
#define SPLATAX_MASK(expression) \
  each_part<Mask>([&](Mask& result, int k) __attribute__((always_inline)) { result.m[k] = expression; })

SPLATAX_INLINE Lanes broadcast(float x) { return SPLATAX_LANES(x - Floats{}); }
// Copies vector by vector: a copy of the whole goes through memory in pieces of another size, and stalls.
SPLATAX_INLINE Lanes load(const float* from) {
  Lanes result;
#pragma GCC unroll 4
  for (int k = 0; k < PARTS; ++k) std::memcpy(&result.v[k], from + WIDTH * k, sizeof(Floats));
  return result;
}
SPLATAX_INLINE void store(float* to, Lanes a) {
#pragma GCC unroll 4
  for (int k = 0; k < PARTS; ++k) std::memcpy(to + WIDTH * k, &a.v[k], sizeof(Floats));
}
SPLATAX_INLINE Lanes operator+(Lanes a, Lanes b) { return SPLATAX_LANES(a.v[k] + b.v[k]); }
SPLATAX_INLINE Lanes operator-(Lanes a, Lanes b) { return SPLATAX_LANES(a.v[k] - b.v[k]); }
SPLATAX_INLINE Lanes operator*(Lanes a, Lanes b) { return SPLATAX_LANES(a.v[k] * b.v[k]); }
SPLATAX_INLINE Lanes operator/(Lanes a, Lanes b) { return SPLATAX_LANES(a.v[k] / b.v[k]); }
// Calls operation(number) for each number. Those below are one instruction a vector; without SSE 4.1, rounding is not.
template <class Operation>
SPLATAX_INLINE Lanes each_number(Lanes a, Operation operation) {
  float values[LANES];
  std::memcpy(values, &a, sizeof a);
  for (float& value : values) value = operation(value);
  return load(values);
}
SPLATAX_INLINE Lanes sqrt(Lanes a) { return each_number(a, [](float x) { return __builtin_sqrtf(x); }); }
SPLATAX_INLINE Lanes ceil(Lanes a) { return each_number(a, [](float x) { return __builtin_ceilf(x); }); }
SPLATAX_INLINE Lanes floor(Lanes a) { return each_number(a, [](float x) { return __builtin_floorf(x); }); }
// Compilers contract these where the machine has fused multiply-add.
SPLATAX_INLINE Lanes multiply_add(Lanes a, Lanes b, Lanes c) { return SPLATAX_LANES(a.v[k] * b.v[k] + c.v[k]); }
SPLATAX_INLINE Lanes multiply_subtract_from(Lanes a, Lanes b, Lanes c) {
  return SPLATAX_LANES(c.v[k] - a.v[k] * b.v[k]);
}
SPLATAX_INLINE Lanes min(Lanes a, Lanes b) { return SPLATAX_LANES(a.v[k] < b.v[k] ? a.v[k] : b.v[k]); }
SPLATAX_INLINE Lanes max(Lanes a, Lanes b) { return SPLATAX_LANES(a.v[k] > b.v[k] ? a.v[k] : b.v[k]); }
SPLATAX_INLINE Mask operator<=(Lanes a, Lanes b) { return SPLATAX_MASK(a.v[k] <= b.v[k]); }
SPLATAX_INLINE Mask operator&(Mask a, Mask b) { return SPLATAX_MASK(a.m[k] & b.m[k]); }
SPLATAX_INLINE Mask and_not(Mask a, Mask b) { return SPLATAX_MASK(a.m[k] & ~b.m[k]); }
SPLATAX_INLINE Lanes where(Mask mask, Lanes a, Lanes b) { return SPLATAX_LANES(mask.m[k] ? a.v[k] : b.v[k]); }
SPLATAX_INLINE Lanes or_zero(Mask mask, Lanes a) {
  return SPLATAX_LANES(reinterpret_cast<Floats>(reinterpret_cast<Ints>(a.v[k]) & mask.m[k]));
}

SPLATAX_INLINE uint32_t bits(Mask a) {
  uint32_t result = 0;
  for (int k = 0; k < PARTS; ++k) {
#if defined(__AVX2__)
    result |= static_cast<uint32_t>(_mm256_movemask_ps(reinterpret_cast<__m256>(a.m[k]))) << (WIDTH * k);
#elif defined(__x86_64__)
    result |= static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(a.m[k]))) << (WIDTH * k);
#else
    const Ints weights = {1, 2, 4, 8};
    const Ints set = a.m[k] & weights;
    result |= static_cast<uint32_t>(set[0] | set[1] | set[2] | set[3]) << (WIDTH * k);
#endif
  }
  return result;
}

SPLATAX_INLINE Lanes reciprocal(Lanes x) { return SPLATAX_LANES(1.0f / x.v[k]); }

// Rounds to an integer for |x| < 2^22: the sum with 1.5 * 2^23 has no bits for a fraction.
SPLATAX_INLINE Lanes round(Lanes x) { return SPLATAX_LANES((x.v[k] + 12582912.0f) - 12582912.0f); }

// Adds to the exponent; below 2^-126 the result is not exact, but still small.
SPLATAX_INLINE Lanes times_power_of_two(Lanes x, Lanes integer) {
  integer = max(integer, broadcast(-126));
  return SPLATAX_LANES(reinterpret_cast<Floats>(reinterpret_cast<Ints>(x.v[k]) +
                                                (__builtin_convertvector(integer.v[k], Ints) << MANTISSA)));
}

#endif

// A number in [sqrt(1/2), sqrt(2)), times 2^exponent.
struct Decomposed {
  Lanes number, exponent;
};

#if defined(__AVX512F__)
SPLATAX_INLINE Decomposed decomposed(Lanes x) {
  const __m512i bits = _mm512_castps_si512(x.v);
  const __m512i exponent = _mm512_srai_epi32(_mm512_sub_epi32(bits, _mm512_set1_epi32(static_cast<int>(ROOT_HALF))), MANTISSA);
  const __m512i number = _mm512_sub_epi32(bits, _mm512_slli_epi32(exponent, MANTISSA));
  return {{_mm512_castsi512_ps(number)}, {_mm512_cvtepi32_ps(exponent)}};
}
#else
SPLATAX_INLINE Decomposed decomposed(Lanes x) {
  Decomposed result;
#pragma GCC unroll 4
  for (int k = 0; k < PARTS; ++k) {
    const Words bits = reinterpret_cast<Words>(x.v[k]);
    const Ints exponent = reinterpret_cast<Ints>(bits - ROOT_HALF) >> MANTISSA;
    result.number.v[k] = reinterpret_cast<Floats>(bits - (reinterpret_cast<Words>(exponent) << MANTISSA));
    result.exponent.v[k] = __builtin_convertvector(exponent, Floats);
  }
  return result;
}
#endif

SPLATAX_INLINE Lanes operator-(Lanes a) { return broadcast(0) - a; }
SPLATAX_INLINE Lanes operator+(Lanes a, float b) { return a + broadcast(b); }
SPLATAX_INLINE Lanes operator-(Lanes a, float b) { return a - broadcast(b); }
SPLATAX_INLINE Lanes operator-(float a, Lanes b) { return broadcast(a) - b; }
SPLATAX_INLINE Lanes operator*(float a, Lanes b) { return broadcast(a) * b; }
SPLATAX_INLINE Lanes& operator+=(Lanes& a, Lanes b) { return a = a + b; }
SPLATAX_INLINE Mask operator<(Lanes a, Lanes b) { return and_not(a <= b, b <= a); }
SPLATAX_INLINE Lanes absolute(Lanes a) { return max(a, -a); }
SPLATAX_INLINE Mask finite(Lanes a) { return absolute(a) < broadcast(__builtin_inff()); }  // NaN is not

SPLATAX_INLINE bool any(Mask mask) { return bits(mask) != 0; }

// 2^x for x in [-100, 100], to 2e-7: a minimax polynomial in relative error (Remez) for 2^f with f in
// [-1/2, 1/2], times 2^integer.
SPLATAX_INLINE Lanes exp2(Lanes x) {
  const Lanes integer = round(x), f = x - integer;
  Lanes p = broadcast(1.3240888e-03f);
  p = multiply_add(p, f, broadcast(9.674739e-03f));
  p = multiply_add(p, f, broadcast(0.055508375f));
  p = multiply_add(p, f, broadcast(0.24022155f));
  p = multiply_add(p, f, broadcast(0.6931469f));
  p = multiply_add(p, f, broadcast(1.0f));
  return times_power_of_two(p, integer);
}

}  // namespace splatax
