// Real spherical harmonics, as in splatax/math/harmonics.py, and their derivatives.
#pragma once

#include "vectors.cuh"

// A number and its derivatives by x, y and z.
struct Dual {
  float value;
  Vector d;
};
INLINE Dual operator+(const Dual& a, const Dual& b) { return {a.value + b.value, a.d + b.d}; }
INLINE Dual operator-(const Dual& a, const Dual& b) { return {a.value - b.value, a.d - b.d}; }
INLINE Dual operator+(const Dual& a, float b) { return {a.value + b, a.d}; }
INLINE Dual operator-(const Dual& a, float b) { return {a.value - b, a.d}; }
INLINE Dual operator*(float a, const Dual& b) { return {a * b.value, a * b.d}; }
INLINE Dual operator*(const Dual& a, const Dual& b) { return {a.value * b.value, a.value * b.d + b.value * a.d}; }

// Calls visit(k, f_k) for each of the basis functions at a unit direction. T is float, or Dual for derivatives
// too.
template <class T, class Visit>
INLINE void each_harmonic(const T& x, const T& y, const T& z, int coefficients, const Visit& visit) {
  visit(0, 0.0f * x + 0.28209479177387814f);
  if (coefficients < 4) return;
  visit(1, -0.4886025119029199f * y);
  visit(2, 0.4886025119029199f * z);
  visit(3, -0.4886025119029199f * x);
  if (coefficients < 9) return;
  const T xx = x * x, yy = y * y, zz = z * z, xy = x * y;
  visit(4, 1.0925484305920792f * xy);
  visit(5, -1.0925484305920792f * (y * z));
  visit(6, 0.31539156525252005f * (2.0f * zz - xx - yy));
  visit(7, -1.0925484305920792f * (x * z));
  visit(8, 0.5462742152960396f * (xx - yy));
  if (coefficients < 16) return;
  visit(9, -0.5900435899266435f * (y * (3.0f * xx - yy)));
  visit(10, 2.890611442640554f * (xy * z));
  visit(11, -0.4570457994644658f * (y * (4.0f * zz - xx - yy)));
  visit(12, 0.3731763325901154f * (z * (2.0f * zz - 3.0f * xx - 3.0f * yy)));
  visit(13, -0.4570457994644658f * (x * (4.0f * zz - xx - yy)));
  visit(14, 1.445305721320277f * (z * (xx - yy)));
  visit(15, -0.5900435899266435f * (x * (xx - 3.0f * yy)));
  if (coefficients < 25) return;
  visit(16, 2.5033429417967046f * (xy * (xx - yy)));
  visit(17, -1.7701307697799304f * (y * z * (3.0f * xx - yy)));
  visit(18, 0.9461746957575601f * (xy * (7.0f * zz - 1.0f)));
  visit(19, -0.6690465435572892f * (y * z * (7.0f * zz - 3.0f)));
  visit(20, 0.10578554691520431f * (zz * (35.0f * zz - 30.0f) + 3.0f));
  visit(21, -0.6690465435572892f * (x * z * (7.0f * zz - 3.0f)));
  visit(22, 0.47308734787878004f * ((xx - yy) * (7.0f * zz - 1.0f)));
  visit(23, -1.7701307697799304f * (x * z * (xx - 3.0f * yy)));
  visit(24, 0.6258357354491761f * (xx * (xx - 3.0f * yy) - yy * (3.0f * xx - yy)));
}

// Unit vector from the camera to a mean, and its inverse length; zero where they coincide.
struct Direction {
  Vector unit;
  float inverse_length;

  INLINE Direction(const Vector& mean, const Vector& position) : unit{0, 0, 0}, inverse_length(0) {
    const Vector offset = mean - position;
    const float squared = dot(offset, offset);
    if (!(squared > 0)) return;
    inverse_length = 1 / sqrtf(squared);
    unit = inverse_length * offset;
  }
};

// Colour before it is clamped to zero.
INLINE Vector color_of(const float* sh, int coefficients, const Vector& unit) {
  Vector color{0.5f, 0.5f, 0.5f};
  each_harmonic(unit.x, unit.y, unit.z, coefficients,
                [&](int k, float value) { color = color + value * vector_at(sh + 3 * k); });
  return color;
}
