// Random numbers of JAX: its generator, threefry, and normal deviates made from it as `jax.random.normal` does.
#pragma once

#include <cmath>
#include <cstdint>
#include <cstring>

#include "logarithm.h"

namespace splatax {

// Encrypts counters with the key (Salmon et al. 2011, Threefry-2x32 with 20 rounds).
template <int N>
inline void threefry(const uint32_t key[2], uint32_t (&high)[N], uint32_t (&low)[N]) {
  constexpr int ROTATIONS[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
  const uint32_t keys[3] = {key[0], key[1], key[0] ^ key[1] ^ 0x1BD11BDAu};
  for (int i = 0; i < N; ++i) {
    high[i] += keys[0];
    low[i] += keys[1];
  }
  for (int group = 0; group < 5; ++group) {
    for (const int by : ROTATIONS[group % 2]) {
      for (int i = 0; i < N; ++i) {
        high[i] += low[i];
        low[i] = ((low[i] << by) | (low[i] >> (32 - by))) ^ high[i];
      }
    }
    const uint32_t first = keys[(group + 1) % 3], second = keys[(group + 2) % 3] + static_cast<uint32_t>(group) + 1;
    for (int i = 0; i < N; ++i) {
      high[i] += first;
      low[i] += second;
    }
  }
}

// ln(x) for normal x > 0, to 1e-7.
inline float logarithm(float x) {
  int32_t bits;
  std::memcpy(&bits, &x, sizeof bits);
  const int32_t exponent = (bits - static_cast<int32_t>(ROOT_HALF)) >> MANTISSA;  // of x over a number in [sqrt(1/2), sqrt(2))
  bits -= exponent * (1 << MANTISSA);
  float f;
  std::memcpy(&f, &bits, sizeof f);
  return log_near_one(f - 1) + static_cast<float>(exponent) * 0.69314718f;
}

// The inverse of the error function, for |x| < 1 (Giles 2012, single precision).
inline float inverse_error_function(float x) {
  const float w = -logarithm((1 - x) * (1 + x));
  const float a = w - 2.5f, b = std::sqrt(w) - 3;
  float p = 2.81022636e-08f, q = -0.000200214257f;
  p = p * a + 3.43273939e-07f;
  q = q * b + 0.000100950558f;
  p = p * a - 3.5233877e-06f;
  q = q * b + 0.00134934322f;
  p = p * a - 4.39150654e-06f;
  q = q * b - 0.00367342844f;
  p = p * a + 0.00021858087f;
  q = q * b + 0.00573950773f;
  p = p * a - 0.00125372503f;
  q = q * b - 0.0076224613f;
  p = p * a - 0.00417768164f;
  q = q * b + 0.00943887047f;
  p = p * a + 0.246640727f;
  q = q * b + 1.00167406f;
  p = p * a + 1.50140941f;
  q = q * b + 2.83297682f;
  return (w < 5 ? p : q) * x;
}

// Normal deviates number `first` to `first` + N of `jax.random.normal(key, ...)`.
template <int N>
inline void normals(const uint32_t key[2], uint64_t first, float (&result)[N]) {
  constexpr float LEAST = -0.99999994f;  // the float after -1
  constexpr float SQRT_2 = 1.41421356f;
  uint32_t high[N], low[N];
  for (int i = 0; i < N; ++i) {
    const uint64_t count = first + static_cast<uint64_t>(i);
    high[i] = static_cast<uint32_t>(count >> 32);
    low[i] = static_cast<uint32_t>(count);
  }
  threefry(key, high, low);
  for (int i = 0; i < N; ++i) {
    const uint32_t bits = ((high[i] ^ low[i]) >> 9) | 0x3f800000u;  // a float in [1, 2)
    float unit;
    std::memcpy(&unit, &bits, sizeof unit);
    const float uniform = (unit - 1) * 2 + LEAST;
    result[i] = SQRT_2 * inverse_error_function(uniform < LEAST ? LEAST : uniform);
  }
}

}  // namespace splatax
