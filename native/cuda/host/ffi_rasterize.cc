// XLA custom calls of the rasterizer and its gradient.
#include "handlers.h"
#include "rasterize.h"

namespace splatax::cuda {
namespace {

using WordArray = ffi::Buffer<ffi::U32>;
using WordResult = ffi::ResultBuffer<ffi::U32>;

constexpr int64_t MOST_SPLATS = 1 << 30, MOST_PAIRS = 1 << 30;

// Six arrays that describe the splats of a view.
struct SplatArrays {
  const FloatArray &means2d, &sqrt_conics, &depths, &extents, &opacities, &channels;

  SplatRows check(Checks& checks) const {
    const auto [n, c] = checks.sizes<2>("channels", channels);
    checks.range("the number of splats", n, 1, MOST_SPLATS);
    checks.range("the number of channels", c, 1, INT32_MAX / PIXELS).range("channels % 4", c % 4 == 2, 0, 0);
    checks.shape("means2d", means2d, {n, 2}).shape("sqrt_conics", sqrt_conics, {n, 3}).shape("depths", depths, {n});
    checks.shape("extents", extents, {n, 2}).shape("opacities", opacities, {n});
    return {means2d.typed_data(),   sqrt_conics.typed_data(), depths.typed_data(), extents.typed_data(),
            opacities.typed_data(), channels.typed_data(),    static_cast<int>(n), static_cast<int>(c)};
  }
};

void check_size(Checks& checks, int64_t width, int64_t height, int64_t max_pairs) {
  checks.range("the width", width, 1, LONGEST_SIDE).range("the height", height, 1, LONGEST_SIDE);
  checks.range("the number of tiles", ((width + TILE - 1) / TILE) * ((height + TILE - 1) / TILE), 1, MOST_PAIRS);
  checks.range("max_pairs", max_pairs, 1, MOST_PAIRS);
}

int64_t checkpoint_floats(const Sizes& sizes, const SplatRows& splats) {
  return static_cast<int64_t>(sizes.chunks()) * (1 + splats.channel_count) * PIXELS;
}

ffi::Error image(SPLATAX_CONTEXT FloatArray means2d, FloatArray sqrt_conics, FloatArray depths, FloatArray extents,
                 FloatArray opacities, FloatArray channels, FloatResult sums, FloatResult alpha, WordResult words,
                 FloatResult checkpoints, int64_t max_pairs) {
  SPLATAX_TAKE_CONTEXT;
  Checks checks;
  const SplatRows splats = SplatArrays{means2d, sqrt_conics, depths, extents, opacities, channels}.check(checks);
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  check_size(checks, w, h, max_pairs);
  checks.shape("sums", sums, {h, w, splats.channel_count});
  if (checks.failed()) return checks.error("rasterize");
  const Frame frame = frame_of(static_cast<int>(w), static_cast<int>(h));
  const Sizes sizes(splats, frame, max_pairs);
  const bool gradient_follows = checkpoints->element_count() > 0;
  checks.shape("words", words, {gradient_follows ? static_cast<int64_t>(sizes.words()) : 0});
  checks.shape("checkpoints", checkpoints, {gradient_follows ? checkpoint_floats(sizes, splats) : 0});
  if (checks.failed()) return checks.error("rasterize");
  return queued("rasterize", context, [&](Work& work) {
    uint32_t* memory = gradient_follows ? words->typed_data() : work.allocate<uint32_t>(sizes.words());
    const Lists lists(sizes, memory, gradient_follows ? checkpoints->typed_data() : nullptr);
    rasterize(work, splats, frame, sizes, lists, {sums->typed_data(), alpha->typed_data(), nullptr, 0, false});
  });
}

ffi::Error gradient(SPLATAX_CONTEXT FloatArray means2d, FloatArray sqrt_conics, FloatArray depths, FloatArray extents,
                    FloatArray opacities, FloatArray channels, FloatArray sums, FloatArray alpha, FloatArray d_sums,
                    FloatArray d_alpha, FloatArray checkpoints, WordArray words, FloatResult d_means2d,
                    FloatResult d_sqrt_conics, FloatResult d_opacities, FloatResult d_channels, FloatResult pull,
                    int64_t max_pairs) {
  SPLATAX_TAKE_CONTEXT;
  Checks checks;
  const SplatRows splats = SplatArrays{means2d, sqrt_conics, depths, extents, opacities, channels}.check(checks);
  const int64_t n = splats.count, c = splats.channel_count;
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  check_size(checks, w, h, max_pairs);
  checks.shape("sums", sums, {h, w, c}).shape("d_sums", d_sums, {h, w, c}).shape("d_alpha", d_alpha, {h, w});
  checks.shape("d_means2d", d_means2d, {n, 2}).shape("d_sqrt_conics", d_sqrt_conics, {n, 3});
  checks.shape("d_opacities", d_opacities, {n}).shape("d_channels", d_channels, {n, c});
  const bool pulled = pull->element_count() > 0;  // empty where not requested
  checks.shape("pull", pull, {pulled ? n : 0, 2}).range("the number of channels with pull", pulled ? c : 1, 1, 4);
  if (checks.failed()) return checks.error("rasterize_gradient");
  const Frame frame = frame_of(static_cast<int>(w), static_cast<int>(h));
  const Sizes sizes(splats, frame, max_pairs);
  checks.shape("words", words, {static_cast<int64_t>(sizes.words())});
  checks.shape("checkpoints", checkpoints, {checkpoint_floats(sizes, splats)});
  if (checks.failed()) return checks.error("rasterize_gradient");
  return queued("rasterize_gradient", context, [&](Work& work) {
    const Lists lists(sizes, words.typed_data(), checkpoints.typed_data());
    rasterize_gradient(
        work, splats, frame, sizes, lists,
        {sums.typed_data(), alpha.typed_data(), d_sums.typed_data(), d_alpha.typed_data(), 0},
        {d_means2d->typed_data(), d_sqrt_conics->typed_data(), d_opacities->typed_data(), d_channels->typed_data(),
         pulled ? pull->typed_data() : nullptr, 0});
  });
}

}  // namespace
}  // namespace splatax::cuda

#pragma GCC visibility push(default)

using namespace splatax;

// (means2d [n 2], sqrt_conics [n 3], depths [n], extents [n 2], opacities [n], channels [n c])
// -> (sums [h w c], alpha [h w], words and checkpoints for the gradient, empty if none follows)
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_cuda_rasterize, cuda::image,
                              arrays<6>(cuda::call())
                                  .Ret<FloatArray>()
                                  .Ret<FloatArray>()
                                  .Ret<cuda::WordArray>()
                                  .Ret<FloatArray>()
                                  .Attr<int64_t>("max_pairs"));

// (the same six, sums, alpha, their cotangents, checkpoints, words)
// -> gradients of means2d, sqrt_conics, opacities, channels and pull
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_cuda_rasterize_gradient, cuda::gradient,
                              results<5>(arrays<11>(cuda::call()).Arg<cuda::WordArray>())
                                  .Attr<int64_t>("max_pairs"));

#pragma GCC visibility pop
