// XLA custom calls of the projection and its gradient.
#include <map>

#include "ffi_view.h"
#include "large_pages.h"

namespace splatax {
namespace {

ffi::Error project_forward(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                           FloatArray opacity_logits, FloatArray sh, FloatArray camera, FloatResult means2d, FloatResult sqrt_conics,
                           FloatResult depths, FloatResult extents, FloatResult colors, FloatResult opacities, int64_t thread_limit,
                           int64_t lens, int64_t width, int64_t height, float variance, int64_t fades, float least_fade) {
  const Settings settings{lens, width, height, variance, fades, least_fade};
  const ViewArrays seen{{means, quats, log_scales, opacity_logits, sh}, camera};
  const Batch batch(means2d, 2);
  Checks checks(batch);
  const int64_t fields = settings.check(checks);
  const auto [n, k] = seen.check(checks, fields);
  checks.shape("means2d", means2d, {n, 2}).shape("sqrt_conics", sqrt_conics, {n, 3}).shape("depths", depths, {n});
  checks.shape("extents", extents, {n, 2}).shape("colors", colors, {n, 3}).shape("opacities", opacities, {n});
  if (checks.failed()) return checks.error("project_forward");
  return guarded("project_forward", [&] {
    all_in_large_pages(means2d, sqrt_conics, depths, extents, colors, opacities);
    Workers workers(threads, thread_limit);
    project(batch.views(), workers, [&](int view) {
      return ProjectedView{seen.gaussians(batch, view),
                           settings.view(batch.of(camera, view)),
                           {batch.of(means2d, view), batch.of(sqrt_conics, view), batch.of(depths, view),
                            batch.of(extents, view), batch.of(colors, view), batch.of(opacities, view)}};
    });
  });
}

ffi::Error project_backward(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                            FloatArray opacity_logits, FloatArray sh, FloatArray camera, FloatArray extents, FloatArray d_means2d,
                            FloatArray d_sqrt_conics, FloatArray d_depths, FloatArray d_colors, FloatArray d_opacities,
                            FloatResult d_means, FloatResult d_quats, FloatResult d_log_scales, FloatResult d_opacity_logits,
                            FloatResult d_sh, FloatResult d_camera, int64_t thread_limit, int64_t lens, int64_t width, int64_t height,
                            float variance, int64_t fades, float least_fade) {
  const Settings settings{lens, width, height, variance, fades, least_fade};
  const ViewArrays seen{{means, quats, log_scales, opacity_logits, sh}, camera};
  const Batch batch(d_camera, 1);
  // The gradient of a scene that all views share is summed over them here: `means` and `d_means` have one slice.
  const Batch scenes(d_means, 2);
  const bool summed = batch.views() > 1 && scenes.views() == 1;
  Checks checks(batch), scene_checks(summed ? scenes : batch);
  const int64_t fields = settings.check(checks);
  const auto [n, k] = seen.check(checks, fields);
  checks.shape("extents", extents, {n, 2}).shape("d_means2d", d_means2d, {n, 2});
  checks.shape("d_sqrt_conics", d_sqrt_conics, {n, 3}).shape("d_depths", d_depths, {n});
  checks.shape("d_colors", d_colors, {n, 3}).shape("d_opacities", d_opacities, {n});
  checks.shape("d_camera", d_camera, {fields});
  scene_checks.shape("d_means", d_means, {n, 3}).shape("d_quats", d_quats, {n, 4});
  scene_checks.shape("d_log_scales", d_log_scales, {n, 3}).shape("d_opacity_logits", d_opacity_logits, {n});
  scene_checks.shape("d_sh", d_sh, {n, k, 3});
  if (summed) seen.scene.check(scene_checks, n, k);
  if (checks.failed()) return checks.error("project_backward");
  if (scene_checks.failed()) return scene_checks.error("project_backward");
  return guarded("project_backward", [&] {
    all_in_large_pages(d_means, d_quats, d_log_scales, d_opacity_logits, d_sh);
    Workers workers(threads, thread_limit);
    const Batch& written = summed ? scenes : batch;
    const auto view_of = [&](int view) {
      const int slice = summed ? 0 : view;
      return PulledBackView{
          seen.gaussians(batch, view),
          settings.view(batch.of(camera, view)),
          {batch.of(d_means2d, view), batch.of(d_sqrt_conics, view), batch.of(d_depths, view), batch.of(d_colors, view),
           batch.of(d_opacities, view), batch.of(extents, view)},
          {written.of(d_means, slice), written.of(d_quats, slice), written.of(d_log_scales, slice),
           written.of(d_opacity_logits, slice), written.of(d_sh, slice), batch.of(d_camera, view)}};
    };
    project_gradient(batch.views(), summed, workers, view_of);
  });
}

ffi::Error project_forward_mode(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                                FloatArray opacity_logits, FloatArray sh, FloatArray camera, FloatArray extents,
                                FloatArray d_means, FloatArray d_quats, FloatArray d_log_scales, FloatArray d_opacity_logits,
                                FloatArray d_sh, FloatArray d_camera, FloatResult d_means2d, FloatResult d_sqrt_conics,
                                FloatResult d_depths, FloatResult d_colors, FloatResult d_opacities, int64_t thread_limit,
                                int64_t lens, int64_t width, int64_t height, float variance, int64_t fades,
                                float least_fade) {
  const Settings settings{lens, width, height, variance, fades, least_fade};
  const ViewArrays seen{{means, quats, log_scales, opacity_logits, sh}, camera};
  const Batch batch(d_depths, 1);
  Checks checks(batch);
  const int64_t fields = settings.check(checks);
  const auto [n, k] = seen.check(checks, fields);
  // What does not move has an empty tangent.
  const auto moves = [&](const FloatArray& tangent) {
    const auto size = tangent.dimensions();
    return size.size() <= batch.rank() || size[batch.rank()] != 0;
  };
  const auto rows = [&, n = n](const FloatArray& tangent) { return moves(tangent) ? n : 0; };
  checks.shape("extents", extents, {n, 2});
  checks.shape("d_means", d_means, {rows(d_means), 3}).shape("d_quats", d_quats, {rows(d_quats), 4});
  checks.shape("d_log_scales", d_log_scales, {rows(d_log_scales), 3});
  checks.shape("d_opacity_logits", d_opacity_logits, {rows(d_opacity_logits)}).shape("d_sh", d_sh, {rows(d_sh), k, 3});
  checks.shape("d_camera", d_camera, {moves(d_camera) ? fields : 0});
  checks.shape("d_means2d", d_means2d, {n, 2}).shape("d_sqrt_conics", d_sqrt_conics, {n, 3});
  checks.shape("d_depths", d_depths, {n}).shape("d_colors", d_colors, {n, 3}).shape("d_opacities", d_opacities, {n});
  if (checks.failed()) return checks.error("project_tangent");
  return guarded("project_tangent", [&] {
    const auto of = [&](const FloatArray& tangent, int64_t view) -> const float* {
      return moves(tangent) ? batch.of(tangent, view) : nullptr;
    };
    // Directions at the same scene and camera share what they have in common.
    std::map<std::array<const float*, 7>, PushedView> views_at;
    for (int64_t view = 0; view < batch.views(); ++view) {
      const Gaussians at = seen.gaussians(batch, view);
      const float *own = batch.of(camera, view), *reach = batch.of(extents, view);
      PushedView& group = views_at[{at.means, at.quats, at.log_scales, at.opacity_logits, at.sh, own, reach}];
      group.gaussians = at;
      group.view = settings.view(own);
      group.extents = reach;
      group.directions.push_back({of(d_means, view), of(d_quats, view), of(d_log_scales, view), of(d_opacity_logits, view),
                                  of(d_sh, view), of(d_camera, view), batch.of(d_means2d, view),
                                  batch.of(d_sqrt_conics, view), batch.of(d_depths, view), batch.of(d_colors, view),
                                  batch.of(d_opacities, view)});
    }
    std::vector<PushedView> views;
    for (auto& [_, group] : views_at) views.push_back(std::move(group));
    Workers workers(threads, thread_limit);
    project_tangents(views, workers);
  });
}

template <class Binding>
auto with_view(Binding binding) {
  return std::move(binding)
      .template Attr<int64_t>("threads")
      .template Attr<int64_t>("lens")
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

// All take batches; see `Batch`.

// (means [n 3], quats [n 4], log_scales [n 3], opacity_logits [n], sh [n k 3], camera as CameraField and its lens)
// -> the six fields of Splats
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project_forward, project_forward, with_view(results<6>(arrays<6>(call()))));

// (the same six, extents, and the cotangents of means2d, sqrt_conics, depths, colors, opacities)
// -> the gradients of the six; those of the scene with leading axes of 1 for their sum over the batch
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project_backward, project_backward,
                              with_view(results<6>(arrays<12>(call()))));

// (the same six, extents, and tangents of the six, with no rows where they do not move)
// -> the tangents of means2d, sqrt_conics, depths, colors, opacities
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project_tangent, project_forward_mode, with_view(results<5>(arrays<13>(call()))));

#pragma GCC visibility pop
