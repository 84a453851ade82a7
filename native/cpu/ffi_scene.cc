// XLA custom calls of a batch of views of one scene.
#include "ffi_fields.h"
#include "scene_views.h"

namespace splatax {
namespace {

SceneMemories memories;

// Arrays of a scene, with the cameras of the batch and what each of them fills of its image.
struct ViewsArrays {
  FieldArrays<FloatArray> scene;
  FloatArray &cameras, &frames;

  // Checks them against each other; returns the numbers of Gaussians, SH coefficients and views.
  std::array<int64_t, 3> check(Checks& checks) const {
    const auto [n, k] = check_scene(checks, scene);
    const auto [v, fields] = checks.sizes<2>("cameras", cameras);
    checks.range("the number of views", v, 0, MOST_ROWS).shape("cameras", cameras, {v, CAMERA_FIELDS});
    checks.shape("frames", frames, {v, 2});
    return {n, k, v};
  }
};

// Options of a call, beside the number of threads.
struct Options {
  int64_t max_pairs;
  float variance;
  int64_t fades;
  float least_fade;
  int64_t by_distance;
};

// Checks the images of the views; returns height, width and number of channels.
std::array<int64_t, 3> check_images(Checks& checks, int64_t views, const std::array<int64_t, 4>& size, int64_t max_pairs) {
  const auto [v, h, w, c] = size;
  checks.range("the number of images", v, views, views).range("the number of channels", c, 3, GROUP);
  checks.range("the width", w, 1, LONGEST_SIDE).range("the height", h, 1, LONGEST_SIDE);
  checks.range("the number of tiles", ((w + TILE - 1) / TILE) * ((h + TILE - 1) / TILE), 1, INT32_MAX / 2);
  checks.range("max_pairs", max_pairs, 1, INT32_MAX / 2);
  return {h, w, c};
}

SceneViews views_of(const ViewsArrays& arrays, const std::array<int64_t, 3>& sizes, const std::array<int64_t, 3>& image,
                    const Options& options) {
  const auto [n, k, v] = sizes;
  const auto [h, w, c] = image;
  const auto& [means, quats, log_scales, opacity_logits, sh] = arrays.scene;
  const Gaussians gaussians{means.typed_data(),          quats.typed_data(), log_scales.typed_data(),
                            opacity_logits.typed_data(), sh.typed_data(),    static_cast<int>(n),
                            static_cast<int>(k)};
  const View settings{nullptr, LensKind::PINHOLE, 0, 0, options.variance, options.fades != 0, options.least_fade};
  return {gaussians,           arrays.cameras.typed_data(), arrays.frames.typed_data(), settings,
          static_cast<int>(w), static_cast<int>(h),         static_cast<int>(v),        static_cast<int>(c),
          options.max_pairs,   options.by_distance != 0};
}

ffi::Error scene_forward(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                         FloatArray opacity_logits, FloatArray sh, FloatArray cameras, FloatArray frames, FloatResult sums,
                         FloatResult alpha, int64_t thread_limit, int64_t max_pairs, float variance, int64_t fades,
                         float least_fade, int64_t by_distance) {
  const ViewsArrays arrays{{means, quats, log_scales, opacity_logits, sh}, cameras, frames};
  Checks checks;
  const auto scene = arrays.check(checks);
  const auto image = check_images(checks, scene[2], checks.sizes<4>("sums", sums), max_pairs);
  checks.shape("alpha", alpha, {scene[2], image[0], image[1]});
  if (checks.failed()) return checks.error("scene_forward");
  return guarded("scene_forward", [&] {
    Workers workers(threads, thread_limit);
    auto memory = memories.take();
    draw_views(views_of(arrays, scene, image, {max_pairs, variance, fades, least_fade, by_distance}),
               {sums->typed_data(), alpha->typed_data()}, workers, *memory);
    memories.give_back(std::move(memory));
  });
}

ffi::Error scene_backward(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                          FloatArray opacity_logits, FloatArray sh, FloatArray cameras, FloatArray frames, FloatArray sums,
                          FloatArray alpha, FloatArray d_sums, FloatArray d_alpha, FloatResult d_means, FloatResult d_quats,
                          FloatResult d_log_scales, FloatResult d_opacity_logits, FloatResult d_sh, FloatResult d_cameras,
                          int64_t thread_limit, int64_t max_pairs, float variance, int64_t fades, float least_fade,
                          int64_t by_distance) {
  const ViewsArrays arrays{{means, quats, log_scales, opacity_logits, sh}, cameras, frames};
  Checks checks;
  const auto scene = arrays.check(checks);
  const auto image = check_images(checks, scene[2], checks.sizes<4>("sums", sums), max_pairs);
  const auto [n, k, v] = scene;
  const auto [h, w, c] = image;
  checks.shape("alpha", alpha, {v, h, w}).shape("d_sums", d_sums, {v, h, w, c}).shape("d_alpha", d_alpha, {v, h, w});
  checks.shape("d_means", d_means, {n, 3}).shape("d_quats", d_quats, {n, 4}).shape("d_log_scales", d_log_scales, {n, 3});
  checks.shape("d_opacity_logits", d_opacity_logits, {n}).shape("d_sh", d_sh, {n, k, 3});
  checks.shape("d_cameras", d_cameras, {v, CAMERA_FIELDS});
  if (checks.failed()) return checks.error("scene_backward");
  return guarded("scene_backward", [&] {
    Workers workers(threads, thread_limit);
    auto memory = memories.take();
    draw_views_gradient(views_of(arrays, scene, image, {max_pairs, variance, fades, least_fade, by_distance}),
                        {sums.typed_data(), alpha.typed_data(), d_sums.typed_data(), d_alpha.typed_data()},
                        {d_means->typed_data(), d_quats->typed_data(), d_log_scales->typed_data(),
                         d_opacity_logits->typed_data(), d_sh->typed_data(), d_cameras->typed_data()},
                        workers, *memory);
    memories.give_back(std::move(memory));
  });
}

template <class Binding>
auto with_options(Binding binding) {
  return std::move(binding)
      .template Attr<int64_t>("threads")
      .template Attr<int64_t>("max_pairs")
      .template Attr<float>("variance")
      .template Attr<int64_t>("fades")
      .template Attr<float>("least_fade")
      .template Attr<int64_t>("by_distance");
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// (means [n 3], quats [n 4], log_scales [n 3], opacity_logits [n], sh [n k 3], cameras [v] as CameraField, frames [v 2])
// -> (sums [v h w 3], or [v h w 4] with depths, alpha [v h w])
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_scene_forward, scene_forward, with_options(results<2>(arrays<7>(call()))));

// (the same seven, sums, alpha, d_sums, d_alpha) -> the gradients of all but frames
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_scene_backward, scene_backward, with_options(results<6>(arrays<11>(call()))));

#pragma GCC visibility pop
