// Arrays of a scene and a camera from XLA, and the settings of a view, with their checks.
#pragma once

#include "ffi_fields.h"
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
    return {camera,   static_cast<LensKind>(lens), static_cast<float>(width), static_cast<float>(height),
            variance, fades != 0,                  least_fade};
  }
};

// Arrays of a scene and a camera.
struct ViewArrays {
  FieldArrays<FloatArray> scene;
  FloatArray& camera;

  // Checks them against each other; returns the numbers of Gaussians and SH coefficients.
  std::array<int64_t, 2> check(Checks& checks, int64_t camera_numbers) const {
    const auto sizes = check_scene(checks, scene);
    checks.shape("camera", camera, {camera_numbers});
    return sizes;
  }

  Gaussians gaussians(const Batch& batch, int64_t view) const {
    const auto size = scene.sh.dimensions();
    return {batch.of(scene.means, view),
            batch.of(scene.quats, view),
            batch.of(scene.log_scales, view),
            batch.of(scene.opacity_logits, view),
            batch.of(scene.sh, view),
            static_cast<int>(size[batch.rank()]),
            static_cast<int>(size[batch.rank() + 1])};
  }
};

}  // namespace splatax
