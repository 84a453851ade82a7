// Arrays of a scene and a camera from XLA, and the settings of a view, with their checks.
#pragma once

#include "ffi.h"
#include "harmonics.h"
#include "projection.h"

namespace splatax {

// Settings of a view that are static under `jit`.
struct Settings {
  int64_t lens, width, height;
  float variance;
  int64_t fades;
  float least_fade;

  // Checks them; returns how many numbers the camera has.
  int64_t check(Checks& checks) const {
    checks.range("the lens", lens, 0, static_cast<int64_t>(LensKind::COUNT) - 1);
    checks.range("the width", width, 1, LONGEST_SIDE).range("the height", height, 1, LONGEST_SIDE);
    return checks.failed() ? 0 : camera_fields(static_cast<LensKind>(lens));
  }
  View view(const float* camera) const {
    return {camera,   static_cast<LensKind>(lens), static_cast<int>(width), static_cast<int>(height),
            variance, fades != 0,                  least_fade};
  }
};

// Arrays of a scene and a camera.
struct SceneArrays {
  const FloatArray &means, &quats, &log_scales, &opacity_logits, &sh, &camera;

  // Checks them against each other; returns the numbers of Gaussians and SH coefficients.
  std::array<int64_t, 2> check(Checks& checks, int64_t camera_numbers) const {
    const auto [n, k, three] = checks.sizes<3>("sh", sh);
    checks.range("the number of Gaussians", n, 0, MOST_ROWS);
    checks.range("the number of SH coefficients", k, 1, MAX_COEFFICIENTS).shape("sh", sh, {n, k, 3});
    int64_t bands = 1;
    while (bands * bands < k) ++bands;
    checks.range("the number of SH coefficients", k, bands * bands, bands * bands);
    checks.shape("means", means, {n, 3}).shape("quats", quats, {n, 4}).shape("log_scales", log_scales, {n, 3});
    checks.shape("opacity_logits", opacity_logits, {n}).shape("camera", camera, {camera_numbers});
    return {n, k};
  }

  Gaussians gaussians(const Batch& batch, int64_t view) const {
    const auto size = sh.dimensions();
    return {batch.of(means, view),
            batch.of(quats, view),
            batch.of(log_scales, view),
            batch.of(opacity_logits, view),
            batch.of(sh, view),
            static_cast<int>(size[batch.rank()]),
            static_cast<int>(size[batch.rank() + 1])};
  }
};

}  // namespace splatax
