// Numbers with derivatives along K directions, for forward-mode differentiation.
#pragma once

#include "lanes.h"

namespace splatax {

template <int K>
struct Dual {
  Lanes value, d[K];
};

template <int K>
SPLATAX_INLINE Dual<K> operator+(const Dual<K>& a, const Dual<K>& b) {
  Dual<K> sum{a.value + b.value, {}};
  for (int i = 0; i < K; ++i) sum.d[i] = a.d[i] + b.d[i];
  return sum;
}
template <int K>
SPLATAX_INLINE Dual<K> operator-(const Dual<K>& a, const Dual<K>& b) {
  Dual<K> difference{a.value - b.value, {}};
  for (int i = 0; i < K; ++i) difference.d[i] = a.d[i] - b.d[i];
  return difference;
}
template <int K>
SPLATAX_INLINE Dual<K> operator*(const Dual<K>& a, const Dual<K>& b) {
  Dual<K> product{a.value * b.value, {}};
  for (int i = 0; i < K; ++i) product.d[i] = multiply_add(a.d[i], b.value, a.value * b.d[i]);
  return product;
}
template <int K>
SPLATAX_INLINE Dual<K> operator/(const Dual<K>& a, const Dual<K>& b) {
  Dual<K> quotient{a.value / b.value, {}};
  for (int i = 0; i < K; ++i) quotient.d[i] = (a.d[i] - quotient.value * b.d[i]) / b.value;
  return quotient;
}

// Operations with constants, whose derivatives are zero.
template <int K>
SPLATAX_INLINE Dual<K> operator+(const Dual<K>& a, float b) {
  Dual<K> sum = a;
  sum.value = a.value + b;
  return sum;
}
template <int K>
SPLATAX_INLINE Dual<K> operator-(const Dual<K>& a, float b) {
  Dual<K> difference = a;
  difference.value = a.value - b;
  return difference;
}
template <int K>
SPLATAX_INLINE Dual<K> operator*(float a, const Dual<K>& b) {
  Dual<K> product{a * b.value, {}};
  for (int i = 0; i < K; ++i) product.d[i] = a * b.d[i];
  return product;
}
template <int K>
SPLATAX_INLINE Dual<K> operator+(const Dual<K>& a, Lanes b) {
  Dual<K> sum = a;
  sum.value = a.value + b;
  return sum;
}
template <int K>
SPLATAX_INLINE Dual<K> operator*(const Dual<K>& a, Lanes b) {
  Dual<K> product{a.value * b, {}};
  for (int i = 0; i < K; ++i) product.d[i] = a.d[i] * b;
  return product;
}

}  // namespace splatax
