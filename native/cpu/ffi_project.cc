// XLA custom calls of the projection and its gradient.
#include "ffi.h"
#include "harmonics.h"
#include "projection.h"

namespace splatax {
namespace {

// Arrays of a scene and a camera.
struct SceneArrays {
  const FloatArray &means, &quats, &log_scales, &opacity_logits, &sh, &camera;

  // Checks them against each other; returns the numbers of Gaussians and SH coefficients.
  std::array<int64_t, 2> check(Checks& checks) const {
    const auto [n, k, three] = checks.sizes<3>("sh", sh);
    checks.range("the number of Gaussians", n, 0, MOST_ROWS);
    checks.range("the number of SH coefficients", k, 1, MAX_COEFFICIENTS).shape("sh", sh, {n, k, 3});
    int64_t bands = 1;
    while (bands * bands < k) ++bands;
    checks.range("the number of SH coefficients", k, bands * bands, bands * bands);
    checks.shape("means", means, {n, 3}).shape("quats", quats, {n, 4}).shape("log_scales", log_scales, {n, 3});
    checks.shape("opacity_logits", opacity_logits, {n}).shape("camera", camera, {CAMERA_FIELDS});
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

void check_size(Checks& checks, int64_t width, int64_t height) {
  checks.range("the width", width, 1, LONGEST_SIDE).range("the height", height, 1, LONGEST_SIDE);
}

ffi::Error project_forward(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                           FloatArray opacity_logits, FloatArray sh, FloatArray camera, FloatResult means2d, FloatResult sqrt_conics,
                           FloatResult depths, FloatResult extents, FloatResult colors, FloatResult opacities, int64_t thread_limit,
                           int64_t width, int64_t height, float variance, int64_t fades, float least_fade) {
  const SceneArrays scene{means, quats, log_scales, opacity_logits, sh, camera};
  const Batch batch(means2d, 2);
  Checks checks(batch);
  const auto [n, k] = scene.check(checks);
  check_size(checks, width, height);
  checks.shape("means2d", means2d, {n, 2}).shape("sqrt_conics", sqrt_conics, {n, 3}).shape("depths", depths, {n});
  checks.shape("extents", extents, {n, 2}).shape("colors", colors, {n, 3}).shape("opacities", opacities, {n});
  if (checks.failed()) return checks.error("project_forward");
  return guarded("project_forward", [&] {
    Workers workers(threads, thread_limit);
    project(batch.views(), workers, [&](int view) {
      return ProjectedView{scene.gaussians(batch, view),
                           {batch.of(camera, view), static_cast<int>(width), static_cast<int>(height), variance,
                            fades != 0, least_fade},
                           {batch.of(means2d, view), batch.of(sqrt_conics, view), batch.of(depths, view),
                            batch.of(extents, view), batch.of(colors, view), batch.of(opacities, view)}};
    });
  });
}

ffi::Error project_backward(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                            FloatArray opacity_logits, FloatArray sh, FloatArray camera, FloatArray extents, FloatArray d_means2d,
                            FloatArray d_sqrt_conics, FloatArray d_depths, FloatArray d_colors, FloatArray d_opacities,
                            FloatResult d_means, FloatResult d_quats, FloatResult d_log_scales, FloatResult d_opacity_logits,
                            FloatResult d_sh, FloatResult d_camera, int64_t thread_limit, int64_t width, int64_t height,
                            float variance, int64_t fades, float least_fade) {
  const SceneArrays scene{means, quats, log_scales, opacity_logits, sh, camera};
  const Batch batch(d_camera, 1);
  // The gradient of a scene that all views share is summed over them here: `means` and `d_means` have one slice.
  const Batch scenes(d_means, 2);
  const bool summed = batch.views() > 1 && scenes.views() == 1;
  Checks checks(batch), scene_checks(summed ? scenes : batch);
  const auto [n, k] = scene.check(checks);
  check_size(checks, width, height);
  checks.shape("extents", extents, {n, 2}).shape("d_means2d", d_means2d, {n, 2});
  checks.shape("d_sqrt_conics", d_sqrt_conics, {n, 3}).shape("d_depths", d_depths, {n});
  checks.shape("d_colors", d_colors, {n, 3}).shape("d_opacities", d_opacities, {n});
  checks.shape("d_camera", d_camera, {CAMERA_FIELDS});
  scene_checks.shape("d_means", d_means, {n, 3}).shape("d_quats", d_quats, {n, 4});
  scene_checks.shape("d_log_scales", d_log_scales, {n, 3}).shape("d_opacity_logits", d_opacity_logits, {n});
  scene_checks.shape("d_sh", d_sh, {n, k, 3});
  if (summed) {
    scene_checks.shape("means", means, {n, 3}).shape("quats", quats, {n, 4}).shape("log_scales", log_scales, {n, 3});
    scene_checks.shape("opacity_logits", opacity_logits, {n}).shape("sh", sh, {n, k, 3});
  }
  if (checks.failed()) return checks.error("project_backward");
  if (scene_checks.failed()) return scene_checks.error("project_backward");
  return guarded("project_backward", [&] {
    Workers workers(threads, thread_limit);
    const Batch& written = summed ? scenes : batch;
    const auto view_of = [&](int view) {
      const int slice = summed ? 0 : view;
      return PulledBackView{
          scene.gaussians(batch, view),
          {batch.of(camera, view), static_cast<int>(width), static_cast<int>(height), variance, fades != 0, least_fade},
          {batch.of(d_means2d, view), batch.of(d_sqrt_conics, view), batch.of(d_depths, view), batch.of(d_colors, view),
           batch.of(d_opacities, view), batch.of(extents, view)},
          {written.of(d_means, slice), written.of(d_quats, slice), written.of(d_log_scales, slice),
           written.of(d_opacity_logits, slice), written.of(d_sh, slice), batch.of(d_camera, view)}};
    };
    project_gradient(batch.views(), summed, workers, view_of);
  });
}

template <class Binding>
auto with_view(Binding binding) {
  return std::move(binding)
      .template Attr<int64_t>("threads")
      .template Attr<int64_t>("width")
      .template Attr<int64_t>("height")
      .template Attr<float>("variance")
      .template Attr<int64_t>("fades")
      .template Attr<float>("least_fade");
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// Both take batches; see `Batch`.

// (means [n 3], quats [n 4], log_scales [n 3], opacity_logits [n], sh [n k 3], camera as CameraField)
// -> the six fields of Splats
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project_forward, project_forward, with_view(results<6>(arrays<6>(call()))));

// (the same six, extents, and the cotangents of means2d, sqrt_conics, depths, colors, opacities)
// -> the gradients of the six; those of the scene with leading axes of 1 for their sum over the batch
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project_backward, project_backward,
                              with_view(results<6>(arrays<12>(call()))));

#pragma GCC visibility pop
