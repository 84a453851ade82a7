// The five fields of a scene from XLA, with their checks.
#pragma once

#include "ffi.h"
#include "projection.h"

namespace splatax {

// Fields of a scene, of its gradients, or of moments.
template <class Array>
struct FieldArrays {
  Array &means, &quats, &log_scales, &opacity_logits, &sh;

  void check(Checks& checks, int64_t n, int64_t k) const {
    checks.shape("means", means, {n, 3}).shape("quats", quats, {n, 4}).shape("log_scales", log_scales, {n, 3});
    checks.shape("opacity_logits", opacity_logits, {n}).shape("sh", sh, {n, k, 3});
  }
};

// Checks the fields of a scene against each other; returns the numbers of Gaussians and SH coefficients.
inline std::array<int64_t, 2> check_scene(Checks& checks, const FieldArrays<FloatArray>& scene) {
  const auto [n, k, three] = checks.sizes<3>("sh", scene.sh);
  checks.range("the number of Gaussians", n, 0, MOST_ROWS);
  checks.range("the number of SH coefficients", k, 1, MAX_COEFFICIENTS);
  int64_t bands = 1;
  while (bands * bands < k) ++bands;
  checks.range("the number of SH coefficients", k, bands * bands, bands * bands);
  scene.check(checks, n, k);
  return {n, k};
}

}  // namespace splatax
