// The fisheye of Kannala and Brandt: a polynomial of the angle from the axis.
#pragma once

#include <cmath>

#include "projection_bent.h"

namespace splatax {

// Angle in radians between the z axis and a point, from its distance to the axis and its z; as precise as float32.
SPLATAX_INLINE Lanes angle_of(Lanes aside, Lanes z) {
  const Lanes along = absolute(z), larger = max(aside, along);
  const Lanes ratio = min(aside, along) / larger;  // its arc tangent is at most pi / 4
  const Mask steep = broadcast(0.41421356f) < ratio;
  const Lanes x = where(steep, (ratio - 1.0f) / (ratio + 1.0f), ratio), xx = x * x;
  Lanes p = broadcast(8.05374449538e-2f);  // Cephes, atanf
  p = multiply_add(p, xx, broadcast(-1.38776856032e-1f));
  p = multiply_add(p, xx, broadcast(1.99777106478e-1f));
  p = multiply_add(p, xx, broadcast(-3.33329491539e-1f));
  Lanes angle = multiply_add(p * xx, x, x) + or_zero(steep, broadcast(0.78539816f));
  angle = where(along < aside, 1.57079633f - angle, angle);
  return where(z < broadcast(0), 3.14159265f - angle, angle);
}

// Angles from the z axis, in radians, times the direction of (x, y): (x, y) s, where s(r^2, z) = atan2(r, z) / r.
class Angles : public Seen {
 public:
  enum Field { FOLD, FIELDS };

  static SPLATAX_INLINE Mask sees(const Vector& point, const float* own) {
    const Lanes aside = multiply_add(point.x, point.x, point.y * point.y), squared = multiply_add(point.z, point.z, aside);
    const Mask apart = (broadcast(NEAR * NEAR) < squared) & (squared < broadcast(INFINITY));
    const Mask behind = (point.z <= broadcast(0)) & (aside <= 1e-4f * squared);
    return and_not(apart, behind) & (angle_of(sqrt(aside), point.z) < broadcast(own[FOLD]));
  }

  SPLATAX_INLINE Angles(const Vector& point, const float*) : point_(point) {
    const Lanes z = point.z, aside = multiply_add(point.x, point.x, point.y * point.y);
    const Lanes squared = multiply_add(z, z, aside);
    depth = sqrt(squared);
    by_z_ = -(broadcast(1) / squared);
    const Mask small = (broadcast(0) < z) & (aside < SMALL * z * z);
    const Lanes safe = where(small, broadcast(1), aside), radius = sqrt(safe);
    const Lanes far = angle_of(radius, z) / radius;
    const Lanes far_slope = -((z * by_z_ + far) / (2.0f * safe));
    const Lanes far_curve = -((z * by_z_ * by_z_ + 3.0f * far_slope) / (2.0f * safe));
    const Lanes inverse = broadcast(1) / where(small, z, broadcast(1)), inverse_2 = inverse * inverse;
    const Lanes t = or_zero(small, aside) * inverse_2;
    scale_ = where(small, series<0>(t) * inverse, far);
    by_aside_ = where(small, series<1>(t) * inverse_2 * inverse, far_slope);
    by_aside_twice_ = where(small, series<2>(t) * inverse_2 * inverse_2 * inverse, far_curve);
    place = near = {scale_ * point.x, scale_ * point.y};
    const Lanes x = point.x, y = point.y, twice = 2.0f * by_aside_;
    rows[0] = {multiply_add(twice * x, x, scale_), twice * x * y, by_z_ * x};
    rows[1] = {twice * x * y, multiply_add(twice * y, y, scale_), by_z_ * y};
  }

  template <class Camera>
  SPLATAX_INLINE Vector pull(const Seen& d, Camera&, int) const {
    const Lanes x = point_.x, y = point_.y, z = point_.z;
    const Lanes d_x = d.place.x + d.near.x, d_y = d.place.y + d.near.y, across = d.rows[0].y + d.rows[1].x;
    const Lanes d_scale = d.rows[0].x + d.rows[1].y + d_x * x + d_y * y;
    const Lanes d_by_aside = 2.0f * (x * x * d.rows[0].x + x * y * across + y * y * d.rows[1].y);
    const Lanes d_by_z = x * d.rows[0].z + y * d.rows[1].z, square = by_z_ * by_z_;
    const Lanes d_aside = d_scale * by_aside_ + d_by_aside * by_aside_twice_ + d_by_z * square;
    const Lanes along = d.depth / depth, twice = 2.0f * by_aside_;
    return {scale_ * d_x + twice * (2.0f * x * d.rows[0].x + y * across) + by_z_ * d.rows[0].z +
                (2.0f * d_aside + along) * x,
            scale_ * d_y + twice * (2.0f * y * d.rows[1].y + x * across) + by_z_ * d.rows[1].z +
                (2.0f * d_aside + along) * y,
            d_scale * by_z_ + (d_by_aside + 2.0f * z * d_by_z) * square + along * z};
  }

  SPLATAX_INLINE Seen push(const Vector& d_point, const float*) const {
    const Lanes x = point_.x, y = point_.y, z = point_.z, square = by_z_ * by_z_, d_z = d_point.z;
    const Lanes d_aside = 2.0f * (x * d_point.x + y * d_point.y);
    const Lanes d_scale = by_aside_ * d_aside + by_z_ * d_z;
    const Lanes d_by_aside = by_aside_twice_ * d_aside + square * d_z;
    const Lanes d_by_z = square * (d_aside + 2.0f * z * d_z);
    const Plane<Lanes> d_place{d_scale * x + scale_ * d_point.x, d_scale * y + scale_ * d_point.y};
    const Lanes across = 2.0f * (d_by_aside * x * y + by_aside_ * (d_point.x * y + x * d_point.y));
    return {d_place,
            d_place,
            {{d_scale + 2.0f * x * (d_by_aside * x + 2.0f * by_aside_ * d_point.x), across, d_by_z * x + by_z_ * d_point.x},
             {across, d_scale + 2.0f * y * (d_by_aside * y + 2.0f * by_aside_ * d_point.y), d_by_z * y + by_z_ * d_point.y}},
            dot(point_, d_point) / depth};
  }

 private:
  static constexpr float SMALL = 0.04f;  // t = (r / z)^2 below which the other formulas lose digits

  // The ORDERth derivative of 1 - t / 3 + t^2 / 5 - ..., exact to float32 below SMALL.
  template <int ORDER>
  static SPLATAX_INLINE Lanes series(Lanes t) {
    Lanes sum = broadcast(0);
    for (int n = 7; n >= ORDER; --n) {
      float term = (n % 2 ? -1.0f : 1.0f) / static_cast<float>(2 * n + 1);
      for (int i = 0; i < ORDER; ++i) term *= static_cast<float>(n - i);
      sum = multiply_add(sum, t, broadcast(term));
    }
    return sum;
  }

  Vector point_;
  Lanes scale_, by_aside_, by_aside_twice_, by_z_;  // s and its derivatives by r^2, twice so, and by z
};

// Its numbers are k1 to k4.
struct EvenPowers {
  static constexpr int COEFFICIENTS = 4;

  template <class T, class C>
  static SPLATAX_INLINE Plane<T> bent(const Plane<T>& c, const C* k) {
    const T factor = polynomial(k, c.x * c.x + c.y * c.y);
    return {c.x * factor, c.y * factor};
  }

  template <class T, class C>
  static SPLATAX_INLINE Plane<T> pull(const Plane<T>& c, const C* k, const Plane<Lanes>& w, T* d_k) {
    const T q = c.x * c.x + c.y * c.y, factor = polynomial(k, q), along = c.x * w.x + c.y * w.y;
    d_k[0] = along * q;
    for (int m = 1; m < COEFFICIENTS; ++m) d_k[m] = d_k[m - 1] * q;
    const T d_q = along * (q * (q * (4.0f * (q * k[3]) + 3.0f * k[2]) + 2.0f * k[1]) + k[0]);
    return {factor * w.x + 2.0f * (c.x * d_q), factor * w.y + 2.0f * (c.y * d_q)};
  }

 private:
  template <class T, class C>
  static SPLATAX_INLINE T polynomial(const C* k, const T& q) {
    return q * (q * (q * (q * k[3] + k[2]) + k[1]) + k[0]) + 1.0f;
  }
};

using Fisheye = Bent<Angles, EvenPowers>;

}  // namespace splatax
