// OpenCV's distortion of slopes: radial (rational), tangential and thin prism.
#pragma once

#include "projection_bent.h"

namespace splatax {

// Its numbers are k1 to k6, p1, p2, and s1 to s4.
struct Rational {
  static constexpr int COEFFICIENTS = 12;

  template <class T, class C>
  static SPLATAX_INLINE Plane<T> bent(const Plane<T>& c, const C* k) {
    const T q = c.x * c.x + c.y * c.y, xy = c.x * c.y;
    const T factor = polynomial(k, q) / polynomial(k + 3, q);
    return {c.x * factor + 2.0f * (xy * k[6]) + (q + 2.0f * (c.x * c.x)) * k[7] + q * (q * k[9] + k[8]),
            c.y * factor + (q + 2.0f * (c.y * c.y)) * k[6] + 2.0f * (xy * k[7]) + q * (q * k[11] + k[10])};
  }

  template <class T, class C>
  static SPLATAX_INLINE Plane<T> pull(const Plane<T>& c, const C* k, const Plane<Lanes>& w, T* d_k) {
    const T q = c.x * c.x + c.y * c.y, qq = q * q, xy = c.x * c.y;
    const T divisor = polynomial(k + 3, q), factor = polynomial(k, q) / divisor;
    const T d_above = (c.x * w.x + c.y * w.y) / divisor, d_below = -1.0f * (d_above * factor);
    d_k[0] = d_above * q;
    d_k[1] = d_above * qq;
    d_k[2] = d_above * (qq * q);
    d_k[3] = d_below * q;
    d_k[4] = d_below * qq;
    d_k[5] = d_below * (qq * q);
    d_k[6] = 2.0f * (xy * w.x) + (q + 2.0f * (c.y * c.y)) * w.y;
    d_k[7] = (q + 2.0f * (c.x * c.x)) * w.x + 2.0f * (xy * w.y);
    d_k[8] = q * w.x;
    d_k[9] = qq * w.x;
    d_k[10] = q * w.y;
    d_k[11] = qq * w.y;
    const C sideways = k[6] * w.x + k[7] * w.y, upwards = k[6] * w.y + k[7] * w.x;
    const T d_q = d_above * slope(k, q) + d_below * slope(k + 3, q) + (2.0f * (q * k[9]) + k[8]) * w.x +
                  (2.0f * (q * k[11]) + k[10]) * w.y + upwards;
    return {factor * w.x + 2.0f * (c.y * sideways) + 4.0f * (c.x * k[7] * w.x) + 2.0f * (c.x * d_q),
            factor * w.y + 2.0f * (c.x * sideways) + 4.0f * (c.y * k[6] * w.y) + 2.0f * (c.y * d_q)};
  }

 private:
  // 1 + k1 q + k2 q^2 + k3 q^3, and its derivative.
  template <class T, class C>
  static SPLATAX_INLINE T polynomial(const C* k, const T& q) {
    return q * (q * (q * k[2] + k[1]) + k[0]) + 1.0f;
  }
  template <class T, class C>
  static SPLATAX_INLINE T slope(const C* k, const T& q) {
    return q * (3.0f * (q * k[2]) + 2.0f * k[1]) + k[0];
  }
};

using OpenCV = Bent<Slopes, Rational>;

}  // namespace splatax
