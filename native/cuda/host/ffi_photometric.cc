// XLA custom call of the loss, which computes its gradient as well.
#include "handlers.h"

namespace splatax::cuda {
namespace {

constexpr int64_t MOST_BLOCKS = 1 << 30;

ffi::Error loss_and_gradient(SPLATAX_CONTEXT FloatArray image, FloatArray photo, FloatResult loss, FloatResult gradient,
                             float ssim_weight) {
  SPLATAX_TAKE_CONTEXT;
  Checks checks;
  const auto [h, w, c] = checks.sizes<3>("image", image);
  checks.range("the height", h, 1, LONGEST_SIDE).range("the width", w, 1, LONGEST_SIDE);
  checks.range("the number of channels", c, 1, INT16_MAX);
  checks.shape("photo", photo, {h, w, c}).shape("loss", loss, {}).shape("gradient", gradient, {h, w, c});
  const int64_t count = (h + TILE - 1) / TILE * ((w + TILE - 1) / TILE) * c;
  checks.range("the number of tiles of all channels", count, 1, MOST_BLOCKS);
  if (checks.failed()) return checks.error("photometric");
  return queued("photometric", context, [&, h = h, w = w, c = c](Work& work) {
    const size_t numbers = static_cast<size_t>(h) * w * c;
    const int blocks = static_cast<int>(count);
    const Pictures pictures{image.typed_data(), photo.typed_data(), static_cast<int>(w), static_cast<int>(h),
                            static_cast<int>(c)};
    const LossWeights weights{(1 - ssim_weight) / numbers, ssim_weight / numbers};
    auto* derivatives = work.allocate<float>(3 * numbers);
    auto* parts = work.allocate<float>(blocks);
    work.launch("photometric_loss", blocks, pictures, weights, derivatives, parts);
    work.launch("photometric_gradient", blocks, pictures, weights, static_cast<const float*>(derivatives),
                gradient->typed_data());
    work.launch("sum_loss_parts", 1, blocks, static_cast<const float*>(parts), loss->typed_data());
  });
}

}  // namespace
}  // namespace splatax::cuda

#pragma GCC visibility push(default)

using namespace splatax;

// (image [h w c], photo [h w c]) -> (loss [], its gradient in image)
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_cuda_photometric, cuda::loss_and_gradient,
                              results<2>(arrays<2>(cuda::call())).Attr<float>("ssim_weight"));

#pragma GCC visibility pop
