// Gradient of the projection: one thread for a Gaussian, the chain rule backwards through `Projection`. The camera's
// gradient is summed over the block by a tree, then over the blocks in their order.
#pragma once

#include "ewa.cuh"
#include "harmonics.cuh"
#include "reduction.cuh"

// Contributions of one Gaussian to the camera's gradient.
struct CameraGradient {
  float sums[CAMERA_FIELDS] = {};

  INLINE void add(int field, float part) { sums[field] += part; }
  INLINE void add(int field, const Vector& part) { add(field, part.x), add(field + 1, part.y), add(field + 2, part.z); }
  // Adds a b^T to the gradient of the rotation.
  INLINE void add_outer(const Vector& a, const Vector& b) {
    add(ROTATION, a.x * b);
    add(ROTATION + 3, a.y * b);
    add(ROTATION + 6, a.z * b);
  }
};

// Returns dL/d (x / z) from dL/d of the limited slope. The limits depend on the camera.
INLINE float slope_gradient(const Slope& slope, float d_value, float focal, int focal_field, int centre_field,
                            CameraGradient& camera) {
  if (!slope.below && !slope.above) return d_value;
  camera.add(centre_field, -(d_value / focal));
  camera.add(focal_field, -(d_value * slope.value / focal));
  return 0;
}

// Writes dL/d sh; returns the gradient that reaches the mean through the direction of view.
INLINE Vector color_gradient(const GaussianRows& gaussians, const Lens& lens, const Vector& mean, Vector d_color, int row,
                             float* d_sh) {
  const float* sh = gaussians.sh + 3 * (size_t)gaussians.coefficients * row;
  const Direction direction(mean, lens.position);
  const Vector& unit = direction.unit;
  const Vector color = color_of(sh, gaussians.coefficients, unit);
  d_color = {color.x > 0 ? d_color.x : 0, color.y > 0 ? d_color.y : 0, color.z > 0 ? d_color.z : 0};
  Vector d_unit{0, 0, 0};
  each_harmonic(Dual{unit.x, {1, 0, 0}}, Dual{unit.y, {0, 1, 0}}, Dual{unit.z, {0, 0, 1}}, gaussians.coefficients,
                [&](int k, const Dual& basis) {
                  d_unit = d_unit + dot(vector_at(sh + 3 * k), d_color) * basis.d;
                  write(basis.value * d_color, d_sh + 3 * k);
                });
  return direction.inverse_length * (d_unit - dot(unit, d_unit) * unit);
}

// Writes dL/d log_scales and dL/d quats, from dL/d (R(q) S).
INLINE void orientation_gradient(const GaussianRows& gaussians, const Projection& p, const Matrix& d_oriented, int row,
                                 const GaussianGradients& gradients) {
  const Turn& turn = p.turn;
  const Matrix axes = turn.rotation();
  const float scales[3] = {p.scale.x, p.scale.y, p.scale.z};
  Matrix d;  // of R(q)
  for (int k = 0; k < 3; ++k) {
    const size_t at = 3 * (size_t)row + k;
    const bool clamped = Projection::is_clamped(gaussians.log_scales[at]);
    gradients.log_scales[at] = clamped ? 0.0f : dot(axes.column[k], d_oriented.column[k]) * scales[k];
    d.column[k] = scales[k] * d_oriented.column[k];
  }
  const float w = turn.w, x = turn.x, y = turn.y, z = turn.z;
  const Vector &r0 = d.column[0], &r1 = d.column[1], &r2 = d.column[2];
  const float across_x = r1.z - r2.y, across_y = r2.x - r0.z, across_z = r0.y - r1.x;
  const float xy = r0.y + r1.x, xz = r0.z + r2.x, yz = r1.z + r2.y;
  const float d_w = 2 * (x * across_x + y * across_y + z * across_z);
  const float d_x = 2 * (w * across_x + y * xy + z * xz - 2 * (x * (r1.y + r2.z)));
  const float d_y = 2 * (w * across_y + x * xy + z * yz - 2 * (y * (r0.x + r2.z)));
  const float d_z = 2 * (w * across_z + x * xz + y * yz - 2 * (z * (r0.x + r1.y)));
  const float along = d_w * w + d_x * x + d_y * y + d_z * z, inverse = turn.length > 0 ? 1 / turn.length : 0.0f;
  float* d_quat = gradients.quats + 4 * (size_t)row;
  d_quat[0] = (d_w - along * w) * inverse;
  d_quat[1] = (d_x - along * x) * inverse;
  d_quat[2] = (d_y - along * y) * inverse;
  d_quat[3] = (d_z - along * z) * inverse;
}

INLINE void clear_gradient(const GaussianGradients& gradients, int coefficients, int row) {
  for (int k = 0; k < 3; ++k) gradients.means[3 * (size_t)row + k] = gradients.log_scales[3 * (size_t)row + k] = 0;
  for (int k = 0; k < 4; ++k) gradients.quats[4 * (size_t)row + k] = 0;
  for (int k = 0; k < 3 * coefficients; ++k) gradients.sh[3 * (size_t)coefficients * row + k] = 0;
  gradients.opacity_logits[row] = 0;
}

INLINE void gaussian_gradient(const GaussianRows& gaussians, const View& view, const ProjectedCotangents& cotangents,
                              int row, const GaussianGradients& gradients, CameraGradient& camera) {
  const Lens lens(view.camera);
  const Projection p(gaussians, view, lens, row);
  const float u = sqrtf(p.c / p.determinant), w = 1 / sqrtf(p.c), b_per_c = p.b / p.c;
  const Vector d_root = vector_at(cotangents.sqrt_conics + 3 * (size_t)row);
  const float d_u = d_root.x - d_root.y * b_per_c, d_b = -(d_root.y * u / p.c);
  const float d_c = d_root.y * u * b_per_c / p.c + (d_u * u - d_root.z * w) / (2 * p.c);
  const float d_opacity = cotangents.opacities[row];
  const bool fading = view.fades && p.fade > view.least_fade;  // the opacity depends on the shape
  const float d_fade = fading ? d_opacity * p.opacity : 0;
  const float d_determinant = -(d_u * u + d_fade) / (2 * p.determinant);
  const float d_sharp = d_determinant + (fading ? d_fade / (2 * p.sharp) : 0);
  gradients.opacity_logits[row] = d_opacity * p.opacity * (1 - p.own_opacity);

  const Vector d_normal = 2 * d_sharp * p.normal;
  const float spread = 2 * view.variance * d_determinant;
  const Vector d_f = cross(p.g, d_normal) + spread * p.f + d_b * p.g;
  const Vector d_g = cross(d_normal, p.f) + (spread + 2 * d_c) * p.g + d_b * p.f;
  const Vector jacobian_x = p.jacobian_x(lens), jacobian_y = p.jacobian_y(lens);
  const float f_of[3] = {d_f.x, d_f.y, d_f.z}, g_of[3] = {d_g.x, d_g.y, d_g.z};
  Matrix d_oriented;
  for (int k = 0; k < 3; ++k) {
    const Vector d_factor = f_of[k] * jacobian_x + g_of[k] * jacobian_y;
    d_oriented.column[k] = transposed_times(lens.rotation, d_factor);
    camera.add_outer(d_factor, p.oriented.column[k]);
  }
  orientation_gradient(gaussians, p, d_oriented, row, gradients);

  const Vector d_jx = p.factor * d_f, d_jy = p.factor * d_g;
  const float kx = lens.fx * p.inverse_z, ky = lens.fy * p.inverse_z;
  const float d_kx = d_jx.x - p.x.value * d_jx.z, d_ky = d_jy.y - p.y.value * d_jy.z;
  const float d_x2d = cotangents.means2d[2 * (size_t)row], d_y2d = cotangents.means2d[2 * (size_t)row + 1];
  const float d_slope_x = d_x2d * lens.fx + slope_gradient(p.x, -(kx * d_jx.z), lens.fx, FX, CX, camera);
  const float d_slope_y = d_y2d * lens.fy + slope_gradient(p.y, -(ky * d_jy.z), lens.fy, FY, CY, camera);
  camera.add(FX, d_kx * p.inverse_z + d_x2d * p.x.free);
  camera.add(FY, d_ky * p.inverse_z + d_y2d * p.y.free);
  camera.add(CX, d_x2d);
  camera.add(CY, d_y2d);
  const float through_z = d_kx * kx + d_ky * ky + d_slope_x * p.x.free + d_slope_y * p.y.free;
  const Vector d_point{d_slope_x * p.inverse_z, d_slope_y * p.inverse_z,
                       cotangents.depths[row] - through_z * p.inverse_z};
  camera.add_outer(d_point, p.mean);
  camera.add(TRANSLATION, d_point);

  float* d_sh = gradients.sh + 3 * (size_t)gaussians.coefficients * row;
  const Vector d_color = vector_at(cotangents.colors + 3 * (size_t)row);
  const Vector d_offset = color_gradient(gaussians, lens, p.mean, d_color, row, d_sh);
  camera.add(POSITION, -1.0f * d_offset);
  write(transposed_times(lens.rotation, d_point) + d_offset, gradients.means + 3 * (size_t)row);
}

KERNEL __launch_bounds__(BLOCK_SIZE) project_gradient(GaussianRows gaussians, View view, ProjectedCotangents cotangents,
                                                      GaussianGradients gradients) {
  __shared__ float warp_sums[WARPS][CAMERA_FIELDS];
  const int row = thread_number(), lane = lane_number();
  CameraGradient camera;
  if (row < gaussians.count) {
    if (cotangents.extents[2 * (size_t)row] > 0) {
      gaussian_gradient(gaussians, view, cotangents, row, gradients, camera);
    } else {
      clear_gradient(gradients, gaussians.coefficients, row);
    }
  }
  const float total = sum_over_lanes<CAMERA_FIELDS>(camera.sums, lane);
  const int field = summed_value<CAMERA_FIELDS>(lane);
  if (field >= 0) warp_sums[warp_number()][field] = total;
  __syncthreads();
  if (threadIdx.x >= CAMERA_FIELDS) return;
  float sum = 0;
  for (int w = 0; w < WARPS; ++w) sum += warp_sums[w][threadIdx.x];
  gradients.camera_parts[(size_t)blockIdx.x * CAMERA_FIELDS + threadIdx.x] = sum;
}

// Sums the parts of all blocks in double precision: one block, one warp for a field at a time.
KERNEL __launch_bounds__(BLOCK_SIZE) sum_camera_parts(int blocks, const float* parts, float* camera) {
  const int lane = lane_number();
  for (int field = warp_number(); field < CAMERA_FIELDS; field += WARPS) {
    double sum = 0;
    for (int b = lane; b < blocks; b += WARP_SIZE) sum += parts[(size_t)b * CAMERA_FIELDS + field];
    for (int distance = WARP_SIZE / 2; distance; distance /= 2) sum += __shfl_xor_sync(ALL_LANES, sum, distance);
    if (lane == 0) camera[field] = (float)sum;
  }
}
