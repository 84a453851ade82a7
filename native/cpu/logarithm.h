// Logarithms of sixteen floats at once, or of one.
#pragma once

#include <cmath>

#include "lanes.h"

namespace splatax {

constexpr float LOG2_E = 1.442695041f;

// ln(1 + f) for f in [sqrt(1/2) - 1, sqrt(2) - 1], to 1e-7 (Moshier, Cephes library, logf).
template <class Number>
SPLATAX_INLINE Number log_near_one(Number f) {
  const Number squared = f * f;
  Number p = 7.0376836292e-2f * f - 1.1514610310e-1f;
  p = p * f + 1.1676998740e-1f;
  p = p * f - 1.2420140846e-1f;
  p = p * f + 1.4249322787e-1f;
  p = p * f - 1.6668057665e-1f;
  p = p * f + 2.0000714765e-1f;
  p = p * f - 2.4999993993e-1f;
  p = p * f + 3.3333331174e-1f;
  return f + (p * f * squared - 0.5f * squared);
}

// log2(x) for normal x > 0, to 2e-7 of its value or of 1, whichever is larger; anything for other x.
SPLATAX_INLINE Lanes log2(Lanes x) {
  const Decomposed parts = decomposed(x);
  return multiply_add(broadcast(LOG2_E), log_near_one(parts.number - 1.0f), parts.exponent);
}

// ln(x), under the same conditions.
SPLATAX_INLINE Lanes log(Lanes x) { return 0.6931471806f * log2(x); }

}  // namespace splatax
