#include <type_traits>

#include "frustum.h"

namespace splatax {
namespace {

constexpr float FURTHEST = 11.09f;  // above 2 log(255): squared reach of an opaque splat, in standard deviations

// Makes rows those of culled splats, but for their depths.
void clear_rows(const Projected& splats, size_t first, size_t count) {
  std::fill_n(splats.means2d + 2 * first, 2 * count, 0.0f), std::fill_n(splats.sqrt_conics + 3 * first, 3 * count, 0.0f);
  std::fill_n(splats.extents + 2 * first, 2 * count, 0.0f), std::fill_n(splats.colors + 3 * first, 3 * count, 0.0f);
  std::fill_n(splats.opacities + first, count, 0.0f);
}

// Colours of sixteen Gaussians, from `first` on, by their spherical harmonics.
Vector colors(const Vector& means, const Gaussians& gaussians, const View& view, int first, int count) {
  const Direction direction(means, view);
  Lanes basis[MAX_COEFFICIENTS];
  harmonics(direction.unit.x, direction.unit.y, direction.unit.z, gaussians.coefficients, basis);
  Columns<3 * MAX_COEFFICIENTS> sh;
  read_fields(sh, gaussians, gaussians.sh, 3 * gaussians.coefficients, first, count);
  Vector color{broadcast(0.5f), broadcast(0.5f), broadcast(0.5f)};
  for (int k = 0; k < gaussians.coefficients; ++k) {
    color.x = multiply_add(basis[k], sh[3 * k], color.x);
    color.y = multiply_add(basis[k], sh[3 * k + 1], color.y);
    color.z = multiply_add(basis[k], sh[3 * k + 2], color.z);
  }
  return color;
}

// Visible Gaussians among many that are not: their colours are computed sixteen at a time, so that the harmonics of the
// others are not read.
class Scattered {
 public:
  static constexpr int FEW = 10;  // visible ones of sixteen, for which it is worth while

  Scattered(const Gaussians& gaussians, const View& view, const Projected& splats)
      : gaussians_(gaussians), view_(view), splats_(splats) {}

  // Takes the rows of a mask; their colours are written at the latest by `finish`.
  void add(int first, unsigned mask) {
    for (; mask != 0; mask &= mask - 1) rows_[count_++] = first + __builtin_ctz(mask);
    if (count_ < LANES) return;
    write(LANES);
    count_ -= LANES;
    std::copy_n(rows_ + LANES, count_, rows_);
  }
  void finish() {
    if (count_ > 0) write(count_);
    count_ = 0;
  }

 private:
  void write(int count) {
    Gaussians some = gaussians_;
    some.rows = rows_;
    some.count = count;
    Columns<3> means;
    read_fields(means, some, some.means, 3, 0, count);
    const Vector color = colors(means.vector(0), some, view_, 0, count);
    const unsigned drawn = bits(finite(color.x) & finite(color.y) & finite(color.z));
    alignas(64) float shown[3 * LANES];
    write_vectors({max(color.x, broadcast(0)), max(color.y, broadcast(0)), max(color.z, broadcast(0))}, shown, count);
    for (int i = 0; i < count; ++i) {
      const size_t row = rows_[i];
      if (drawn >> i & 1) {
        std::copy_n(shown + 3 * i, 3, splats_.colors + 3 * row);
      } else {
        clear_rows(splats_, row, 1);
      }
    }
  }

  const Gaussians& gaussians_;
  const View& view_;
  const Projected& splats_;
  int count_ = 0;
  int32_t rows_[2 * LANES];
};

// Projects up to sixteen Gaussians. Colours of a few are left to `scattered`, if it is given.
template <class Lens>
void project_lanes(const Gaussians& gaussians, const View& view, const Projected& splats, int first, int count,
                   Scattered* scattered = nullptr) {
  const Projection<Lens> p(gaussians, view, first, count);
  const size_t row = first;
  const Lanes x = p.lens.pixel_x(), y = p.lens.pixel_y();

  const auto in_image = [&](Lanes width, Lanes height) {
    return (broadcast(0) < x + width) & (x - width < broadcast(view.width)) & (broadcast(0) < y + height) &
           (y - height < broadcast(view.height));
  };
  const Mask possible = p.usable & (broadcast(MIN_ALPHA) <= p.opacity);
  const Lanes reach = or_zero(possible, 2.0f * log(max(p.opacity * broadcast(1 / MIN_ALPHA), broadcast(1))));
  const Lanes width = sqrt(reach * p.a), height = sqrt(reach * p.c);
  Mask visible = possible & in_image(width, height);

  Vector color{broadcast(0), broadcast(0), broadcast(0)};
  const unsigned which = bits(visible) & ((1u << count) - 1);
  const bool later = scattered && which != 0 && __builtin_popcount(which) <= Scattered::FEW;
  if (which != 0 && !later) {
    color = colors(p.means.world, gaussians, view, first, count);
    // A coefficient that is not finite leaves no finite sum, whatever the basis: 0 times infinity is NaN.
    visible = visible & finite(color.x) & finite(color.y) & finite(color.z);
    color = {or_zero(visible, color.x), or_zero(visible, color.y), or_zero(visible, color.z)};
  }

  const Lanes u = sqrt(p.c / p.determinant);
  write_pairs(or_zero(visible, x), or_zero(visible, y), splats.means2d + 2 * row, count);
  write_vectors(or_zero(visible, Vector{u, -(p.b * u) / p.c, broadcast(1) / sqrt(p.c)}), splats.sqrt_conics + 3 * row, count);
  write_numbers(p.lens.depth(), splats.depths + row, count);
  write_pairs(or_zero(visible, width), or_zero(visible, height), splats.extents + 2 * row, count);
  write_numbers(or_zero(visible, p.opacity), splats.opacities + row, count);
  write_vectors({max(color.x, broadcast(0)), max(color.y, broadcast(0)), max(color.z, broadcast(0))}, splats.colors + 3 * row,
                count);
  if (later) scattered->add(first, which);
}

// Gaussians through a pinhole of which few may be in the image: these are projected sixteen at a time.
class Sparse {
 public:
  Sparse(const Gaussians& gaussians, const View& view, const Projected& splats)
      : gaussians_(gaussians), view_(view), splats_(splats), frustum_(view) {}

  // Projects up to sixteen Gaussians, the last ones with `finish`, and returns true. It returns false if so many may be in
  // the image that it is faster to project them as they are.
  bool take(int first, int count) {
    const size_t row = first;
    const Means means = means_of<Pinhole>(gaussians_, view_, first, count);
    const Vector log_scales = read_vectors(gaussians_.log_scales + 3 * row, count);
    const Lanes widest = max(max(log_scales.x, log_scales.y), log_scales.z);
    const Lanes scale = exp2(LOG2_E * max(min(widest, broadcast(MAX_LOG_SCALE)), broadcast(-60)));
    const Lanes reach = broadcast(FURTHEST);
    const Mask candidates = means.seen & frustum_.may_see(means.point, reach, reach * scale * scale);
    uint32_t which = bits(candidates) & ((1u << count) - 1);
    if (__builtin_popcount(which) > FEW) return false;
    clear_rows(splats_, row, count);
    write_numbers(means.point.z, splats_.depths + row, count);
    for (; which != 0; which &= which - 1) rows_[count_++] = first + __builtin_ctz(which);
    if (count_ >= LANES) {
      write(LANES);
      count_ -= LANES;
      std::copy_n(rows_ + LANES, count_, rows_);
    }
    return true;
  }
  void finish() {
    if (count_ > 0) write(count_);
    count_ = 0;
  }

 private:
  static constexpr int FEW = 6;  // of sixteen

  void write(int count) {
    Gaussians some = gaussians_;
    some.rows = rows_;
    some.count = count;
    alignas(64) float means2d[2 * LANES], sqrt_conics[3 * LANES], depths[LANES], extents[2 * LANES], colors[3 * LANES];
    alignas(64) float opacities[LANES];
    project_lanes<Pinhole>(some, view_, {means2d, sqrt_conics, depths, extents, colors, opacities}, 0, count);
    for (int i = 0; i < count; ++i) {
      const size_t row = rows_[i];
      std::copy_n(means2d + 2 * i, 2, splats_.means2d + 2 * row);
      std::copy_n(sqrt_conics + 3 * i, 3, splats_.sqrt_conics + 3 * row);
      std::copy_n(extents + 2 * i, 2, splats_.extents + 2 * row), std::copy_n(colors + 3 * i, 3, splats_.colors + 3 * row);
      splats_.depths[row] = depths[i];
      splats_.opacities[row] = opacities[i];
    }
  }

  const Gaussians& gaussians_;
  const View& view_;
  const Projected& splats_;
  const Frustum frustum_;
  int count_ = 0;
  int32_t rows_[2 * LANES];
};

}  // namespace

int camera_fields(LensKind lens) {
  int fields = 0;
  with_lens(lens, [&](auto* chosen) { fields = std::remove_pointer_t<decltype(chosen)>::FIELDS; });
  return fields;
}

void project_rows(const Gaussians& gaussians, const View& view, const Projected& splats, int first, int count) {
  project_lanes<Pinhole>(gaussians, view, splats, first, count);
}

void project(int views, Workers& workers, const std::function<ProjectedView(int)>& view_of) {
  if (views == 0) return;
  const ProjectedView one = view_of(0);
  const int total = one.gaussians.count, parts = parts_of(total);
  with_lens(one.view.lens, [&](auto* chosen) {
    using Lens = std::remove_pointer_t<decltype(chosen)>;
    workers.each(views * parts, [&](int task) {
      const ProjectedView job = view_of(task / parts);
      Scattered scattered(job.gaussians, job.view, job.splats);
      Sparse sparse(job.gaussians, job.view, job.splats);
      each_lanes(task % parts, total, [&](int first, int count) {
        if (std::is_same_v<Lens, Pinhole> && sparse.take(first, count)) return;
        project_lanes<Lens>(job.gaussians, job.view, job.splats, first, count, &scattered);
      });
      scattered.finish();
      sparse.finish();
    });
  });
}

}  // namespace splatax
