// XLA custom calls of the planes of Gaussians, their gradient and their tangents.
#include "ffi.h"
#include "planes.h"

namespace splatax {
namespace {

// The rows of all views, of their gradients, or of their tangents.
template <class Array>
struct PlaneArrays {
  Array &places, &disparities, &quats, &log_scales, &sqrt_conics, &opacities, &blurs;

  // `blurred`: there are variances of splats that are drawn along rays.
  void check(Checks& checks, int64_t n, bool blurred) const {
    checks.shape("places", places, {n, 9}).shape("disparities", disparities, {n}).shape("quats", quats, {n, 4});
    checks.shape("log_scales", log_scales, {n, 3}).shape("sqrt_conics", sqrt_conics, {n, 3});
    checks.shape("opacities", opacities, {n}).shape("blurs", blurs, {blurred ? n : 0});
  }

  auto rows(const Batch& batch, int64_t view, bool blurred) const {
    using Number = std::remove_pointer_t<decltype(batch.of(places, view))>;
    constexpr bool WRITTEN = std::is_same_v<Array, FloatResult>;
    using Numbers = std::conditional_t<WRITTEN, Number, const Number>;
    return PlaneRows<Numbers>{batch.of(places, view),      batch.of(disparities, view),
                              batch.of(quats, view),       batch.of(log_scales, view),
                              batch.of(sqrt_conics, view), batch.of(opacities, view),
                              blurred ? batch.of(blurs, view) : nullptr};
  }
};

template <class Array>
void check(Checks& checks, Array& slopes, Array& normals, Array& axes, int64_t n) {
  checks.shape("slopes", slopes, {n, 2}).shape("normals", normals, {n, 3}).shape("axes", axes, {n, 3});
}

// Number of rows, after the inputs are checked.
int64_t check_rows(Checks& checks, const PlaneArrays<FloatArray>& rows, FloatArray& extents, bool blurred) {
  const auto [n] = checks.sizes<1>("disparities", rows.disparities);
  checks.range("the number of Gaussians", n, 0, MOST_ROWS);
  rows.check(checks, n, blurred);
  checks.shape("extents", extents, {n, 2});
  return n;
}

ffi::Error planes_forward(ffi::ThreadPool threads, FloatArray places, FloatArray disparities, FloatArray quats,
                          FloatArray log_scales, FloatArray sqrt_conics, FloatArray opacities, FloatArray blurs,
                          FloatArray extents, FloatResult slopes, FloatResult normals, FloatResult axes,
                          int64_t thread_limit, int64_t blurred) {
  const PlaneArrays<FloatArray> rows{places, disparities, quats, log_scales, sqrt_conics, opacities, blurs};
  const Batch batch(slopes, 2);
  Checks checks(batch);
  const int64_t n = check_rows(checks, rows, extents, blurred);
  check(checks, slopes, normals, axes, n);
  if (checks.failed()) return checks.error("planes_forward");
  return guarded("planes_forward", [&] {
    Workers workers(threads, thread_limit);
    find_planes(static_cast<int>(batch.views()), workers, [&](int view) {
      const PlanesOfView of{rows.rows(batch, view, blurred), batch.of(extents, view), static_cast<int>(n)};
      return FoundPlanes{of, {batch.of(slopes, view), batch.of(normals, view), batch.of(axes, view)}};
    });
  });
}

ffi::Error planes_backward(ffi::ThreadPool threads, FloatArray places, FloatArray disparities, FloatArray quats,
                           FloatArray log_scales, FloatArray sqrt_conics, FloatArray opacities, FloatArray blurs,
                           FloatArray extents, FloatArray d_slopes, FloatArray d_normals, FloatArray d_axes,
                           FloatResult d_places, FloatResult d_disparities, FloatResult d_quats, FloatResult d_log_scales,
                           FloatResult d_sqrt_conics, FloatResult d_opacities, FloatResult d_blurs, int64_t thread_limit, int64_t blurred) {
  const PlaneArrays<FloatArray> rows{places, disparities, quats, log_scales, sqrt_conics, opacities, blurs};
  const PlaneArrays<FloatResult> gradients{d_places,      d_disparities, d_quats, d_log_scales,
                                           d_sqrt_conics, d_opacities,   d_blurs};
  const Batch batch(d_places, 2);
  Checks checks(batch);
  const int64_t n = check_rows(checks, rows, extents, blurred);
  gradients.check(checks, n, blurred);
  check(checks, d_slopes, d_normals, d_axes, n);
  if (checks.failed()) return checks.error("planes_backward");
  return guarded("planes_backward", [&] {
    Workers workers(threads, thread_limit);
    pull_back_planes(static_cast<int>(batch.views()), workers, [&](int view) {
      const PlanesOfView of{rows.rows(batch, view, blurred), batch.of(extents, view), static_cast<int>(n)};
      return PulledBackPlanes{of,
                              {batch.of(d_slopes, view), batch.of(d_normals, view), batch.of(d_axes, view)},
                              gradients.rows(batch, view, blurred)};
    });
  });
}

ffi::Error planes_tangent(ffi::ThreadPool threads, FloatArray places, FloatArray disparities, FloatArray quats,
                          FloatArray log_scales, FloatArray sqrt_conics, FloatArray opacities, FloatArray blurs,
                          FloatArray extents, FloatArray d_places, FloatArray d_disparities, FloatArray d_quats,
                          FloatArray d_log_scales, FloatArray d_sqrt_conics, FloatArray d_opacities, FloatArray d_blurs,
                          FloatResult d_slopes, FloatResult d_normals, FloatResult d_axes, int64_t thread_limit, int64_t blurred) {
  const PlaneArrays<FloatArray> rows{places, disparities, quats, log_scales, sqrt_conics, opacities, blurs};
  const PlaneArrays<FloatArray> directions{d_places,      d_disparities, d_quats, d_log_scales,
                                           d_sqrt_conics, d_opacities,   d_blurs};
  const Batch batch(d_slopes, 2);
  Checks checks(batch);
  const int64_t n = check_rows(checks, rows, extents, blurred);
  directions.check(checks, n, blurred);
  check(checks, d_slopes, d_normals, d_axes, n);
  if (checks.failed()) return checks.error("planes_tangent");
  return guarded("planes_tangent", [&] {
    Workers workers(threads, thread_limit);
    push_planes(static_cast<int>(batch.views()), workers, [&](int view) {
      const PlanesOfView of{rows.rows(batch, view, blurred), batch.of(extents, view), static_cast<int>(n)};
      return PushedPlanes{of,
                          directions.rows(batch, view, blurred),
                          {batch.of(d_slopes, view), batch.of(d_normals, view), batch.of(d_axes, view)}};
    });
  });
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// All take batches; see `Batch`. Rows are places [n 9], disparities [n], quats [n 4], log_scales [n 3], sqrt_conics [n 3],
// opacities [n], and blurs: [n] if `blurred` is not 0, and else [0].

// (rows, extents [n 2]) -> slopes [n 2], normals [n 3], axes [n 3]
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_planes_forward, planes_forward,
                              results<3>(arrays<8>(call())).Attr<int64_t>("threads").Attr<int64_t>("blurred"));

// (rows, extents, the cotangents of the three) -> the gradients of the rows
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_planes_backward, planes_backward,
                              results<7>(arrays<11>(call())).Attr<int64_t>("threads").Attr<int64_t>("blurred"));

// (rows, extents, the tangents of the rows) -> the tangents of the three
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_planes_tangent, planes_tangent,
                              results<3>(arrays<15>(call())).Attr<int64_t>("threads").Attr<int64_t>("blurred"));

#pragma GCC visibility pop
