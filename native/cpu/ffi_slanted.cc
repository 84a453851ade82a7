// XLA custom calls of splats that are drawn along rays: image and gradient.
#include "ffi.h"
#include "scratch_pool.h"
#include "slanted.h"

namespace splatax {
namespace {

// The ellipses that hold the splats of a view, and the rows of what is drawn in them.
struct SlantedArrays {
  const FloatArray &means2d, &sqrt_conics, &depths, &extents, &opacities, &rows;

  // Checks them against each other and against the image; returns the numbers of splats and channels.
  std::array<int64_t, 2> check(Checks& checks, int64_t width, int64_t height, int64_t max_pairs) const {
    const auto [n, size] = checks.sizes<2>("rows", rows);
    const int64_t c = size - SLANTED_SHAPE;
    checks.require(c == GROUP || c == WIDE_GROUP, "rows have " + std::to_string(c) + " channels, not " +
                                                      std::to_string(GROUP) + " or " + std::to_string(WIDE_GROUP));
    checks.range("the number of splats", n, 0, MOST_ROWS / slanted_sums(WIDE_GROUP));
    checks.shape("means2d", means2d, {n, 2}).shape("sqrt_conics", sqrt_conics, {n, 3}).shape("depths", depths, {n});
    checks.shape("extents", extents, {n, 2}).shape("opacities", opacities, {n});
    checks.range("the width", width, 1, LONGEST_SIDE).range("the height", height, 1, LONGEST_SIDE);
    checks.range("the number of tiles", ((width + TILE - 1) / TILE) * ((height + TILE - 1) / TILE), 1, INT32_MAX / 2);
    checks.range("max_pairs", max_pairs, 1, INT32_MAX / 2);
    return {n, c};
  }

  Input input(int64_t width, int64_t height) const {
    const auto size = rows.dimensions();
    return {means2d.typed_data(),      sqrt_conics.typed_data(),  depths.typed_data(),
            extents.typed_data(),      opacities.typed_data(),    rows.typed_data(),
            static_cast<int>(size[0]), static_cast<int>(size[1]), static_cast<int>(width),
            static_cast<int>(height)};
  }
};

ffi::Error slanted_forward(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                           FloatArray extents, FloatArray opacities, FloatArray rows, FloatResult sums, FloatResult alpha,
                           Counts ticket, int64_t thread_limit, int64_t max_pairs, int64_t gradient_follows) {
  const SlantedArrays splats{means2d, sqrt_conics, depths, extents, opacities, rows};
  Checks checks;
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  const auto [n, c] = splats.check(checks, w, h, max_pairs);
  checks.shape("sums", sums, {h, w, c}).shape("ticket", ticket, {});
  if (checks.failed()) return checks.error("slanted_forward");
  return guarded("slanted_forward", [&, h = h, w = w] {
    Workers workers(threads, thread_limit);
    auto scratch = pool.take();
    scratch->ticket = 0;
    scratch->expected = gradient_follows != 0;
    const Image image{sums->typed_data(), alpha->typed_data()};
    slanted(splats.input(w, h), image, workers, *scratch, max_pairs);
    *ticket->typed_data() = scratch->ticket = pool.new_ticket();
    pool.give_back(std::move(scratch));
  });
}

ffi::Error slanted_backward(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                            FloatArray extents, FloatArray opacities, FloatArray rows, FloatArray sums, FloatArray alpha,
                            Ticket ticket, FloatArray d_sums, FloatArray d_alpha, FloatResult d_rows, int64_t thread_limit,
                            int64_t max_pairs, int64_t pulled) {
  const SlantedArrays splats{means2d, sqrt_conics, depths, extents, opacities, rows};
  Checks checks;
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  const auto [n, c] = splats.check(checks, w, h, max_pairs);
  checks.shape("sums", sums, {h, w, c}).shape("ticket", ticket, {});
  checks.shape("d_sums", d_sums, {h, w, c}).shape("d_alpha", d_alpha, {h, w});
  checks.shape("the gradient", d_rows, {n, slanted_sums(static_cast<int>(c))});
  if (pulled) checks.range("channels beside pull", c, 0, GROUP);
  if (checks.failed()) return checks.error("slanted_backward");
  return guarded("slanted_backward", [&, h = h, w = w] {
    Workers workers(threads, thread_limit);
    const Input input = splats.input(w, h);
    auto scratch = pool.take(*ticket.typed_data(), input);
    const bool binned = scratch != nullptr;
    if (!binned) scratch = pool.take();
    scratch->ticket = 0;
    scratch->expected = false;
    const Cotangents cotangents{sums.typed_data(), alpha.typed_data(), d_sums.typed_data(), d_alpha.typed_data()};
    slanted_gradient(input, cotangents, pulled != 0, d_rows->typed_data(), workers, *scratch, binned, max_pairs);
    pool.give_back(std::move(scratch));
  });
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// (means2d [n 2], sqrt_conics [n 3], depths [n], extents [n 2], opacities [n], rows [n 12 + c])
// -> (sums [h w c], alpha [h w], ticket []), with c = 4 or 12
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_slanted_forward, slanted_forward,
                              results<2>(arrays<6>(call()))
                                  .Ret<Ticket>()
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("max_pairs")
                                  .Attr<int64_t>("gradient_follows"));

// (the same six, sums, alpha, ticket, d_sums, d_alpha) -> sums over pixels [n 16 + c]
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_slanted_backward, slanted_backward,
                              results<1>(arrays<2>(arrays<8>(call()).Arg<Ticket>()))
                                  .Attr<int64_t>("threads")
                                  .Attr<int64_t>("max_pairs")
                                  .Attr<int64_t>("pulled"));

#pragma GCC visibility pop
