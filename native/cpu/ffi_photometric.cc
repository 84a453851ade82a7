// XLA custom call of the loss, which computes its gradient as well.
#include "ffi.h"
#include "photometric.h"
#include "scratch_pool.h"

namespace splatax {
namespace {

ffi::Error photometric_loss(ffi::ThreadPool threads, FloatArray image, FloatArray photo, FloatResult loss, FloatResult gradient,
                            int64_t thread_limit, float ssim_weight) {
  Checks checks;
  const auto [h, w, c] = checks.sizes<3>("image", image);
  checks.range("the height", h, 1, LONGEST_SIDE).range("the width", w, 1, LONGEST_SIDE);
  checks.range("the number of channels", c, 1, INT32_MAX / LONGEST_SIDE);  // a row is counted in 32 bits
  checks.shape("photo", photo, {h, w, c}).shape("loss", loss, {}).shape("gradient", gradient, {h, w, c});
  if (checks.failed()) return checks.error("photometric");
  return guarded("photometric", [&, h = h, w = w, c = c] {
    Workers workers(threads, thread_limit);
    const Pictures pictures{image.typed_data(), photo.typed_data(), static_cast<int>(h), static_cast<int>(w),
                            static_cast<int>(c)};
    auto scratch = pool.take();
    float* memory = scratch->derivatives.at_least(photometric_scratch(pictures));
    *loss->typed_data() = photometric(pictures, ssim_weight, gradient->typed_data(), memory, workers);
    pool.give_back(std::move(scratch));
  });
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// (image [h w c], photo [h w c]) -> (loss [], its gradient in image)
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_photometric, photometric_loss,
                              results<2>(arrays<2>(call())).Attr<int64_t>("threads").Attr<float>("ssim_weight"));

#pragma GCC visibility pop
