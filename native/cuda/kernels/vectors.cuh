// Vectors and matrices of three dimensions.
#pragma once

#include "device.cuh"

struct Vector {
  float x, y, z;
};

struct Matrix {
  Vector column[3];
};

INLINE Vector operator+(const Vector& a, const Vector& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
INLINE Vector operator-(const Vector& a, const Vector& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
INLINE Vector operator*(float a, const Vector& b) { return {a * b.x, a * b.y, a * b.z}; }
INLINE float dot(const Vector& a, const Vector& b) { return fmaf(a.x, b.x, fmaf(a.y, b.y, a.z * b.z)); }
INLINE Vector cross(const Vector& a, const Vector& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}
INLINE Vector operator*(const Matrix& m, const Vector& a) {
  return a.x * m.column[0] + a.y * m.column[1] + a.z * m.column[2];
}
INLINE Vector transposed_times(const Matrix& m, const Vector& a) {
  return {dot(m.column[0], a), dot(m.column[1], a), dot(m.column[2], a)};
}

INLINE Vector vector_at(const float* numbers) { return {numbers[0], numbers[1], numbers[2]}; }
INLINE void write(const Vector& a, float* to) { to[0] = a.x, to[1] = a.y, to[2] = a.z; }
INLINE bool is_finite(const Vector& a) { return is_finite(a.x) && is_finite(a.y) && is_finite(a.z); }
