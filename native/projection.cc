#include "projection.h"

#include <cmath>
#include <vector>

#include "harmonics.h"
#include "splats.h"
#include "vectors.h"

namespace splatax {
namespace {

// As in splatax/projection.py.
constexpr float NEAR = 0.01f;
constexpr float MAX_SLOPE = 1e6f;
constexpr float MAX_LOG_SCALE = 40;
constexpr float FRUSTUM_MARGIN = 0.3f;
constexpr float LOG2_E = 1.442695041f;
constexpr int PART = 4096;  // Gaussians whose share of the camera's gradient is summed at a time

// x clipped to [low, high], and where it was inside.
struct Clipped {
  Lanes value;
  Mask below, above;

  Clipped(Lanes x, Lanes low, Lanes high)
      : value(min(max(x, low), high)), below(x < low), above(high < x) {}
};

// What the image and the gradient have in common, for sixteen Gaussians.
struct Projection {
  Matrix rotation;            // of the camera, columns
  Vector mean, point;         // in the world, and in camera axes; (0, 0, 1) where not in front
  Lanes inverse_z, fx, fy, cx, cy, slope_x, slope_y;
  Vector jacobian[2];         // rows of J
  Lanes quat[4], quat_length, scale[3];
  Mask scale_clamped[3];
  Matrix turn, oriented, factor;  // R(q), R(q) S, W R(q) S
  Vector f, g, normal;        // rows of J W R S, and f x g
  Lanes a, b, c, sharp, determinant;
  Lanes own_opacity, fade, opacity;
  Mask usable;

  Projection(const Gaussians& gaussians, const View& view, int first, int count) {
    const float* camera = view.camera;
    fx = all(camera[FX]), fy = all(camera[FY]), cx = all(camera[CX]), cy = all(camera[CY]);
    for (int k = 0; k < 3; ++k) {
      const float* column = camera + ROTATION + k;
      rotation.column[k] = {all(column[0]), all(column[3]), all(column[6])};
    }
    mean = gather_vector(gaussians.means + 3 * static_cast<size_t>(first), count);
    const float* t = camera + TRANSLATION;
    const Vector seen = rotation * mean + Vector{all(t[0]), all(t[1]), all(t[2])};
    const Lanes widest = MAX_SLOPE * seen.z;
    const Mask in_front =
        (all(NEAR) < seen.z) & (absolute(seen.x) < widest) & (absolute(seen.y) < widest);
    mean = or_zero(in_front, mean);  // what is culled must not send a NaN back
    point = {or_zero(in_front, seen.x), or_zero(in_front, seen.y), where(in_front, seen.z, all(1))};
    inverse_z = all(1) / point.z;

    slope_x = point.x * inverse_z, slope_y = point.y * inverse_z;
    const Clipped x = clipped_x(view), y = clipped_y(view);
    const Lanes kx = fx * inverse_z, ky = fy * inverse_z;
    jacobian[0] = {kx, all(0), -(kx * x.value)};
    jacobian[1] = {all(0), ky, -(ky * y.value)};

    orient(gaussians, first, count);
    for (int k = 0; k < 3; ++k) factor.column[k] = rotation * oriented.column[k];
    f = transposed_times(factor, jacobian[0]), g = transposed_times(factor, jacobian[1]);
    const Lanes size = dot(f, f) + dot(g, g), square = size * size;
    usable = in_front & (absolute(square) < all(INFINITY));
    f = or_zero(usable, f), g = or_zero(usable, g);
    for (int k = 0; k < 3; ++k) {
      oriented.column[k] = or_zero(usable, oriented.column[k]);
      factor.column[k] = or_zero(usable, factor.column[k]);
    }
    normal = cross(f, g);
    sharp = dot(normal, normal);
    const Lanes variance = all(view.variance), aa = dot(f, f), cc = dot(g, g);
    determinant = multiply_add(variance, aa + cc, sharp) + variance * variance;
    a = aa + variance, b = dot(f, g), c = cc + variance;

    const Lanes logit = gather(gaussians.opacity_logits + first, 1, 0, count);
    const Lanes decay = exp2(max(min(-LOG2_E * logit, all(120)), all(-120)));
    own_opacity = all(1) / (decay + 1);
    const Lanes floor = all(view.floor);
    fade = sqrt(max(sharp / determinant, floor * floor));
    opacity = own_opacity * fade;
  }

  Clipped clipped_x(const View& view) const {
    const Lanes margin = all(FRUSTUM_MARGIN * 0.5f * view.width);
    return {slope_x, -(cx + margin) / fx, (all(view.width) - cx + margin) / fx};
  }
  Clipped clipped_y(const View& view) const {
    const Lanes margin = all(FRUSTUM_MARGIN * 0.5f * view.height);
    return {slope_y, -(cy + margin) / fy, (all(view.height) - cy + margin) / fy};
  }

 private:
  void orient(const Gaussians& gaussians, int first, int count) {
    Lanes squared = all(0);
    for (int k = 0; k < 4; ++k) {
      quat[k] = gather(gaussians.quats + 4 * static_cast<size_t>(first), 4, k, count);
      squared = multiply_add(quat[k], quat[k], squared);
    }
    quat_length = sqrt(squared);
    const Mask turned = all(0) < squared;  // a zero quaternion stays zero: no rotation
    const Lanes unit = or_zero(turned, all(1) / where(turned, quat_length, all(1)));
    for (Lanes& component : quat) component = component * unit;
    const Lanes w = quat[0], x = quat[1], y = quat[2], z = quat[3];
    turn.column[0] = {1 - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)};
    turn.column[1] = {2.0f * (x * y - w * z), 1 - 2.0f * (x * x + z * z), 2.0f * (y * z + w * x)};
    turn.column[2] = {2.0f * (x * z + w * y), 2.0f * (y * z - w * x), 1 - 2.0f * (x * x + y * y)};
    for (int k = 0; k < 3; ++k) {
      const Lanes log_scale = gather(gaussians.log_scales + 3 * static_cast<size_t>(first), 3, k, count);
      scale_clamped[k] = all(MAX_LOG_SCALE) < log_scale;
      scale[k] = exp2(LOG2_E * max(min(log_scale, all(MAX_LOG_SCALE)), all(-60)));
      oriented.column[k] = scale[k] * turn.column[k];
    }
  }
};

// Unit vector from the camera to a mean, and its length; zero where they coincide.
struct Direction {
  Vector unit;
  Lanes inverse_length;

  Direction(const Projection& p, const View& view) {
    const float* position = view.camera + POSITION;
    const Vector offset = p.mean + Vector{all(-position[0]), all(-position[1]), all(-position[2])};
    const Lanes squared = dot(offset, offset);
    const Mask apart = all(0) < squared;
    inverse_length = or_zero(apart, all(1) / sqrt(where(apart, squared, all(1))));
    unit = inverse_length * offset;
  }
};

void project_lanes(const Gaussians& gaussians, const View& view, const Projected& splats, int first,
                   int count) {
  const Projection p(gaussians, view, first, count);
  const size_t row = first;
  const Lanes x = multiply_add(p.fx, p.slope_x, p.cx), y = multiply_add(p.fy, p.slope_y, p.cy);

  alignas(64) float reach[LANES];
  store(reach, max(p.opacity * all(1 / MIN_ALPHA), all(1)));
  for (float& value : reach) value = 2 * std::log(value);
  Lanes width = sqrt(load(reach) * p.a), height = sqrt(load(reach) * p.c);
  const Mask opaque = p.usable & (all(MIN_ALPHA) <= p.opacity);
  const Mask overlaps = (all(0) < x + width) & (x - width < all(view.width)) & (all(0) < y + height) &
                        (y - height < all(view.height));
  const Mask visible = opaque & overlaps;
  const Lanes u = sqrt(p.c / p.determinant);

  scatter(x, splats.means2d + 2 * row, 2, 0, count), scatter(y, splats.means2d + 2 * row, 2, 1, count);
  scatter_vector({u, -(p.b * u) / p.c, all(1) / sqrt(p.c)}, splats.sqrt_conics + 3 * row, count);
  scatter(p.point.z, splats.depths + row, 1, 0, count);
  scatter(or_zero(visible, width), splats.extents + 2 * row, 2, 0, count);
  scatter(or_zero(visible, height), splats.extents + 2 * row, 2, 1, count);
  scatter(p.opacity, splats.opacities + row, 1, 0, count);

  Vector color{all(0), all(0), all(0)};
  if (any(visible)) {
    const Direction direction(p, view);
    Lanes basis[MAX_COEFFICIENTS];
    harmonics(direction.unit.x, direction.unit.y, direction.unit.z, gaussians.coefficients, basis);
    const int stride = 3 * gaussians.coefficients;
    const float* sh = gaussians.sh + row * stride;
    color = {all(0.5f), all(0.5f), all(0.5f)};
    for (int k = 0; k < gaussians.coefficients; ++k) {
      color.x = multiply_add(basis[k], gather(sh, stride, 3 * k, count), color.x);
      color.y = multiply_add(basis[k], gather(sh, stride, 3 * k + 1, count), color.y);
      color.z = multiply_add(basis[k], gather(sh, stride, 3 * k + 2, count), color.z);
    }
  }
  scatter_vector({max(color.x, all(0)), max(color.y, all(0)), max(color.z, all(0))}, splats.colors + 3 * row,
                 count);
}

// dL/d sh, and the gradient that reaches the mean through the direction of view.
SPLATAX_INLINE Vector color_gradient(const Gaussians& gaussians, const View& view, const Projection& p, Vector d_color,
                      Mask seen, const GaussianGradients& gradients, int first, int count) {
  const Direction direction(p, view);
  const Vector& unit = direction.unit;
  Dual basis[MAX_COEFFICIENTS];
  const Lanes zero = all(0), one = all(1);
  harmonics<Dual>({unit.x, {one, zero, zero}}, {unit.y, {zero, one, zero}}, {unit.z, {zero, zero, one}},
                  gaussians.coefficients, basis);
  const int stride = 3 * gaussians.coefficients;
  const float* sh = gaussians.sh + static_cast<size_t>(first) * stride;
  float* d_sh = gradients.sh + static_cast<size_t>(first) * stride;
  // Where a colour is clamped to zero, it does not depend on anything.
  Vector own[MAX_COEFFICIENTS], value{all(0.5f), all(0.5f), all(0.5f)};
  for (int k = 0; k < gaussians.coefficients; ++k) {
    own[k] = {gather(sh, stride, 3 * k, count), gather(sh, stride, 3 * k + 1, count),
              gather(sh, stride, 3 * k + 2, count)};
    value = value + basis[k].value * own[k];
  }
  d_color = {or_zero(seen & (zero < value.x), d_color.x), or_zero(seen & (zero < value.y), d_color.y),
             or_zero(seen & (zero < value.z), d_color.z)};
  Vector d_unit{zero, zero, zero};
  for (int k = 0; k < gaussians.coefficients; ++k) {
    d_unit = d_unit + dot(own[k], d_color) * Vector{basis[k].d[0], basis[k].d[1], basis[k].d[2]};
    scatter(basis[k].value * d_color.x, d_sh, stride, 3 * k, count);
    scatter(basis[k].value * d_color.y, d_sh, stride, 3 * k + 1, count);
    scatter(basis[k].value * d_color.z, d_sh, stride, 3 * k + 2, count);
  }
  return direction.inverse_length * (d_unit + (-dot(unit, d_unit)) * unit);
}

// Sums of sixteen Gaussians' shares of the camera's gradient.
struct CameraGradient {
  Lanes sums[CAMERA_FIELDS];

  CameraGradient() {
    for (Lanes& sum : sums) sum = all(0);
  }
  SPLATAX_INLINE void add(int field, Lanes share) { sums[field] += share; }
  SPLATAX_INLINE void add(int field, const Vector& share) { add(field, share.x), add(field + 1, share.y), add(field + 2, share.z); }
  // To the rotation: share a b^T.
  SPLATAX_INLINE void add_outer(const Vector& a, const Vector& b) {
    add(ROTATION, a.x * b), add(ROTATION + 3, a.y * b), add(ROTATION + 6, a.z * b);
  }
  void add_to(double total[CAMERA_FIELDS]) const {
    for (int field = 0; field < CAMERA_FIELDS; ++field) {
      alignas(64) float each[LANES];
      store(each, sums[field]);
      for (const float value : each) total[field] += value;
    }
  }
};

// Slope x / z, clipped, in the Jacobian: what reaches the point, and through the bounds the camera.
//
// Returns dL/d (x / z); the bounds are -(c + margin) / f and (size - c + margin) / f.
SPLATAX_INLINE Lanes clip_gradient(const Clipped& slope, Lanes d_slope, Lanes focal, int focal_field, int centre_field,
                    CameraGradient& camera) {
  const Lanes d_outside = where(slope.below, d_slope, or_zero(slope.above, d_slope));
  camera.add(centre_field, -(d_outside / focal));
  camera.add(focal_field, -(d_outside * slope.value / focal));
  return d_slope - d_outside;
}

// dL/d log_scales and quats, from dL/d (R(q) S).
SPLATAX_INLINE void orientation_gradient(const Projection& p, const Matrix& d_oriented, Mask seen,
                          const GaussianGradients& gradients, int first, int count) {
  Matrix d;  // of R(q)
  const size_t row = first;
  for (int k = 0; k < 3; ++k) {
    const Lanes d_scale = dot(p.turn.column[k], d_oriented.column[k]) * p.scale[k];
    const Lanes free = where(p.scale_clamped[k], all(0), d_scale);
    scatter(or_zero(seen, free), gradients.log_scales + 3 * row, 3, k, count);
    d.column[k] = p.scale[k] * d_oriented.column[k];
  }
  const Lanes w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3];
  const auto &r0 = d.column[0], &r1 = d.column[1], &r2 = d.column[2];
  const Lanes across_x = r1.z - r2.y, across_y = r2.x - r0.z, across_z = r0.y - r1.x;
  const Lanes xy = r0.y + r1.x, xz = r0.z + r2.x, yz = r1.z + r2.y;
  const Lanes d_unit[4] = {
      2.0f * (x * across_x + y * across_y + z * across_z),
      2.0f * (w * across_x + y * xy + z * xz - 2.0f * (x * (r1.y + r2.z))),
      2.0f * (w * across_y + x * xy + z * yz - 2.0f * (y * (r0.x + r2.z))),
      2.0f * (w * across_z + x * xz + y * yz - 2.0f * (z * (r0.x + r1.y))),
  };
  Lanes along = all(0);
  for (int k = 0; k < 4; ++k) along = multiply_add(d_unit[k], p.quat[k], along);
  const Mask turned = seen & (all(0) < p.quat_length);
  const Lanes inverse = all(1) / where(turned, p.quat_length, all(1));
  for (int k = 0; k < 4; ++k) {
    scatter(or_zero(turned, (d_unit[k] - along * p.quat[k]) * inverse), gradients.quats + 4 * row, 4, k, count);
  }
}

// The chain rule backwards through `Projection`. Names are those of the equations in
// splatax/projection.py: Sigma' = F F^T + v I with rows f, g of F = J W R S, (a, b, c) of Sigma',
// D = |f x g|^2 + v (|f|^2 + |g|^2) + v^2, and u = sqrt(c / D), v = -b u / c, w = 1 / sqrt(c).
void gradient_lanes(const Gaussians& gaussians, const View& view, const ProjectedCotangents& cotangents,
                    const GaussianGradients& gradients, int first, int count, CameraGradient& camera) {
  const size_t row = first;
  const Lanes extent = gather(cotangents.extents + 2 * row, 2, 0, count);
  alignas(64) float places[LANES];
  for (int lane = 0; lane < LANES; ++lane) places[lane] = static_cast<float>(lane);
  const Mask seen = (all(0) < extent) & (load(places) < all(static_cast<float>(count)));
  const Projection p(gaussians, view, first, count);

  const Lanes u = sqrt(p.c / p.determinant), w = all(1) / sqrt(p.c), b_per_c = p.b / p.c;
  const Vector d_root = gather_vector(cotangents.sqrt_conics + 3 * row, count);
  const Lanes d_u = d_root.x - d_root.y * b_per_c;
  const Lanes d_b = -(d_root.y * u / p.c);
  const Lanes d_c = (d_root.y * u * b_per_c) / p.c + (d_u * u - d_root.z * w) / (2.0f * p.c);
  const Lanes d_opacity = gather(cotangents.opacities + row, 1, 0, count);
  const Mask fading = all(view.floor) < p.fade;  // where the opacity depends on the shape
  const Lanes d_fade = or_zero(fading, d_opacity * p.opacity);
  const Lanes d_determinant = -(d_u * u + d_fade) / (2.0f * p.determinant);
  const Lanes d_sharp = d_determinant + d_fade / (2.0f * where(fading, p.sharp, all(1)));
  const Lanes d_logit = d_opacity * p.opacity * (1 - p.own_opacity);
  scatter(or_zero(seen, d_logit), gradients.opacity_logits + row, 1, 0, count);

  const Vector d_normal = (2.0f * d_sharp) * p.normal;
  const Lanes spread = (2 * view.variance) * d_determinant;
  const Vector d_f = or_zero(seen, cross(p.g, d_normal) + spread * p.f + d_b * p.g);
  const Vector d_g = or_zero(seen, cross(d_normal, p.f) + (spread + 2.0f * d_c) * p.g + d_b * p.f);

  Matrix d_oriented;
  const Lanes f_of[3] = {d_f.x, d_f.y, d_f.z}, g_of[3] = {d_g.x, d_g.y, d_g.z};
  for (int k = 0; k < 3; ++k) {
    const Vector d_factor = f_of[k] * p.jacobian[0] + g_of[k] * p.jacobian[1];
    d_oriented.column[k] = transposed_times(p.rotation, d_factor);
    camera.add_outer(d_factor, p.oriented.column[k]);
  }
  orientation_gradient(p, d_oriented, seen, gradients, first, count);

  const Vector d_j0 = p.factor * d_f, d_j1 = p.factor * d_g;
  const Clipped slope_x = p.clipped_x(view), slope_y = p.clipped_y(view);
  const Lanes kx = p.fx * p.inverse_z, ky = p.fy * p.inverse_z;
  const Lanes d_kx = d_j0.x - slope_x.value * d_j0.z, d_ky = d_j1.y - slope_y.value * d_j1.z;
  const Lanes d_x2d = or_zero(seen, gather(cotangents.means2d + 2 * row, 2, 0, count));
  const Lanes d_y2d = or_zero(seen, gather(cotangents.means2d + 2 * row, 2, 1, count));
  const Lanes d_slope_x = d_x2d * p.fx + clip_gradient(slope_x, -(kx * d_j0.z), p.fx, FX, CX, camera);
  const Lanes d_slope_y = d_y2d * p.fy + clip_gradient(slope_y, -(ky * d_j1.z), p.fy, FY, CY, camera);
  camera.add(FX, d_kx * p.inverse_z + d_x2d * p.slope_x), camera.add(FY, d_ky * p.inverse_z + d_y2d * p.slope_y);
  camera.add(CX, d_x2d), camera.add(CY, d_y2d);
  const Lanes d_depth = or_zero(seen, gather(cotangents.depths + row, 1, 0, count));
  const Vector d_point{
      d_slope_x * p.inverse_z, d_slope_y * p.inverse_z,
      d_depth - (d_kx * kx + d_ky * ky + d_slope_x * p.slope_x + d_slope_y * p.slope_y) * p.inverse_z};
  camera.add_outer(d_point, p.mean), camera.add(TRANSLATION, d_point);

  const Vector d_color = gather_vector(cotangents.colors + 3 * row, count);
  const Vector d_offset =
      or_zero(seen, color_gradient(gaussians, view, p, d_color, seen, gradients, first, count));
  camera.add(POSITION, Vector{-d_offset.x, -d_offset.y, -d_offset.z});
  scatter_vector(transposed_times(p.rotation, d_point) + d_offset, gradients.means + 3 * row, count);
}

// Calls body(first, count) for sixteen Gaussians after the other of a part.
template <class Body>
void each_lanes(int part, int total, const Body& body) {
  const int end = std::min((part + 1) * PART, total);
  for (int first = part * PART; first < end; first += LANES) body(first, std::min(LANES, end - first));
}

int parts_of(int count) { return (count + PART - 1) / PART; }

}  // namespace

void project(const Gaussians& gaussians, const View& view, const Projected& splats, Workers& workers) {
  workers.each(parts_of(gaussians.count), [&](int part) {
    each_lanes(part, gaussians.count,
               [&](int first, int count) { project_lanes(gaussians, view, splats, first, count); });
  });
}

void project_gradient(const Gaussians& gaussians, const View& view, const ProjectedCotangents& cotangents,
                      const GaussianGradients& gradients, Workers& workers) {
  // Parts are as large whatever the number of threads, and so is their sum.
  std::vector<double> sums(static_cast<size_t>(parts_of(gaussians.count)) * CAMERA_FIELDS, 0.0);
  workers.each(parts_of(gaussians.count), [&](int part) {
    each_lanes(part, gaussians.count, [&](int first, int count) {
      CameraGradient camera;
      gradient_lanes(gaussians, view, cotangents, gradients, first, count, camera);
      camera.add_to(&sums[static_cast<size_t>(part) * CAMERA_FIELDS]);
    });
  });
  for (int field = 0; field < CAMERA_FIELDS; ++field) {
    double total = 0;
    for (size_t at = field; at < sums.size(); at += CAMERA_FIELDS) total += sums[at];
    gradients.camera[field] = static_cast<float>(total);
  }
}

}  // namespace splatax
