// XLA custom calls of the step of Adam by row.
#include <cmath>
#include <cstring>

#include "ffi_view.h"
#include "moving.h"
#include "settling.h"

namespace splatax {
namespace {

using Keys = ffi::Buffer<ffi::U32>;

// Returns a result that holds an argument. XLA gives both one buffer where it can.
float* held(const FloatArray& from, FloatResult& to) {
  if (to->typed_data() != from.typed_data()) {
    std::memcpy(to->typed_data(), from.typed_data(), from.size_bytes());
  } else {
    settling.settle(to->typed_data(), to->size_bytes());
  }
  return to->typed_data();
}
Fields<float> held(const FieldArrays<FloatArray>& from, const FieldArrays<FloatResult>& to) {
  return {held(from.means, to.means), held(from.quats, to.quats), held(from.log_scales, to.log_scales),
          held(from.opacity_logits, to.opacity_logits), held(from.sh, to.sh)};
}

// Reports numbers with which a step would spoil the scene.
void check_numbers(Checks& checks, const float* numbers) {
  for (int i = 0; i < MOVE_NUMBERS; ++i) {
    checks.require(std::isfinite(numbers[i]), "number " + std::to_string(i) + " of the step is not finite");
  }
  for (const MoveNumber decay : {MEAN_DECAY, SQUARE_DECAY}) {
    checks.require(numbers[decay] >= 0 && numbers[decay] < 1, "a decay is not in [0, 1)");
  }
  checks.require(numbers[EPSILON] > 0, "epsilon is not positive");
}

// The arguments of a move, beside the gradients.
struct MoveArguments {
  FieldArrays<FloatArray> scene, mean, square;
  const FloatArray &numbers, &mean_rates, &sh_rates, &sh_free;
  const Keys& keys;
  int64_t block;

  // Checks them and the results; returns the number of Gaussians.
  int64_t check(Checks& checks, const FieldArrays<FloatResult>& new_scene, const FieldArrays<FloatResult>& new_mean,
                const FieldArrays<FloatResult>& new_square) const {
    const auto [n, k, three] = checks.sizes<3>("sh", scene.sh);
    const auto [rates] = checks.sizes<1>("mean_rates", mean_rates);
    checks.range("the number of Gaussians", n, 0, MOST_ROWS).range("the number of SH coefficients", k, 1, MAX_COEFFICIENTS);
    checks.range("the rows of a block", block, 1, MOST_ROWS);
    if (checks.failed()) return 0;
    for (const auto& fields : {scene, mean, square}) fields.check(checks, n, k);
    for (const auto& fields : {new_scene, new_mean, new_square}) fields.check(checks, n, k);
    checks.shape("numbers", numbers, {MOVE_NUMBERS}).shape("mean_rates", mean_rates, {rates == 1 ? 1 : n});
    checks.shape("sh_rates", sh_rates, {k}).shape("sh_free", sh_free, {k});
    checks.shape("keys", keys, {(n + block - 1) / block, 2});
    checks.require(block >= n || block % 16 == 0, "the rows of a block are no multiple of 16");  // which move together
    if (!checks.failed()) check_numbers(checks, numbers.typed_data());
    return n;
  }

  // Returns the move, whose results already hold the arguments.
  Move move(const Fields<const float>& gradients, const Fields<float>& to, const Fields<float>& to_mean,
            const Fields<float>& to_square) const {
    const auto size = scene.sh.dimensions();
    return {numbers.typed_data(), mean_rates.typed_data(), mean_rates.dimensions()[0] != 1, sh_rates.typed_data(),
            sh_free.typed_data(), keys.typed_data(), static_cast<int>(block), static_cast<int>(size[0]),
            static_cast<int>(size[1]), gradients, to, to_mean, to_square};
  }
};

ffi::Error move(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales, FloatArray opacity_logits,
                FloatArray sh, FloatArray d_means, FloatArray d_quats, FloatArray d_log_scales, FloatArray d_opacity_logits,
                FloatArray d_sh, FloatArray m_means, FloatArray m_quats, FloatArray m_log_scales,
                FloatArray m_opacity_logits, FloatArray m_sh, FloatArray s_means, FloatArray s_quats, FloatArray s_log_scales,
                FloatArray s_opacity_logits, FloatArray s_sh, FloatArray numbers, FloatArray mean_rates, FloatArray sh_rates,
                FloatArray sh_free, Keys keys, FloatResult new_means, FloatResult new_quats, FloatResult new_log_scales,
                FloatResult new_opacity_logits, FloatResult new_sh, FloatResult new_m_means, FloatResult new_m_quats,
                FloatResult new_m_log_scales, FloatResult new_m_opacity_logits, FloatResult new_m_sh, FloatResult new_s_means,
                FloatResult new_s_quats, FloatResult new_s_log_scales, FloatResult new_s_opacity_logits, FloatResult new_s_sh,
                int64_t thread_limit, int64_t block) {
  const FieldArrays<FloatArray> gradients{d_means, d_quats, d_log_scales, d_opacity_logits, d_sh};
  const MoveArguments arguments{{means, quats, log_scales, opacity_logits, sh},
                                {m_means, m_quats, m_log_scales, m_opacity_logits, m_sh},
                                {s_means, s_quats, s_log_scales, s_opacity_logits, s_sh},
                                numbers, mean_rates, sh_rates, sh_free, keys, block};
  const FieldArrays<FloatResult> new_scene{new_means, new_quats, new_log_scales, new_opacity_logits, new_sh};
  const FieldArrays<FloatResult> new_mean{new_m_means, new_m_quats, new_m_log_scales, new_m_opacity_logits, new_m_sh};
  const FieldArrays<FloatResult> new_square{new_s_means, new_s_quats, new_s_log_scales, new_s_opacity_logits, new_s_sh};
  Checks checks;
  const int64_t n = arguments.check(checks, new_scene, new_mean, new_square);
  if (!checks.failed()) gradients.check(checks, n, sh.dimensions()[1]);
  if (checks.failed()) return checks.error("move");
  return guarded("move", [&] {
    if (n == 0) return;
    Workers workers(threads, thread_limit);
    move_rows(arguments.move({d_means.typed_data(), d_quats.typed_data(), d_log_scales.typed_data(),
                              d_opacity_logits.typed_data(), d_sh.typed_data()},
                             held(arguments.scene, new_scene), held(arguments.mean, new_mean),
                             held(arguments.square, new_square)),
              workers);
  });
}

ffi::Error pull_and_move(ffi::ThreadPool threads, FloatArray means, FloatArray quats, FloatArray log_scales,
                         FloatArray opacity_logits, FloatArray sh, FloatArray camera, FloatArray extents, FloatArray d_means2d,
                         FloatArray d_sqrt_conics, FloatArray d_depths, FloatArray d_colors, FloatArray d_opacities,
                         FloatArray m_means, FloatArray m_quats, FloatArray m_log_scales, FloatArray m_opacity_logits,
                         FloatArray m_sh, FloatArray s_means, FloatArray s_quats, FloatArray s_log_scales,
                         FloatArray s_opacity_logits, FloatArray s_sh, FloatArray numbers, FloatArray mean_rates,
                         FloatArray sh_rates, FloatArray sh_free, Keys keys, FloatResult new_means, FloatResult new_quats,
                         FloatResult new_log_scales, FloatResult new_opacity_logits, FloatResult new_sh,
                         FloatResult new_m_means, FloatResult new_m_quats, FloatResult new_m_log_scales,
                         FloatResult new_m_opacity_logits, FloatResult new_m_sh, FloatResult new_s_means,
                         FloatResult new_s_quats, FloatResult new_s_log_scales, FloatResult new_s_opacity_logits,
                         FloatResult new_s_sh, FloatResult d_camera, int64_t thread_limit, int64_t block, int64_t lens,
                         int64_t width, int64_t height, float variance, int64_t fades, float least_fade) {
  const Settings settings{lens, width, height, variance, fades, least_fade};
  const ViewArrays seen{{means, quats, log_scales, opacity_logits, sh}, camera};
  const MoveArguments arguments{{means, quats, log_scales, opacity_logits, sh},
                                {m_means, m_quats, m_log_scales, m_opacity_logits, m_sh},
                                {s_means, s_quats, s_log_scales, s_opacity_logits, s_sh},
                                numbers, mean_rates, sh_rates, sh_free, keys, block};
  const FieldArrays<FloatResult> new_scene{new_means, new_quats, new_log_scales, new_opacity_logits, new_sh};
  const FieldArrays<FloatResult> new_mean{new_m_means, new_m_quats, new_m_log_scales, new_m_opacity_logits, new_m_sh};
  const FieldArrays<FloatResult> new_square{new_s_means, new_s_quats, new_s_log_scales, new_s_opacity_logits, new_s_sh};
  Checks checks;
  const int64_t fields = settings.check(checks);
  if (!checks.failed()) seen.check(checks, fields);
  const int64_t n = arguments.check(checks, new_scene, new_mean, new_square);
  checks.shape("extents", extents, {n, 2}).shape("d_means2d", d_means2d, {n, 2});
  checks.shape("d_sqrt_conics", d_sqrt_conics, {n, 3}).shape("d_depths", d_depths, {n});
  checks.shape("d_colors", d_colors, {n, 3}).shape("d_opacities", d_opacities, {n}).shape("d_camera", d_camera, {fields});
  if (checks.failed()) return checks.error("pull_and_move");
  return guarded("pull_and_move", [&] {
    Workers workers(threads, thread_limit);
    const Fields<float> to = held(arguments.scene, new_scene);
    const Gaussians gaussians{to.means, to.quats, to.log_scales, to.opacity_logits, to.sh, static_cast<int>(n),
                              static_cast<int>(sh.dimensions()[1])};
    GradientByRows gradients(gaussians, settings.view(camera.typed_data()),
                             {d_means2d.typed_data(), d_sqrt_conics.typed_data(), d_depths.typed_data(),
                              d_colors.typed_data(), d_opacities.typed_data(), extents.typed_data()});
    move_rows(arguments.move({}, to, held(arguments.mean, new_mean), held(arguments.square, new_square)), gradients, workers);
    gradients.write_camera(d_camera->typed_data());
  });
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// (the fields of a scene, of its gradients, of the first and of the second moments: means [n 3], quats [n 4],
// log_scales [n 3], opacity_logits [n], sh [n k 3]; numbers as MoveNumber, mean_rates [1 or n], sh_rates [k],
// sh_free [k], keys [b 2]) -> the fields of the moved scene and of its moments
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_move, move,
                              results<15>(arrays<24>(call()).Arg<Keys>()).Attr<int64_t>("threads").Attr<int64_t>("block"));

// (the fields of a scene; camera and extents as of the projection; the cotangents of means2d [n 2], sqrt_conics [n 3],
// depths [n], colors [n 3], opacities [n]; the moments, and the rest as above)
// -> the fields of the moved scene and of its moments, and the gradient of the camera
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_pull_and_move, pull_and_move,
                              results<16>(arrays<26>(call()).Arg<Keys>())
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("block")
                                  .Attr<int64_t>("lens")
                                  .Attr<int64_t>("width")
                                  .Attr<int64_t>("height")
                                  .Attr<float>("variance")
                                  .Attr<int64_t>("fades")
                                  .Attr<float>("least_fade"));

#pragma GCC visibility pop
