// Small vectors and matrices of lanes: sixteen Gaussians at once.
#pragma once

#include "lanes.h"

namespace splatax {

struct Vector {
  Lanes x, y, z;
};

// Columns.
struct Matrix {
  Vector column[3];
};

SPLATAX_INLINE Vector operator+(const Vector& a, const Vector& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
SPLATAX_INLINE Vector operator*(Lanes a, const Vector& b) { return {a * b.x, a * b.y, a * b.z}; }
SPLATAX_INLINE Lanes dot(const Vector& a, const Vector& b) {
  return multiply_add(a.x, b.x, multiply_add(a.y, b.y, a.z * b.z));
}
SPLATAX_INLINE Vector cross(const Vector& a, const Vector& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
SPLATAX_INLINE Vector or_zero(Mask mask, const Vector& a) {
  return {or_zero(mask, a.x), or_zero(mask, a.y), or_zero(mask, a.z)};
}

// m a, and m^T a.
SPLATAX_INLINE Vector operator*(const Matrix& m, const Vector& a) {
  return a.x * m.column[0] + a.y * m.column[1] + a.z * m.column[2];
}
SPLATAX_INLINE Vector transposed_times(const Matrix& m, const Vector& a) {
  return {dot(m.column[0], a), dot(m.column[1], a), dot(m.column[2], a)};
}

// The column k of sixteen rows of `stride` floats each; rows past `count` repeat the last one, and
// are not written.
#if defined(__AVX512F__)
SPLATAX_INLINE __m512i row_offsets(int stride, int count) {
  const __m512i lane = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  return _mm512_mullo_epi32(_mm512_min_epi32(lane, _mm512_set1_epi32(count - 1)), _mm512_set1_epi32(stride));
}
SPLATAX_INLINE Lanes gather(const float* rows, int stride, int k, int count) {
  return {_mm512_i32gather_ps(row_offsets(stride, count), rows + k, sizeof(float))};
}
SPLATAX_INLINE void scatter(Lanes values, float* rows, int stride, int k, int count) {
  const __mmask16 rows_there = static_cast<__mmask16>((1u << count) - 1);
  _mm512_mask_i32scatter_ps(rows + k, rows_there, row_offsets(stride, LANES), values.v, sizeof(float));
}
#else
SPLATAX_INLINE Lanes gather(const float* rows, int stride, int k, int count) {
  alignas(64) float values[LANES];
  for (int lane = 0; lane < LANES; ++lane) {
    values[lane] = rows[static_cast<size_t>(lane < count ? lane : count - 1) * stride + k];
  }
  return load(values);
}
SPLATAX_INLINE void scatter(Lanes values, float* rows, int stride, int k, int count) {
  alignas(64) float each[LANES];
  store(each, values);
  for (int lane = 0; lane < count; ++lane) rows[static_cast<size_t>(lane) * stride + k] = each[lane];
}
#endif
SPLATAX_INLINE Vector gather_vector(const float* rows, int count) {
  return {gather(rows, 3, 0, count), gather(rows, 3, 1, count), gather(rows, 3, 2, count)};
}
SPLATAX_INLINE void scatter_vector(const Vector& values, float* rows, int count) {
  scatter(values.x, rows, 3, 0, count), scatter(values.y, rows, 3, 1, count), scatter(values.z, rows, 3, 2, count);
}

}  // namespace splatax
