// XLA custom calls of the rasterizer: image, gradient, and the count of slots.
#include <map>

#include "ffi.h"
#include "large_pages.h"
#include "rasterize.h"
#include "roofline.h"
#include "scratch_pool.h"
#include "select.h"
#include "survey.h"
#include "tangent.h"
#include "views.h"

namespace splatax {
namespace {

// Six arrays that describe the splats of a view.
struct SplatArrays {
  const FloatArray &means2d, &sqrt_conics, &depths, &extents, &opacities, &channels;

  // Checks them against each other; returns the numbers of splats and channels of a view.
  std::array<int64_t, 2> check(Checks& checks) const {
    const auto [n, c] = checks.sizes<2>("channels", channels);
    checks.range("the number of splats", n, 0, MOST_ROWS).range("the number of channels", c, 0, MOST_ROWS);
    checks.shape("means2d", means2d, {n, 2}).shape("sqrt_conics", sqrt_conics, {n, 3}).shape("depths", depths, {n});
    checks.shape("extents", extents, {n, 2}).shape("opacities", opacities, {n}).shape("channels", channels, {n, c});
    return {n, c};
  }

  Input input(const Batch& batch, int64_t view, int64_t width, int64_t height) const {
    const auto size = channels.dimensions();
    return {batch.of(means2d, view),
            batch.of(sqrt_conics, view),
            batch.of(depths, view),
            batch.of(extents, view),
            batch.of(opacities, view),
            batch.of(channels, view),
            static_cast<int>(size[batch.rank()]),
            static_cast<int>(size[batch.rank() + 1]),
            static_cast<int>(width),
            static_cast<int>(height)};
  }
};

void check_size(Checks& checks, int64_t width, int64_t height, int64_t max_pairs) {
  checks.range("the width", width, 1, LONGEST_SIDE).range("the height", height, 1, LONGEST_SIDE);
  checks.range("the number of tiles", ((width + TILE - 1) / TILE) * ((height + TILE - 1) / TILE), 1, INT32_MAX / 2);
  checks.range("max_pairs", max_pairs, 1, INT32_MAX / 2);
}

ffi::Error rasterize_forward(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                             FloatArray extents, FloatArray opacities, FloatArray channels, FloatResult sums, FloatResult alpha,
                             Counts ticket, int64_t thread_limit, int64_t max_pairs, int64_t gradient_follows) {
  const SplatArrays splats{means2d, sqrt_conics, depths, extents, opacities, channels};
  const Batch batch(alpha, 2);
  Checks checks(batch);
  const auto [n, c] = splats.check(checks);
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  check_size(checks, w, h, max_pairs);
  checks.shape("alpha", alpha, {h, w}).shape("sums", sums, {h, w, c}).shape("ticket", ticket, {});
  if (checks.failed()) return checks.error("rasterize_forward");
  return guarded("rasterize_forward", [&, w = w, h = h] {
    Workers all(threads, thread_limit);
    auto scratch = pool.take();
    scratch->ticket = 0;
    scratch->expected = batch.views() == 1 && gradient_follows != 0;
    each_view(batch.views(), all, *scratch, [&](int view, Workers& workers, Scratch& memory) {
      const Image image{batch.of(sums, view), batch.of(alpha, view)};
      rasterize(splats.input(batch, view, w, h), image, workers, memory, max_pairs);
      *batch.of(ticket, view) = 0;
    });
    // The lists of a single view are kept for its gradient.
    if (batch.views() == 1) *ticket->typed_data() = scratch->ticket = pool.new_ticket();
    pool.give_back(std::move(scratch));
  });
}

ffi::Error rasterize_backward(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                              FloatArray extents, FloatArray opacities, FloatArray channels, FloatArray sums, FloatArray alpha,
                              Ticket ticket, FloatArray d_sums, FloatArray d_alpha, FloatResult d_means2d,
                              FloatResult d_sqrt_conics, FloatResult d_opacities, FloatResult d_channels, FloatResult d_pull,
                              int64_t thread_limit, int64_t max_pairs) {
  const SplatArrays splats{means2d, sqrt_conics, depths, extents, opacities, channels};
  const Batch batch(d_channels, 2);
  Checks checks(batch);
  const auto [n, c] = splats.check(checks);
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  check_size(checks, w, h, max_pairs);
  checks.shape("alpha", alpha, {h, w}).shape("sums", sums, {h, w, c}).shape("ticket", ticket, {});
  checks.shape("d_sums", d_sums, {h, w, c}).shape("d_alpha", d_alpha, {h, w});
  checks.shape("d_means2d", d_means2d, {n, 2}).shape("d_sqrt_conics", d_sqrt_conics, {n, 3});
  checks.shape("d_opacities", d_opacities, {n}).shape("d_channels", d_channels, {n, c});
  const auto [pulls, two] = checks.sizes<2>("d_pull", d_pull);
  const bool pulled = pulls != 0;
  checks.shape("d_pull", d_pull, {pulled ? n : 0, 2});
  if (pulled) checks.range("channels beside pull", c, 0, NARROW_WALK);
  if (checks.failed()) return checks.error("rasterize_backward");
  return guarded("rasterize_backward", [&, w = w, h = h] {
    all_in_large_pages(d_means2d, d_sqrt_conics, d_opacities, d_channels, d_pull);
    Workers all(threads, thread_limit);
    auto scratch = batch.views() == 1 ? pool.take(*ticket.typed_data(), splats.input(batch, 0, w, h)) : nullptr;
    const bool binned = scratch != nullptr;
    if (!binned) scratch = pool.take();
    scratch->ticket = 0;
    scratch->expected = false;
    each_view(batch.views(), all, *scratch, [&](int view, Workers& workers, Scratch& memory) {
      const Cotangents cotangents{batch.of(sums, view), batch.of(alpha, view), batch.of(d_sums, view),
                                  batch.of(d_alpha, view)};
      const Gradients gradients{batch.of(d_means2d, view), batch.of(d_sqrt_conics, view), batch.of(d_opacities, view),
                                batch.of(d_channels, view), pulled ? batch.of(d_pull, view) : nullptr};
      rasterize_gradient(splats.input(batch, view, w, h), cotangents, gradients, workers, memory, binned, max_pairs);
    });
    pool.give_back(std::move(scratch));
  });
}

ffi::Error rasterize_forward_mode(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                                  FloatArray extents, FloatArray opacities, FloatArray channels, FloatArray d_means2d,
                                  FloatArray d_sqrt_conics, FloatArray d_opacities, FloatArray d_channels, FloatResult d_sums,
                                  FloatResult d_alpha, int64_t thread_limit, int64_t max_pairs) {
  const SplatArrays splats{means2d, sqrt_conics, depths, extents, opacities, channels};
  const Batch batch(d_alpha, 3);
  Checks checks(batch);
  const auto [n, c] = splats.check(checks);
  const auto [h, w, k] = checks.sizes<3>("d_alpha", d_alpha);
  check_size(checks, w, h, max_pairs);
  checks.range("the number of directions", k, 0, MOST_ROWS);
  checks.shape("d_means2d", d_means2d, {k, n, 2}).shape("d_sqrt_conics", d_sqrt_conics, {k, n, 3});
  checks.shape("d_opacities", d_opacities, {k, n}).shape("d_channels", d_channels, {k, n, c});
  checks.shape("d_sums", d_sums, {h, w, c, k}).shape("d_alpha", d_alpha, {h, w, k});
  if (checks.failed()) return checks.error("rasterize_tangent");
  return guarded("rasterize_tangent", [&, n = n, c = c, h = h, w = w, k = k] {
    // Directions at the same splats share a walk.
    std::map<std::array<const float*, 6>, std::vector<int>> views_at;
    for (int view = 0; view < batch.views(); ++view) {
      const Input at = splats.input(batch, view, w, h);
      views_at[{at.means2d, at.sqrt_conics, at.depths, at.extents, at.opacities, at.channels}].push_back(view);
    }
    std::vector<std::vector<int>> groups;
    for (const auto& [_, views] : views_at) groups.push_back(views);
    Workers all(threads, thread_limit);
    auto scratch = pool.take();
    scratch->ticket = 0;
    each_view(static_cast<int>(groups.size()), all, *scratch, [&](int group, Workers& workers, Scratch& memory) {
      std::vector<Direction2d> directions;
      for (const int view : groups[group]) {
        for (int64_t i = 0; i < k; ++i) {
          directions.push_back({batch.of(d_means2d, view) + 2 * n * i, batch.of(d_sqrt_conics, view) + 3 * n * i,
                                batch.of(d_opacities, view) + n * i, batch.of(d_channels, view) + n * c * i,
                                batch.of(d_sums, view), batch.of(d_alpha, view), static_cast<int>(i), static_cast<int>(k)});
        }
      }
      rasterize_tangent(splats.input(batch, groups[group][0], w, h), directions.data(),
                        static_cast<int>(directions.size()), workers, memory, max_pairs);
    });
    pool.give_back(std::move(scratch));
  });
}

ffi::Error select_splats(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                         FloatArray extents, FloatArray opacities, FloatArray channels, Counts rows, FloatResult weights,
                         Counts median, int64_t thread_limit, int64_t max_pairs) {
  const SplatArrays splats{means2d, sqrt_conics, depths, extents, opacities, channels};
  const Batch batch(median, 2);
  Checks checks(batch);
  const auto [n, c] = splats.check(checks);
  const auto [h, w, k] = checks.sizes<3>("rows", rows);
  check_size(checks, w, h, max_pairs);
  checks.range("the number of splats", n, 0, MOST_SELECTABLE).range("the number selected", k, 0, MOST_SELECTED);
  checks.shape("rows", rows, {h, w, k}).shape("weights", weights, {h, w, k}).shape("median", median, {h, w});
  if (checks.failed()) return checks.error("select");
  return guarded("select", [&, h = h, w = w, k = k] {
    Workers all(threads, thread_limit);
    auto scratch = pool.take();
    scratch->ticket = 0;
    each_view(batch.views(), all, *scratch, [&](int view, Workers& workers, Scratch& memory) {
      const Selection selection{batch.of(rows, view), batch.of(weights, view), batch.of(median, view),
                                static_cast<int>(k)};
      select(splats.input(batch, view, w, h), selection, workers, memory, max_pairs);
    });
    pool.give_back(std::move(scratch));
  });
}

ffi::Error survey_splats(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths,
                         FloatArray extents, FloatArray opacities, FloatArray channels, FloatResult sums, FloatResult alpha,
                         FloatResult parts, Counts median, int64_t thread_limit, int64_t max_pairs,
                         ffi::Span<const int64_t> sizes) {
  const SplatArrays splats{means2d, sqrt_conics, depths, extents, opacities, channels};
  const Batch batch(median, 2);
  Checks checks(batch);
  const auto [n, c] = splats.check(checks);
  const auto [h, w] = checks.sizes<2>("alpha", alpha);
  const int64_t part_count = static_cast<int64_t>(sizes.size());
  check_size(checks, w, h, max_pairs);
  checks.range("the number of splats", n, 0, MOST_SELECTABLE).range("the number of channels", c, 0, GROUP);
  checks.range("the number of parts", part_count, 0, MOST_PARTS);
  checks.shape("sums", sums, {h, w, c}).shape("alpha", alpha, {h, w}).shape("parts", parts, {h, w, part_count});
  checks.shape("median", median, {h, w});
  int64_t rows = 0;
  for (const int64_t size : sizes) rows += checks.range("the size of a part", size, 0, n).failed() ? 0 : size;
  if (part_count > 0) checks.range("the number of rows of all parts", rows, n, n);
  if (checks.failed()) return checks.error("survey");
  return guarded("survey", [&, h = h, w = w] {
    std::vector<uint8_t> part_of;
    for (int64_t part = 0; part < part_count; ++part) part_of.insert(part_of.end(), sizes[part], static_cast<uint8_t>(part));
    Workers all(threads, thread_limit);
    auto scratch = pool.take();
    scratch->ticket = 0;
    each_view(batch.views(), all, *scratch, [&](int view, Workers& workers, Scratch& memory) {
      const Survey results{{batch.of(sums, view), batch.of(alpha, view)}, batch.of(parts, view), batch.of(median, view),
                           part_of.data(), static_cast<int>(part_count)};
      survey(splats.input(batch, view, w, h), results, workers, memory, max_pairs);
    });
    pool.give_back(std::move(scratch));
  });
}

ffi::Error slots(ffi::ThreadPool threads, FloatArray means2d, FloatArray sqrt_conics, FloatArray depths, FloatArray extents,
                 FloatArray opacities, FloatArray channels, Counts counts, int64_t thread_limit, int64_t max_pairs,
                 int64_t width, int64_t height) {
  const SplatArrays splats{means2d, sqrt_conics, depths, extents, opacities, channels};
  Checks checks;
  splats.check(checks);
  check_size(checks, width, height, max_pairs);
  checks.shape("counts", counts, {((width + TILE - 1) / TILE) * ((height + TILE - 1) / TILE), 2});
  if (checks.failed()) return checks.error("slots");
  return guarded("slots", [&] {
    Workers workers(threads, thread_limit);
    Scratch scratch;
    auto* pairs = reinterpret_cast<int32_t(*)[2]>(counts->typed_data());
    count_slots(splats.input(Batch(), 0, width, height), pairs, workers, scratch, max_pairs);
  });
}

ffi::Error work(ffi::ThreadPool threads, FloatResult sums, int64_t, int64_t rounds) {
  Workers workers(threads, static_cast<int64_t>(sums->element_count()));
  std::fill_n(sums->typed_data(), sums->element_count(), 0.0f);
  multiply_adds(rounds, sums->typed_data(), workers);
  return ffi::Error::Success();
}

template <class Binding>
auto with_settings(Binding binding) {
  return std::move(binding).template Attr<int64_t>("threads").template Attr<int64_t>("max_pairs");
}

}  // namespace
}  // namespace splatax

#pragma GCC visibility push(default)

using namespace splatax;

// All but the last two take batches; see `Batch`.

// (means2d [n 2], sqrt_conics [n 3], depths [n], extents [n 2], opacities [n], channels [n c])
// -> (sums [h w c], alpha [h w], ticket [])
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_rasterize_forward, rasterize_forward,
                              with_settings(results<2>(arrays<6>(call())).Ret<Ticket>())
                                  .Attr<int64_t>("gradient_follows"));

// (the same six, sums, alpha, ticket, d_sums, d_alpha)
// -> (d_means2d, d_sqrt_conics, d_opacities, d_channels, d_pull [n 2], or [0 2] where it is not wanted)
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_rasterize_backward, rasterize_backward,
                              with_settings(results<5>(arrays<2>(arrays<8>(call()).Arg<Ticket>()))));

// (the six of splatax_rasterize_forward, d_means2d [k n 2], d_sqrt_conics [k n 3], d_opacities [k n], d_channels [k n c]) ->
// (d_sums [h w c k], d_alpha [h w k])
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_rasterize_tangent, rasterize_forward_mode,
                              with_settings(results<2>(arrays<10>(call()))));

// (the six of splatax_rasterize_forward) -> (rows [h w k], weights [h w k], median [h w])
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_select, select_splats,
                              with_settings(results<1>(arrays<6>(call()).Ret<Ticket>()).Ret<Ticket>()));

// (the six of splatax_rasterize_forward, with up to 4 channels) -> (sums [h w c], alpha [h w], parts [h w p], median [h w])
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_survey, survey_splats,
                              with_settings(results<3>(arrays<6>(call())).Ret<Ticket>())
                                  .Attr<ffi::Span<const int64_t>>("sizes"));

// (the six of splatax_rasterize_forward) -> counts [tiles 2]
XLA_FFI_DEFINE_HANDLER_SYMBOL(
    splatax_slots, slots,
    with_settings(arrays<6>(call()).Ret<Ticket>()).Attr<int64_t>("width").Attr<int64_t>("height"));

// () -> a number for each thread
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_multiply_adds, work,
                              results<1>(call()).Attr<int64_t>("threads").Attr<int64_t>("rounds"));

#pragma GCC visibility pop
