// The library's face: XLA custom calls, registered from Python by splatax/native.
#include <mutex>
#include <vector>

#include "limits.h"
#include "photometric.h"
#include "projection.h"
#include "rasterize.h"
#include "xla/ffi/api/ffi.h"

namespace splatax {
namespace {

namespace ffi = xla::ffi;
using Floats = ffi::Buffer<ffi::F32>;
using Result = ffi::ResultBuffer<ffi::F32>;
using Ticket = ffi::Buffer<ffi::S32>;

// Lends scratch memory to calls, one each, and keeps some of it. What `rasterize` leaves there spares
// its gradient the binning: a ticket goes with the image, and whoever shows it gets that memory back,
// if nobody has needed it in between. Results do not depend on it.
class ScratchPool {
 public:
  std::unique_ptr<Scratch> take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    const bool expected = !free_.empty() && free_.front()->expected;
    if (free_.empty() || (expected && free_.size() < KEPT)) return std::make_unique<Scratch>();
    return remove(free_.begin());
  }
  // The memory of a ticket; null if it is not there any more.
  std::unique_ptr<Scratch> take(int32_t ticket) {
    const std::lock_guard<std::mutex> lock(mutex_);
    for (auto it = free_.begin(); it != free_.end(); ++it) {
      if ((*it)->ticket == ticket) return remove(it);
    }
    return nullptr;
  }
  void give_back(std::unique_ptr<Scratch> scratch) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (free_.size() < KEPT) free_.insert(scratch->expected ? free_.end() : free_.begin(), std::move(scratch));
  }
  int32_t new_ticket() {
    const std::lock_guard<std::mutex> lock(mutex_);
    last_ = last_ == INT32_MAX ? 1 : last_ + 1;
    return last_;
  }

 private:
  static constexpr size_t KEPT = 3;
  using List = std::vector<std::unique_ptr<Scratch>>;

  std::unique_ptr<Scratch> remove(List::iterator it) {
    auto scratch = std::move(*it);
    free_.erase(it);
    return scratch;
  }

  std::mutex mutex_;
  int32_t last_ = 0;
  List free_;  // in the order in which they are to be used again
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
                   Floats opacities, Floats channels, Result sums, Result alpha,
                   ffi::ResultBuffer<ffi::S32> ticket, int64_t thread_limit, int64_t max_pairs,
                   int64_t gradient_follows) {
  Workers workers(threads, thread_limit);
  const auto size = alpha->dimensions();
  const Input input =
      input_of(means2d, sqrt_conics, depths, extents, opacities, channels, size[1], size[0]);
  auto scratch = pool.take();
  scratch->ticket = 0;
  rasterize(input, {sums->typed_data(), alpha->typed_data()}, workers, *scratch, max_pairs);
  *ticket->typed_data() = scratch->ticket = pool.new_ticket();
  scratch->expected = gradient_follows != 0;
  pool.give_back(std::move(scratch));
  return ffi::Error::Success();
}

ffi::Error backward(ffi::ThreadPool threads, Floats means2d, Floats sqrt_conics, Floats depths,
                    Floats extents, Floats opacities, Floats channels, Floats sums, Floats alpha,
                    Ticket ticket, Floats d_sums, Floats d_alpha, Result d_means2d, Result d_sqrt_conics,
                    Result d_opacities, Result d_channels, Result d_pull, int64_t thread_limit,
                    int64_t max_pairs) {
  Workers workers(threads, thread_limit);
  const auto size = alpha.dimensions();
  const Input input =
      input_of(means2d, sqrt_conics, depths, extents, opacities, channels, size[1], size[0]);
  auto scratch = pool.take(*ticket.typed_data());
  const bool binned = scratch != nullptr;
  if (!binned) {
    scratch = pool.take();
    scratch->ticket = 0;
  }
  scratch->expected = false;
  rasterize_gradient(
      input, {sums.typed_data(), alpha.typed_data(), d_sums.typed_data(), d_alpha.typed_data()},
      {d_means2d->typed_data(), d_sqrt_conics->typed_data(), d_opacities->typed_data(),
       d_channels->typed_data(), d_pull->element_count() ? d_pull->typed_data() : nullptr},
      workers, *scratch, binned, max_pairs);
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

ffi::Error photometric_loss(ffi::ThreadPool threads, Floats image, Floats photo, Result loss, Result gradient,
                            int64_t thread_limit, float ssim_weight) {
  Workers workers(threads, thread_limit);
  const auto size = image.dimensions();
  const Pictures pictures{image.typed_data(), photo.typed_data(), static_cast<int>(size[0]),
                          static_cast<int>(size[1]), static_cast<int>(size[2])};
  auto scratch = pool.take();
  float* memory = scratch->derivatives.at_least(photometric_scratch(pictures));
  *loss->typed_data() = photometric(pictures, ssim_weight, gradient->typed_data(), memory, workers);
  pool.give_back(std::move(scratch));
  return ffi::Error::Success();
}

ffi::Error slots(ffi::ThreadPool threads, Floats means2d, Floats sqrt_conics, Floats depths, Floats extents,
                 Floats opacities, Floats channels, ffi::ResultBuffer<ffi::S32> counts, int64_t thread_limit,
                 int64_t max_pairs, int64_t width, int64_t height) {
  Workers workers(threads, thread_limit);
  const Input input = input_of(means2d, sqrt_conics, depths, extents, opacities, channels, width, height);
  Scratch scratch;
  count_slots(input, reinterpret_cast<int32_t(*)[2]>(counts->typed_data()), workers, scratch, max_pairs);
  return ffi::Error::Success();
}

ffi::Error work(ffi::ThreadPool threads, Result sums, int64_t, int64_t rounds) {
  Workers workers(threads, static_cast<int64_t>(sums->element_count()));
  std::fill_n(sums->typed_data(), sums->element_count(), 0.0f);
  multiply_adds(rounds, sums->typed_data(), workers);
  return ffi::Error::Success();
}

// A binding to which `add` has added something N times.
template <int N, class Binding, class Add>
auto repeated(Binding&& binding, const Add& add) {
  if constexpr (N == 1) {
    return add(std::move(binding));
  } else {
    return repeated<N - 1>(add(std::move(binding)), add);
  }
}

// A binding with N more arrays, all of them float32, as arguments or results.
template <int N, class Binding>
auto arrays(Binding&& binding) {
  return repeated<N>(std::move(binding), [](auto&& b) { return std::move(b).template Arg<Floats>(); });
}
template <int N, class Binding>
auto results(Binding&& binding) {
  return repeated<N>(std::move(binding), [](auto&& b) { return std::move(b).template Ret<Floats>(); });
}

// Calls begin with this.
auto call() { return ffi::Ffi::Bind().Ctx<ffi::ThreadPool>(); }

template <class Binding>
auto with_rasterizer_settings(Binding binding) {
  return std::move(binding).template Attr<int64_t>("threads").template Attr<int64_t>("max_pairs");
}
template <class Binding>
auto with_view(Binding binding) {
  return std::move(binding)
      .template Attr<int64_t>("threads")
      .template Attr<int64_t>("width")
      .template Attr<int64_t>("height")
      .template Attr<float>("variance")
      .template Attr<float>("floor");
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// (means2d [n 2], sqrt_conics [n 3], depths [n], extents [n 2], opacities [n], channels [n c])
// -> (sums [h w c], alpha [h w], ticket [])
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_rasterize, forward,
                              with_rasterizer_settings(results<2>(arrays<6>(call())).Ret<Ticket>())
                                  .Attr<int64_t>("gradient_follows"));

// (the same six, sums, alpha, ticket, d_sums, d_alpha)
// -> (d_means2d, d_sqrt_conics, d_opacities, d_channels, d_pull [n 2], or [0 2] where it is not wanted)
XLA_FFI_DEFINE_HANDLER_SYMBOL(
    splatax_rasterize_gradient, backward,
    with_rasterizer_settings(results<5>(arrays<2>(arrays<8>(call()).Arg<Ticket>()))));

// (means [n 3], quats [n 4], log_scales [n 3], opacity_logits [n], sh [n k 3], camera as CameraField)
// -> the six fields of Splats
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project, project_forward, with_view(results<6>(arrays<6>(call()))));

// (the same six, extents, and the cotangents of means2d, sqrt_conics, depths, colors, opacities)
// -> the gradients of the six
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_project_gradient, project_backward,
                              with_view(results<6>(arrays<12>(call()))));

// (image [h w c], photo [h w c]) -> (loss [], its gradient in image)
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_photometric, photometric_loss,
                              results<2>(arrays<2>(call())).Attr<int64_t>("threads").Attr<float>("ssim_weight"));

// (the six of splatax_rasterize) -> counts [tiles 2]
XLA_FFI_DEFINE_HANDLER_SYMBOL(
    splatax_slots, slots,
    with_rasterizer_settings(arrays<6>(call()).Ret<Ticket>()).Attr<int64_t>("width").Attr<int64_t>("height"));

// () -> a number for each thread
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_multiply_adds, work,
                              results<1>(call()).Attr<int64_t>("threads").Attr<int64_t>("rounds"));

#pragma GCC visibility pop
