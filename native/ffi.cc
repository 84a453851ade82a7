// The library's face: XLA custom calls, registered from Python by splatax/rasterizers/cpu.py.
#include <mutex>
#include <string>
#include <vector>

#include "projection.h"
#include "rasterize.h"
#include "xla/ffi/api/ffi.h"

namespace splatax {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Result = ffi::ResultBuffer<ffi::F32>;

// Lends scratch memory to calls, one each; as many are kept as have ever run at the same time.
class ScratchPool {
 public:
  std::unique_ptr<Scratch> take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (free_.empty()) return std::make_unique<Scratch>();
    auto scratch = std::move(free_.back());
    free_.pop_back();
    return scratch;
  }
  void give_back(std::unique_ptr<Scratch> scratch) {
    const std::lock_guard<std::mutex> lock(mutex_);
    free_.push_back(std::move(scratch));
  }

 private:
  std::mutex mutex_;
  std::vector<std::unique_ptr<Scratch>> free_;
};

ScratchPool pool;

Input input_of(const Floats& means2d, const Floats& sqrt_conics, const Floats& depths, const Floats& extents,
               const Floats& opacities, const Floats& channels, int64_t width, int64_t height) {
  return {means2d.typed_data(),
          sqrt_conics.typed_data(),
          depths.typed_data(),
          extents.typed_data(),
          opacities.typed_data(),
          channels.typed_data(),
          static_cast<int>(channels.dimensions()[0]),
          static_cast<int>(channels.dimensions()[1]),
          static_cast<int>(width),
          static_cast<int>(height)};
}

ffi::Error forward(ffi::ThreadPool threads, Floats means2d, Floats sqrt_conics, Floats depths, Floats extents,
                   Floats opacities, Floats channels, Result sums, Result alpha, int64_t thread_limit,
                   int64_t max_pairs) {
  Workers workers(threads, thread_limit);
  const auto size = alpha->dimensions();
  const Input input =
      input_of(means2d, sqrt_conics, depths, extents, opacities, channels, size[1], size[0]);
  auto scratch = pool.take();
  rasterize(input, {sums->typed_data(), alpha->typed_data()}, workers, *scratch, max_pairs);
  pool.give_back(std::move(scratch));
  return ffi::Error::Success();
}

ffi::Error backward(ffi::ThreadPool threads, Floats means2d, Floats sqrt_conics, Floats depths,
                    Floats extents, Floats opacities, Floats channels, Floats sums, Floats alpha,
                    Floats d_sums, Floats d_alpha, Result d_means2d, Result d_sqrt_conics,
                    Result d_opacities, Result d_channels, int64_t thread_limit, int64_t max_pairs) {
  Workers workers(threads, thread_limit);
  const auto size = alpha.dimensions();
  const Input input =
      input_of(means2d, sqrt_conics, depths, extents, opacities, channels, size[1], size[0]);
  auto scratch = pool.take();
  rasterize_gradient(
      input, {sums.typed_data(), alpha.typed_data(), d_sums.typed_data(), d_alpha.typed_data()},
      {d_means2d->typed_data(), d_sqrt_conics->typed_data(), d_opacities->typed_data(),
       d_channels->typed_data()},
      workers, *scratch, max_pairs);
  pool.give_back(std::move(scratch));
  return ffi::Error::Success();
}

View view_of(const Floats& camera, int64_t width, int64_t height, float variance, float floor) {
  return {camera.typed_data(), static_cast<int>(width), static_cast<int>(height), variance, floor};
}

Gaussians gaussians_of(const Floats& means, const Floats& quats, const Floats& log_scales,
                       const Floats& opacity_logits, const Floats& sh) {
  return {means.typed_data(),          quats.typed_data(), log_scales.typed_data(),
          opacity_logits.typed_data(), sh.typed_data(),    static_cast<int>(sh.dimensions()[0]),
          static_cast<int>(sh.dimensions()[1])};
}

ffi::Error project_forward(ffi::ThreadPool threads, Floats means, Floats quats, Floats log_scales,
                           Floats opacity_logits, Floats sh, Floats camera, Result means2d,
                           Result sqrt_conics, Result depths, Result extents, Result colors,
                           Result opacities, int64_t thread_limit, int64_t width, int64_t height,
                           float variance, float floor) {
  Workers workers(threads, thread_limit);
  project(gaussians_of(means, quats, log_scales, opacity_logits, sh),
          view_of(camera, width, height, variance, floor),
          {means2d->typed_data(), sqrt_conics->typed_data(), depths->typed_data(), extents->typed_data(),
           colors->typed_data(), opacities->typed_data()},
          workers);
  return ffi::Error::Success();
}

ffi::Error project_backward(ffi::ThreadPool threads, Floats means, Floats quats, Floats log_scales,
                            Floats opacity_logits, Floats sh, Floats camera, Floats extents,
                            Floats d_means2d, Floats d_sqrt_conics, Floats d_depths, Floats d_colors,
                            Floats d_opacities, Result d_means, Result d_quats, Result d_log_scales,
                            Result d_opacity_logits, Result d_sh, Result d_camera, int64_t thread_limit,
                            int64_t width, int64_t height, float variance, float floor) {
  Workers workers(threads, thread_limit);
  project_gradient(gaussians_of(means, quats, log_scales, opacity_logits, sh),
                   view_of(camera, width, height, variance, floor),
                   {d_means2d.typed_data(), d_sqrt_conics.typed_data(), d_depths.typed_data(),
                    d_colors.typed_data(), d_opacities.typed_data(), extents.typed_data()},
                   {d_means->typed_data(), d_quats->typed_data(), d_log_scales->typed_data(),
                    d_opacity_logits->typed_data(), d_sh->typed_data(), d_camera->typed_data()},
                   workers);
  return ffi::Error::Success();
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_rasterize, splatax::forward,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<splatax::Floats>()   // means2d [n 2]
                                  .Arg<splatax::Floats>()   // sqrt_conics [n 3]
                                  .Arg<splatax::Floats>()   // depths [n]
                                  .Arg<splatax::Floats>()   // extents [n 2]
                                  .Arg<splatax::Floats>()   // opacities [n]
                                  .Arg<splatax::Floats>()   // channels [n c]
                                  .Ret<splatax::Floats>()   // sums [h w c]
                                  .Ret<splatax::Floats>()   // alpha [h w]
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("max_pairs"));

XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_rasterize_gradient, splatax::backward,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<splatax::Floats>()   // as above
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()   // sums
                                  .Arg<splatax::Floats>()   // alpha
                                  .Arg<splatax::Floats>()   // d_sums
                                  .Arg<splatax::Floats>()   // d_alpha
                                  .Ret<splatax::Floats>()   // d_means2d
                                  .Ret<splatax::Floats>()   // d_sqrt_conics
                                  .Ret<splatax::Floats>()   // d_opacities
                                  .Ret<splatax::Floats>()   // d_channels
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("max_pairs"));

XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project, splatax::project_forward,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<splatax::Floats>()   // means [n 3]
                                  .Arg<splatax::Floats>()   // quats [n 4]
                                  .Arg<splatax::Floats>()   // log_scales [n 3]
                                  .Arg<splatax::Floats>()   // opacity_logits [n]
                                  .Arg<splatax::Floats>()   // sh [n k 3]
                                  .Arg<splatax::Floats>()   // camera, as CameraField
                                  .Ret<splatax::Floats>()   // the fields of Splats
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("width")
                                  .Attr<int64_t>("height")
                                  .Attr<float>("variance")
                                  .Attr<float>("floor"));

XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project_gradient, splatax::project_backward,
                              xla::ffi::Ffi::Bind()
                                  .Ctx<xla::ffi::ThreadPool>()
                                  .Arg<splatax::Floats>()   // as above
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()   // extents
                                  .Arg<splatax::Floats>()   // cotangents of the other fields of Splats
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Arg<splatax::Floats>()
                                  .Ret<splatax::Floats>()   // gradients of the first six arguments
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Ret<splatax::Floats>()
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("width")
                                  .Attr<int64_t>("height")
                                  .Attr<float>("variance")
                                  .Attr<float>("floor"));

#pragma GCC visibility pop
