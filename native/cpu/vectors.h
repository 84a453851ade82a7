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

}  // namespace splatax
