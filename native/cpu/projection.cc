#include "projection_lanes.h"

namespace splatax {
namespace {

template <class Lens>
void project_lanes(const Gaussians& gaussians, const View& view, const Projected& splats, int first, int count) {
  const Projection<Lens> p(gaussians, view, first, count);
  const size_t row = first;
  const Lanes x = p.lens.pixel_x(), y = p.lens.pixel_y();

  alignas(64) float reach[LANES];
  store(reach, max(p.opacity * broadcast(1 / MIN_ALPHA), broadcast(1)));
  for (float& value : reach) value = 2 * std::log(value);
  Lanes width = sqrt(load(reach) * p.a), height = sqrt(load(reach) * p.c);
  const Mask opaque = p.usable & (broadcast(MIN_ALPHA) <= p.opacity);
  const Mask overlaps = (broadcast(0) < x + width) & (x - width < broadcast(view.width)) & (broadcast(0) < y + height) &
                        (y - height < broadcast(view.height));
  Mask visible = opaque & overlaps;

  Vector color{broadcast(0), broadcast(0), broadcast(0)};
  if (any(visible)) {
    const Direction direction(p.means.world, view);
    Lanes basis[MAX_COEFFICIENTS];
    harmonics(direction.unit.x, direction.unit.y, direction.unit.z, gaussians.coefficients, basis);
    Columns<3 * MAX_COEFFICIENTS> sh;
    read_fields(sh, gaussians, gaussians.sh, 3 * gaussians.coefficients, first, count);
    color = {broadcast(0.5f), broadcast(0.5f), broadcast(0.5f)};
    for (int k = 0; k < gaussians.coefficients; ++k) {
      color.x = multiply_add(basis[k], sh[3 * k], color.x);
      color.y = multiply_add(basis[k], sh[3 * k + 1], color.y);
      color.z = multiply_add(basis[k], sh[3 * k + 2], color.z);
    }
    // A coefficient that is not finite leaves no finite sum, whatever the basis: 0 times infinity is NaN.
    visible = visible & finite(color.x) & finite(color.y) & finite(color.z);
    color = {or_zero(visible, color.x), or_zero(visible, color.y), or_zero(visible, color.z)};
  }

  const Lanes u = sqrt(p.c / p.determinant);
  write_pairs(x, y, splats.means2d + 2 * row, count);
  write_vectors({u, -(p.b * u) / p.c, broadcast(1) / sqrt(p.c)}, splats.sqrt_conics + 3 * row, count);
  write_numbers(p.lens.depth(), splats.depths + row, count);
  write_pairs(or_zero(visible, width), or_zero(visible, height), splats.extents + 2 * row, count);
  write_numbers(p.opacity, splats.opacities + row, count);
  write_vectors({max(color.x, broadcast(0)), max(color.y, broadcast(0)), max(color.z, broadcast(0))}, splats.colors + 3 * row,
                count);
}

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
      each_lanes(task % parts, total,
                 [&](int first, int count) { project_lanes<Lens>(job.gaussians, job.view, job.splats, first, count); });
    });
  });
}

}  // namespace splatax
