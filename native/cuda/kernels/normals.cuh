// Random numbers of JAX: its generator, threefry, and normal deviates made from it as `jax.random.normal` does.
#pragma once

#include "arguments.cuh"
#include "device.cuh"

// Encrypts a counter with a key (Salmon et al. 2011, Threefry-2x32 with 20 rounds); returns both words, combined.
INLINE uint32_t threefry(const uint32_t* key, uint32_t high, uint32_t low) {
  constexpr int ROTATIONS[2][4] = {{13, 15, 26, 6}, {17, 29, 16, 24}};
  const uint32_t keys[3] = {key[0], key[1], key[0] ^ key[1] ^ 0x1BD11BDAu};
  high += keys[0];
  low += keys[1];
#pragma unroll
  for (int group = 0; group < 5; ++group) {
#pragma unroll
    for (int round = 0; round < 4; ++round) {
      const int by = ROTATIONS[group % 2][round];
      high += low;
      low = ((low << by) | (low >> (32 - by))) ^ high;
    }
    high += keys[(group + 1) % 3];
    low += keys[(group + 2) % 3] + group + 1;
  }
  return high ^ low;
}

// The inverse of the error function, for |x| < 1 (Giles 2012, single precision).
INLINE float inverse_error_function(float x) {
  constexpr float CENTRAL[9] = {2.81022636e-08f,  3.43273939e-07f, -3.5233877e-06f,  -4.39150654e-06f, 0.00021858087f,
                                -0.00125372503f, -0.00417768164f, 0.246640727f,     1.50140941f};
  constexpr float TAIL[9] = {-0.000200214257f, 0.000100950558f, 0.00134934322f, -0.00367342844f, 0.00573950773f,
                             -0.0076224613f,   0.00943887047f,  1.00167406f,    2.83297682f};
  const float w = -log1pf(-x * x);
  const bool central = w < 5;
  const float t = central ? w - 2.5f : sqrtf(w) - 3;
  float p = central ? CENTRAL[0] : TAIL[0];
#pragma unroll
  for (int k = 1; k < 9; ++k) p = fmaf(p, t, central ? CENTRAL[k] : TAIL[k]);
  return p * x;
}

// Normal deviate `number` of `jax.random.normal(key, ...)`.
INLINE float normal_deviate(const uint32_t* key, unsigned long long number) {
  constexpr float LEAST = -0.99999994f;  // the float after -1
  constexpr float SQRT_2 = 1.41421356f;
  const uint32_t bits = threefry(key, (uint32_t)(number >> 32), (uint32_t)number);
  const float unit = __uint_as_float((bits >> 9) | 0x3f800000u);  // in [1, 2)
  return SQRT_2 * inverse_error_function(fmaxf((unit - 1) * 2 + LEAST, LEAST));
}
