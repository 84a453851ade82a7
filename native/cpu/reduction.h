// Sums over the lanes of several vectors at once: a transposition with additions in each step.
#pragma once

#include "columns.h"

namespace splatax {

#if defined(__AVX512F__)

// to[n] = sum over lanes of values[n], for N from 9 to 12; `to` has room for sixteen.
template <int N>
SPLATAX_INLINE void add_up(const Lanes values[N], float* to) {
  static_assert(8 < N && N <= 12);
  const auto at = [&](int n) { return n < N ? values[n].v : _mm512_setzero_ps(); };
  // Quarters of a register: [a0 + a2, a1 + a3, b0 + b2, b1 + b3].
  const auto halves = [](__m512 a, __m512 b) {
    return _mm512_add_ps(_mm512_shuffle_f32x4(a, b, 0x44), _mm512_shuffle_f32x4(a, b, 0xEE));
  };
  // From two of those: a quarter each for a, b, c, d.
  const auto quarters = [](__m512 ab, __m512 cd) {
    return _mm512_add_ps(_mm512_shuffle_f32x4(ab, cd, 0x88), _mm512_shuffle_f32x4(ab, cd, 0xDD));
  };
  const __m512 p = quarters(halves(at(0), at(1)), halves(at(2), at(3)));
  const __m512 q = quarters(halves(at(4), at(5)), halves(at(6), at(7)));
  const __m512 r = quarters(halves(at(8), at(9)), halves(at(10), at(11)));
  // Within quarters: [p, q, p, q] by halves, then [p, q, r, 0].
  const __m512 zero = _mm512_setzero_ps();
  const __m512 pq = _mm512_add_ps(_mm512_unpacklo_ps(p, q), _mm512_unpackhi_ps(p, q));
  const __m512 r0 = _mm512_add_ps(_mm512_unpacklo_ps(r, zero), _mm512_unpackhi_ps(r, zero));
  const __m512 sums = _mm512_add_ps(_mm512_shuffle_ps(pq, r0, 0x44), _mm512_shuffle_ps(pq, r0, 0xEE));
  const __m512i order = _mm512_setr_epi32(0, 4, 8, 12, 1, 5, 9, 13, 2, 6, 10, 14, 3, 7, 11, 15);
  _mm512_storeu_ps(to, _mm512_permutexvar_ps(order, sums));  // not masked: that cannot be read at once
}

#else

SPLATAX_INLINE Four folded(const Lanes& a) {
#if defined(__AVX2__)
  const Floats sum = a.v[0] + a.v[1];
  return __builtin_shufflevector(sum, sum, 0, 1, 2, 3) + __builtin_shufflevector(sum, sum, 4, 5, 6, 7);
#else
  return (a.v[0] + a.v[1]) + (a.v[2] + a.v[3]);
#endif
}

// to[n] = sum over lanes of values[n], for N from 9 to 12; `to` has room for sixteen.
template <int N>
SPLATAX_INLINE void add_up(const Lanes values[N], float* to) {
  static_assert(8 < N && N <= 12);
  for (int n = 0; n < 12; n += 4) {
    const auto at = [&](int k) { return k < N ? folded(values[k]) : Four{}; };
    const Four a = at(n), b = at(n + 1), c = at(n + 2), d = at(n + 3);
    const Four ab = __builtin_shufflevector(a, b, 0, 4, 1, 5) + __builtin_shufflevector(a, b, 2, 6, 3, 7);
    const Four cd = __builtin_shufflevector(c, d, 0, 4, 1, 5) + __builtin_shufflevector(c, d, 2, 6, 3, 7);
    const Four sums = __builtin_shufflevector(ab, cd, 0, 1, 4, 5) + __builtin_shufflevector(ab, cd, 2, 3, 6, 7);
    std::memcpy(to + n, &sums, sizeof sums);
  }
}

#endif

}  // namespace splatax
