// XLA custom calls of splats that are drawn along rays: image and gradient.
#include "ffi.h"
#include "scratch_pool.h"
#include "slanted.h"

namespace splatax {
namespace {

// The ellipses that hold the splats of a view, and the rows of what is drawn in them.
struct SlantedArrays {
  const FloatArray &means2d, &sqrt_conics, &depths, &extents, &opacities, &rows;

  int64_t check(Checks& checks, int64_t width, int64_t height, int64_t max_pairs) const {
    const auto [n] = checks.sizes<1>("depths", depths);
    checks.range("the number of splats", n, 0, MOST_ROWS / SLANTED_SUMS);
    checks.shape("means2d", means2d, {n, 2}).shape("sqrt_conics", sqrt_conics, {n, 3});
    checks.shape("extents", extents, {n, 2}).shape("opacities", opacities, {n}).shape("rows", rows, {n, SLANTED_ROW});
    checks.range("the width", width, 1, LONGEST_SIDE).range("the height", height, 1, LONGEST_SIDE);
    checks.range("the number of tiles", ((width + TILE - 1) / TILE) * ((height + TILE - 1) / TILE), 1, INT32_MAX / 2);
    checks.range("max_pairs", max_pairs, 1, INT32_MAX / 2);
    return n;
  }

  Input input(int64_t n, int64_t width, int64_t height) const {
    return {means2d.typed_data(),   sqrt_conics.typed_data(), depths.typed_data(),       extents.typed_data(),
            opacities.typed_data(), rows.typed_data(),        static_cast<int>(n),       SLANTED_ROW,
            static_cast<int>(width), static_cast<int>(height)};
  }
};

ffi::Error slanted_forward(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                           FloatArray extents, FloatArray opacities, FloatArray rows, FloatResult sums, FloatResult alpha,
                           int64_t thread_limit, int64_t max_pairs) {
  const SlantedArrays splats{means2d, sqrt_conics, depths, extents, opacities, rows};
  Checks checks;
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  const int64_t n = splats.check(checks, w, h, max_pairs);
  checks.shape("sums", sums, {h, w, GROUP});
  if (checks.failed()) return checks.error("slanted_forward");
  return guarded("slanted_forward", [&, h = h, w = w] {
    Workers workers(threads, thread_limit);
    auto scratch = pool.take();
    scratch->ticket = 0;
    const Image image{sums->typed_data(), alpha->typed_data()};
    slanted(splats.input(n, w, h), image, workers, *scratch, max_pairs);
    pool.give_back(std::move(scratch));
  });
}

ffi::Error slanted_backward(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                            FloatArray extents, FloatArray opacities, FloatArray rows, FloatArray sums, FloatArray alpha,
                            FloatArray d_sums, FloatArray d_alpha, FloatResult d_rows, int64_t thread_limit,
                            int64_t max_pairs, int64_t pulled) {
  const SlantedArrays splats{means2d, sqrt_conics, depths, extents, opacities, rows};
  Checks checks;
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  const int64_t n = splats.check(checks, w, h, max_pairs);
  checks.shape("sums", sums, {h, w, GROUP}).shape("d_sums", d_sums, {h, w, GROUP}).shape("d_alpha", d_alpha, {h, w});
  checks.shape("the gradient", d_rows, {n, SLANTED_SUMS});
  if (checks.failed()) return checks.error("slanted_backward");
  return guarded("slanted_backward", [&, h = h, w = w] {
    Workers workers(threads, thread_limit);
    auto scratch = pool.take();
    scratch->ticket = 0;
    const Cotangents cotangents{sums.typed_data(), alpha.typed_data(), d_sums.typed_data(), d_alpha.typed_data()};
    slanted_gradient(splats.input(n, w, h), cotangents, pulled != 0, d_rows->typed_data(), workers, *scratch, max_pairs);
    pool.give_back(std::move(scratch));
  });
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// (means2d [n 2], sqrt_conics [n 3], depths [n], extents [n 2], opacities [n], rows [n 16])
// -> (sums [h w 4], alpha [h w])
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_slanted_forward, slanted_forward,
                              results<2>(arrays<6>(call())).Attr<int64_t>("threads").Attr<int64_t>("max_pairs"));

// (the same six, sums, alpha, d_sums, d_alpha) -> sums over pixels [n 20]
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_slanted_backward, slanted_backward,
                              results<1>(arrays<10>(call()))
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("max_pairs")
                                  .Attr<int64_t>("pulled"));

#pragma GCC visibility pop
