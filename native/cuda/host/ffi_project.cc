// XLA custom calls of the projection and its gradient.
#include "handlers.h"

namespace splatax::cuda {
namespace {

constexpr int64_t MOST_GAUSSIANS = 1 << 30;
constexpr int MOST_COEFFICIENTS = 25;  // degree 4

// Arrays of a scene and a camera.
struct SceneArrays {
  const FloatArray &means, &quats, &log_scales, &opacity_logits, &sh, &camera;

  GaussianRows check(Checks& checks) const {
    const auto [n, k, three] = checks.sizes<3>("sh", sh);
    checks.range("the number of Gaussians", n, 0, MOST_GAUSSIANS).shape("sh", sh, {n, k, 3});
    int64_t bands = 1;
    while (bands * bands < std::min<int64_t>(k, MOST_COEFFICIENTS)) ++bands;
    checks.range("the number of SH coefficients", k, bands * bands, bands * bands);
    checks.shape("means", means, {n, 3}).shape("quats", quats, {n, 4}).shape("log_scales", log_scales, {n, 3});
    checks.shape("opacity_logits", opacity_logits, {n}).shape("camera", camera, {CAMERA_FIELDS});
    return {means.typed_data(),          quats.typed_data(), log_scales.typed_data(),
            opacity_logits.typed_data(), sh.typed_data(),    static_cast<int>(n),
            static_cast<int>(k)};
  }
};

void check_size(Checks& checks, int64_t width, int64_t height) {
  checks.range("the width", width, 1, LONGEST_SIDE).range("the height", height, 1, LONGEST_SIDE);
}

ffi::Error splats(SPLATAX_CONTEXT FloatArray means, FloatArray quats, FloatArray log_scales, FloatArray opacity_logits,
                  FloatArray sh, FloatArray camera, FloatResult means2d, FloatResult sqrt_conics, FloatResult depths,
                  FloatResult extents, FloatResult colors, FloatResult opacities, int64_t width, int64_t height,
                  float variance, int64_t fades, float least_fade) {
  SPLATAX_TAKE_CONTEXT;
  Checks checks;
  const GaussianRows rows = SceneArrays{means, quats, log_scales, opacity_logits, sh, camera}.check(checks);
  check_size(checks, width, height);
  const int64_t n = rows.count;
  checks.shape("means2d", means2d, {n, 2}).shape("sqrt_conics", sqrt_conics, {n, 3}).shape("depths", depths, {n});
  checks.shape("extents", extents, {n, 2}).shape("colors", colors, {n, 3}).shape("opacities", opacities, {n});
  if (checks.failed()) return checks.error("project");
  return queued("project", context, [&, width = width, height = height](Work& work) {
    const View view{camera.typed_data(), static_cast<int>(width), static_cast<int>(height), variance, fades != 0,
                    least_fade};
    work.launch("project", blocks_for(n), rows, view,
                ProjectedRows{means2d->typed_data(), sqrt_conics->typed_data(), depths->typed_data(),
                              extents->typed_data(), colors->typed_data(), opacities->typed_data()});
  });
}

ffi::Error gradient(SPLATAX_CONTEXT FloatArray means, FloatArray quats, FloatArray log_scales,
                    FloatArray opacity_logits, FloatArray sh, FloatArray camera, FloatArray extents,
                    FloatArray d_means2d, FloatArray d_sqrt_conics, FloatArray d_depths, FloatArray d_colors,
                    FloatArray d_opacities, FloatResult d_means, FloatResult d_quats, FloatResult d_log_scales,
                    FloatResult d_opacity_logits, FloatResult d_sh, FloatResult d_camera, int64_t width, int64_t height,
                    float variance, int64_t fades, float least_fade) {
  SPLATAX_TAKE_CONTEXT;
  Checks checks;
  const GaussianRows rows = SceneArrays{means, quats, log_scales, opacity_logits, sh, camera}.check(checks);
  check_size(checks, width, height);
  const int64_t n = rows.count, k = rows.coefficients;
  checks.shape("extents", extents, {n, 2}).shape("d_means2d", d_means2d, {n, 2});
  checks.shape("d_sqrt_conics", d_sqrt_conics, {n, 3}).shape("d_depths", d_depths, {n});
  checks.shape("d_colors", d_colors, {n, 3}).shape("d_opacities", d_opacities, {n});
  checks.shape("d_means", d_means, {n, 3}).shape("d_quats", d_quats, {n, 4});
  checks.shape("d_log_scales", d_log_scales, {n, 3}).shape("d_opacity_logits", d_opacity_logits, {n});
  checks.shape("d_sh", d_sh, {n, k, 3}).shape("d_camera", d_camera, {CAMERA_FIELDS});
  if (checks.failed()) return checks.error("project_gradient");
  return queued("project_gradient", context, [&, width = width, height = height](Work& work) {
    const View view{camera.typed_data(), static_cast<int>(width), static_cast<int>(height), variance, fades != 0,
                    least_fade};
    const int blocks = blocks_for(n);
    auto* parts = work.allocate<float>(static_cast<size_t>(blocks) * CAMERA_FIELDS);
    work.launch("project_gradient", blocks, rows, view,
                ProjectedCotangents{d_means2d.typed_data(), d_sqrt_conics.typed_data(), d_depths.typed_data(),
                                    extents.typed_data(), d_colors.typed_data(), d_opacities.typed_data()},
                GaussianGradients{d_means->typed_data(), d_quats->typed_data(), d_log_scales->typed_data(),
                                  d_opacity_logits->typed_data(), d_sh->typed_data(), parts});
    work.launch("sum_camera_parts", 1, blocks, static_cast<const float*>(parts), d_camera->typed_data());
  });
}

template <class Binding>
auto with_view(Binding binding) {
  return std::move(binding)
      .template Attr<int64_t>("width")
      .template Attr<int64_t>("height")
      .template Attr<float>("variance")
      .template Attr<int64_t>("fades")
      .template Attr<float>("least_fade");
}

}  // namespace
}  // namespace splatax::cuda

#pragma GCC visibility push(default)

using namespace splatax;

// (means [n 3], quats [n 4], log_scales [n 3], opacity_logits [n], sh [n k 3], camera as CameraField)
// -> the six fields of Splats
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_cuda_project, cuda::splats,
                              cuda::with_view(results<6>(arrays<6>(cuda::call()))));

// (the same six, extents, and the cotangents of means2d, sqrt_conics, depths, colors, opacities)
// -> the gradients of the six
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_cuda_project_gradient, cuda::gradient,
                              cuda::with_view(results<6>(arrays<12>(cuda::call()))));

#pragma GCC visibility pop
