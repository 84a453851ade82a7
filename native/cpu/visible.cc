#include "visible.h"

#include <algorithm>

#include "projection_lanes.h"

namespace splatax {
namespace {

constexpr int TOGETHER = 256;  // rows that a thread projects at a time

// Upper bound of the squared norm of a matrix M, row by row: the largest sum over a row of |M^T M|.
float squared_norm(const float* matrix) {
  double largest = 0;
  for (int i = 0; i < 3; ++i) {
    double sum = 0;
    for (int j = 0; j < 3; ++j) {
      double product = 0;
      for (int k = 0; k < 3; ++k) product += static_cast<double>(matrix[3 * k + i]) * matrix[3 * k + j];
      sum += std::abs(product);
    }
    largest = std::max(largest, sum);
  }
  return static_cast<float>(largest);
}

// The half side of a splat's box is sqrt(reach (|f|^2 + v)) with f = S R^T W^T J^T, so at most
// sqrt(reach v + spread |W|^2 |J|^2) for either row of J.
class Frustum {
 public:
  Frustum(const View& view) : view_(view), norm_(broadcast(1.002f * squared_norm(view.camera + ROTATION))) {
    const float* camera = view.camera;
    for (int k = 0; k < 3; ++k) {
      const float* column = camera + ROTATION + k;
      rotation_.column[k] = {broadcast(column[0]), broadcast(column[3]), broadcast(column[6])};
    }
    const float* t = camera + TRANSLATION;
    translation_ = {broadcast(t[0]), broadcast(t[1]), broadcast(t[2])};
  }

  // Bits of the Gaussians, of sixteen, that may reach into the image. NaN in a bound does not cull.
  SPLATAX_INLINE uint32_t may_see(const Bounds& bounds, int first) const {
    const Vector mean{load(bounds.x.get() + first), load(bounds.y.get() + first), load(bounds.z.get() + first)};
    const Lanes reach = load(bounds.reach.get() + first), spread = load(bounds.spread.get() + first);
    const Vector seen = rotation_ * mean + translation_;
    const Mask candidate = (broadcast(NEAR) < seen.z) & (broadcast(0) <= reach);
    if (!any(candidate)) return 0;
    const Lanes inverse_z = broadcast(1) / seen.z;
    const float* camera = view_.camera;
    const Mask beside_x = outside(seen.x * inverse_z, inverse_z, camera[FX], camera[CX], view_.width, reach, spread);
    const Mask beside_y = outside(seen.y * inverse_z, inverse_z, camera[FY], camera[CY], view_.height, reach, spread);
    return bits(and_not(and_not(candidate, beside_x), beside_y));
  }

 private:
  SPLATAX_INLINE Mask outside(Lanes slope, Lanes inverse_z, float focal, float centre, int size, Lanes reach,
                              Lanes spread) const {
    const Lanes f = broadcast(focal), c = broadcast(centre), k = f * inverse_z;
    const Lanes tilt = clipped(slope, c, f, size).value, middle = multiply_add(f, slope, c);
    const Lanes widened = multiply_add(tilt, tilt, broadcast(1)) * (k * k) * norm_;
    const Lanes squared_half = multiply_add(spread, widened, reach * broadcast(1.002f * view_.variance));
    // The distance of the splat's middle from the image, less a margin for rounding.
    const Lanes apart = absolute(middle - broadcast(0.5f * size)) -
                        multiply_add(broadcast(1e-5f), absolute(middle), broadcast(0.5f * size + 0.05f));
    return (broadcast(0) < apart) & (squared_half < apart * apart);
  }

  const View& view_;
  Lanes norm_;
  Matrix rotation_;
  Vector translation_;
};

// Writes the rows [begin, end) that a camera may see, in order, and returns their number.
int find(const Bounds& bounds, const View& view, int begin, int end, int32_t* rows) {
  const Frustum frustum(view);
  int32_t* next = rows;
  for (int first = begin; first < end; first += LANES) {
    for (uint32_t seen = frustum.may_see(bounds, first); seen; seen &= seen - 1) *next++ = first + __builtin_ctz(seen);
  }
  return static_cast<int>(next - rows);
}

}  // namespace

void Bounds::fill(const Gaussians& gaussians, Workers& workers) {
  const int total = gaussians.count, parts = parts_of(total);
  const size_t padded = static_cast<size_t>(total) + LANES;
  float* to[] = {x.at_least(padded), y.at_least(padded), z.at_least(padded), reach.at_least(padded), spread.at_least(padded)};
  workers.each(parts, [&](int part) {
    each_lanes(part, total, [&](int first, int count) {
      const Vector mean = read_vectors(gaussians.means + 3 * static_cast<size_t>(first), count);
      const Vector log_scale = read_vectors(gaussians.log_scales + 3 * static_cast<size_t>(first), count);
      const Lanes logit = read_numbers(gaussians.opacity_logits + first, count);
      const Lanes widest = max(max(log_scale.x, log_scale.y), log_scale.z);
      const Lanes scale = exp2(LOG2_E * max(min(widest, broadcast(MAX_LOG_SCALE)), broadcast(-60)));
      const Lanes decay = exp2(max(min(-LOG2_E * logit, broadcast(120)), broadcast(-120)));
      const Lanes ratio = broadcast(1.0001f / MIN_ALPHA) / (decay + 1);
      alignas(64) float reaches[LANES], ratios[LANES];
      store(ratios, ratio);
      for (int lane = 0; lane < LANES; ++lane) {
        reaches[lane] = lane < count && ratios[lane] >= 1 ? 2 * std::log(ratios[lane]) : -1;
      }
      const Lanes reach = load(reaches);
      const Lanes columns[] = {mean.x, mean.y, mean.z, reach, reach * scale * scale};
      for (int k = 0; k < 5; ++k) store(to[k] + first, columns[k]);
    });
  });
}

void Visible::make_room(int rows_at_most) {
  const size_t most = rows_at_most;
  rows.at_least(most);
  means2d.at_least(2 * most), sqrt_conics.at_least(3 * most), depths.at_least(most);
  extents.at_least(2 * most), colors.at_least(3 * most), opacities.at_least(most);
}

// Projects the splats [begin, end).
void Visible::project(const Gaussians& gaussians, const View& view, int begin, int end) {
  const int32_t* all = rows.get();
  const Gaussians seen = gaussians_at(gaussians, all, end);
  const Projected splats{means2d.get(), sqrt_conics.get(), depths.get(), extents.get(), colors.get(), opacities.get()};
  prefetch(gaussians, all + begin, std::min(LANES, end - begin));
  for (int at = begin; at < end; at += LANES) {
    prefetch(gaussians, all + at + LANES, std::clamp(end - at - LANES, 0, LANES));
    project_rows(seen, view, splats, at, std::min(LANES, end - at));
  }
}

void Visible::append(const Gaussians& gaussians, const Bounds& bounds, const View& view, int part) {
  const int before = count;
  count += find(bounds, view, part * ROWS_OF_PART, std::min((part + 1) * ROWS_OF_PART, gaussians.count), rows.get() + before);
  project(gaussians, view, before, count);
}

void Visible::collect(const Gaussians& gaussians, const Bounds& bounds, const View& view, Workers& workers) {
  const int total = gaussians.count, parts = parts_of_scene(total);
  make_room(total);
  int32_t *all = rows.get(), *found = found_.at_least(parts);
  workers.each(parts, [&](int part) {
    const int begin = part * ROWS_OF_PART;
    found[part] = find(bounds, view, begin, std::min(begin + ROWS_OF_PART, total), all + begin);
  });
  count = 0;
  for (int part = 0; part < parts; ++part) {
    std::copy_n(all + part * ROWS_OF_PART, found[part], all + count);
    count += found[part];
  }
  workers.each((count + TOGETHER - 1) / TOGETHER, [&](int task) {
    project(gaussians, view, task * TOGETHER, std::min((task + 1) * TOGETHER, count));
  });
}

}  // namespace splatax
