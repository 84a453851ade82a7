// Projects Gaussians to the splats of one view: one thread for a Gaussian.
#pragma once

#include "ellipse.cuh"
#include "ewa.cuh"
#include "harmonics.cuh"

KERNEL __launch_bounds__(BLOCK_SIZE) project(GaussianRows gaussians, View view, ProjectedRows splats) {
  const int row = thread_number();
  if (row >= gaussians.count) return;
  const Lens lens(view.camera);
  const Projection p(gaussians, view, lens, row);
  const float x = fmaf(lens.fx, p.x.free, lens.cx), y = fmaf(lens.fy, p.y.free, lens.cy);
  const float reach = 2 * logf(fmaxf(p.opacity * (1 / MIN_ALPHA), 1.0f));  // squared sigmas at which alpha is 1/255
  const float width = sqrtf(reach * p.a), height = sqrtf(reach * p.c);
  bool visible = p.usable && p.opacity >= MIN_ALPHA && x + width > 0 && x - width < view.width && y + height > 0 &&
                 y - height < view.height;
  Vector color{0, 0, 0};
  if (visible) {
    const float* sh = gaussians.sh + 3 * (size_t)gaussians.coefficients * row;
    color = color_of(sh, gaussians.coefficients, Direction(p.mean, lens.position).unit);
    visible = is_finite(color);
    color = visible ? Vector{fmaxf(color.x, 0), fmaxf(color.y, 0), fmaxf(color.z, 0)} : Vector{0, 0, 0};
  }
  const float u = sqrtf(p.c / p.determinant);
  splats.means2d[2 * (size_t)row] = x;
  splats.means2d[2 * (size_t)row + 1] = y;
  write({u, -(p.b * u) / p.c, 1 / sqrtf(p.c)}, splats.sqrt_conics + 3 * (size_t)row);
  splats.depths[row] = p.point.z;
  splats.extents[2 * (size_t)row] = visible ? width : 0;
  splats.extents[2 * (size_t)row + 1] = visible ? height : 0;
  write(color, splats.colors + 3 * (size_t)row);
  splats.opacities[row] = p.opacity;
}
