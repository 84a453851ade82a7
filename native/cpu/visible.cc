#include "visible.h"

#include <algorithm>
#include <cmath>

#include "frustum.h"

namespace splatax {
namespace {

constexpr int TOGETHER = 256;  // rows that a thread projects at a time
constexpr float FARTHEST = 1e36f;  // squared distance; farther means, and those that are no numbers, count as at it

// Turns means into camera axes.
class Axes {
 public:
  explicit Axes(const View& view) {
    const float* camera = view.camera;
    for (int k = 0; k < 3; ++k) {
      const float* column = camera + ROTATION + k;
      rotation_.column[k] = {broadcast(column[0]), broadcast(column[3]), broadcast(column[6])};
    }
    const float* t = camera + TRANSLATION;
    translation_ = {broadcast(t[0]), broadcast(t[1]), broadcast(t[2])};
  }

  SPLATAX_INLINE Vector point(const Bounds& bounds, int first) const {
    const Vector mean{load(bounds.x.get() + first), load(bounds.y.get() + first), load(bounds.z.get() + first)};
    return rotation_ * mean + translation_;
  }

 private:
  Matrix rotation_;
  Vector translation_;
};

// Writes the rows [begin, end) that a camera may see, in order, and returns their number.
int find(const Bounds& bounds, const View& view, int begin, int end, int32_t* rows) {
  const Frustum frustum(view);
  const Axes axes(view);
  int32_t* next = rows;
  for (int first = begin; first < end; first += LANES) {
    const Lanes reach = load(bounds.reach.get() + first), spread = load(bounds.spread.get() + first);
    const Mask candidates = frustum.may_see(axes.point(bounds, first), reach, spread);
    for (uint32_t seen = bits(candidates); seen; seen &= seen - 1) *next++ = first + __builtin_ctz(seen);
  }
  return static_cast<int>(next - rows);
}

}  // namespace

void Bounds::fill(const Gaussians& gaussians, Workers& workers) {
  const int total = gaussians.count, parts = parts_of(total);
  const size_t padded = static_cast<size_t>(total) + LANES;
  float* to[] = {x.at_least(padded), y.at_least(padded), z.at_least(padded), reach.at_least(padded), spread.at_least(padded)};
  float* reach_of = to[3];
  workers.each(parts, [&](int part) {
    each_lanes(part, total, [&](int first, int count) {
      const Vector mean = read_vectors(gaussians.means + 3 * static_cast<size_t>(first), count);
      const Vector log_scale = read_vectors(gaussians.log_scales + 3 * static_cast<size_t>(first), count);
      const Lanes logit = read_numbers(gaussians.opacity_logits + first, count);
      const Lanes widest = max(max(log_scale.x, log_scale.y), log_scale.z);
      const Lanes scale = exp2(LOG2_E * max(min(widest, broadcast(MAX_LOG_SCALE)), broadcast(-60)));
      const Lanes decay = exp2(max(min(-LOG2_E * logit, broadcast(120)), broadcast(-120)));
      const Lanes ratio = broadcast(1.0001f / MIN_ALPHA) / (decay + 1);
      const Lanes reach = where(broadcast(1) <= ratio, 2.0f * log(ratio), broadcast(-1));
      const Lanes columns[] = {mean.x, mean.y, mean.z, reach, reach * scale * scale};
      for (int k = 0; k < 5; ++k) store(to[k] + first, columns[k]);
      std::fill(reach_of + first + count, reach_of + first + LANES, -1.0f);
    });
  });
}

void Visible::make_room(int rows_at_most) {
  const size_t most = rows_at_most;
  rows.at_least(most);
  means2d.at_least(2 * most);
  sqrt_conics.at_least(3 * most);
  depths.at_least(most);
  distances.at_least(most);
  extents.at_least(2 * most);
  colors.at_least(3 * most);
  opacities.at_least(most);
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
  for (int i = begin; i < end; ++i) {
    const float* mean = gaussians.means + 3 * static_cast<size_t>(all[i]);
    const float x = mean[0] - view.camera[POSITION], y = mean[1] - view.camera[POSITION + 1], z = mean[2] - view.camera[POSITION + 2];
    const float squared = x * x + y * y + z * z;
    distances[i] = std::sqrt(squared < FARTHEST ? squared : FARTHEST);
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
