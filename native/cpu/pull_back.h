// The gradient of the projection for sixteen Gaussians, and their parts of the camera's.
#pragma once

#include <cmath>

#include "projection_lanes.h"

namespace splatax {

// Sums of some Gaussians' parts of the camera's gradient, lane by lane.
template <int FIELDS>
struct CameraGradient {
  Lanes sums[FIELDS];

  CameraGradient() {
    for (Lanes& sum : sums) sum = broadcast(0);
  }
  SPLATAX_INLINE void add(int field, Lanes part) { sums[field] += part; }
  SPLATAX_INLINE void add(int field, const Vector& part) {
    add(field, part.x);
    add(field + 1, part.y);
    add(field + 2, part.z);
  }
  // Adds a b^T to the gradient of the rotation.
  SPLATAX_INLINE void add_outer(const Vector& a, const Vector& b) {
    add(ROTATION, a.x * b);
    add(ROTATION + 3, a.y * b);
    add(ROTATION + 6, a.z * b);
  }
  // Adds the sums to a total, and resets them to zero.
  void move_to(double total[FIELDS]) {
    for (int field = 0; field < FIELDS; ++field) {
      alignas(64) float each[LANES];
      store(each, sums[field]);
      for (const float value : each) total[field] += value;
      sums[field] = broadcast(0);
    }
  }
};

// Inputs and outputs of the backward pass.
struct Pass {
  const Gaussians& gaussians;
  const View& view;
  const ProjectedCotangents& cotangents;
  const GaussianGradients& gradients;
};

// Backward pass of sixteen Gaussians.
template <class Lens>
class PullBack {
 public:
  PullBack(const Pass& pass, int first, int count)
      : pass(pass), row(first), count(count), p(pass.gaussians, pass.view, first, count) {
    const Lanes extent = Columns<2>(pass.cotangents.extents + 2 * row, 2, count)[0];
    alignas(64) float places[LANES];
    for (int lane = 0; lane < LANES; ++lane) places[lane] = static_cast<float>(lane);
    seen = (broadcast(0) < extent) & (load(places) < broadcast(static_cast<float>(count)));
  }

  // The chain rule backwards through `Projection`. Names are those of the equations in
  // splatax/projection.py: Sigma' = F F^T + v I with rows f, g of F = J W R S, (a, b, c) of Sigma',
  // D = |f x g|^2 + v (|f|^2 + |g|^2) + v^2, and u = sqrt(c / D), v = -b u / c, w = 1 / sqrt(c).
  void run(CameraGradient<Lens::FIELDS>& camera) const {
    const Lanes u = sqrt(p.c / p.determinant), w = broadcast(1) / sqrt(p.c), b_per_c = p.b / p.c;
    const Vector d_root = read_vectors(pass.cotangents.sqrt_conics + 3 * row, count);
    const Lanes d_u = d_root.x - d_root.y * b_per_c;
    const Lanes d_b = -(d_root.y * u / p.c);
    const Lanes d_c = (d_root.y * u * b_per_c) / p.c + (d_u * u - d_root.z * w) / (2.0f * p.c);
    const Lanes d_opacity = read_numbers(pass.cotangents.opacities + row, count);
    const float least = pass.view.fades ? pass.view.least_fade : INFINITY;
    const Mask fading = broadcast(least) < p.fade;  // where the opacity depends on the shape
    const Lanes d_fade = or_zero(fading, d_opacity * p.opacity);
    const Lanes d_determinant = -(d_u * u + d_fade) / (2.0f * p.determinant);
    const Lanes d_sharp = d_determinant + d_fade / (2.0f * where(fading, p.sharp, broadcast(1)));
    const Lanes d_logit = d_opacity * p.opacity * (1 - p.own_opacity);
    write_numbers(or_zero(seen, d_logit), pass.gradients.opacity_logits + row, count);

    const Vector d_normal = (2.0f * d_sharp) * p.normal;
    const Lanes spread = (2 * pass.view.variance) * d_determinant;
    const Vector d_f = or_zero(seen, cross(p.g, d_normal) + spread * p.f + d_b * p.g);
    const Vector d_g = or_zero(seen, cross(d_normal, p.f) + (spread + 2.0f * d_c) * p.g + d_b * p.f);

    Matrix d_oriented;
    const Lanes f_of[3] = {d_f.x, d_f.y, d_f.z}, g_of[3] = {d_g.x, d_g.y, d_g.z};
    for (int k = 0; k < 3; ++k) {
      const Vector d_factor = f_of[k] * p.lens.jacobian[0] + g_of[k] * p.lens.jacobian[1];
      d_oriented.column[k] = transposed_times(p.means.rotation, d_factor);
      camera.add_outer(d_factor, p.oriented.column[k]);
    }
    orientation(d_oriented);

    const Columns<2> d_means2d(pass.cotangents.means2d + 2 * row, 2, count);
    const Vector d_point = p.lens.pull({or_zero(seen, d_means2d[0]),
                                        or_zero(seen, d_means2d[1]),
                                        {p.factor * d_f, p.factor * d_g},
                                        or_zero(seen, read_numbers(pass.cotangents.depths + row, count))},
                                       camera);
    camera.add_outer(d_point, p.means.world);
    camera.add(TRANSLATION, d_point);

    const Vector d_color = read_vectors(pass.cotangents.colors + 3 * row, count);
    const Vector d_offset = or_zero(seen, color(d_color));
    camera.add(POSITION, Vector{-d_offset.x, -d_offset.y, -d_offset.z});
    write_vectors(transposed_times(p.means.rotation, d_point) + d_offset, pass.gradients.means + 3 * row, count);
  }

 private:
  // dL/d sh, and the gradient that reaches the mean through the direction of view.
  SPLATAX_INLINE Vector color(Vector d_color) const {
    const Direction direction(p.means.world, pass.view);
    const Vector& unit = direction.unit;
    Dual<3> basis[MAX_COEFFICIENTS];
    const Lanes zero = broadcast(0), one = broadcast(1);
    harmonics<Dual<3>>({unit.x, {one, zero, zero}}, {unit.y, {zero, one, zero}}, {unit.z, {zero, zero, one}},
                    pass.gaussians.coefficients, basis);
    const int numbers = 3 * pass.gaussians.coefficients;
    const size_t begin = row * numbers;
    Columns<3 * MAX_COEFFICIENTS> sh;  // then its gradient
    read_fields(sh, pass.gaussians, pass.gaussians.sh, numbers, static_cast<int>(row), count);
    // A colour that is clamped to zero has a zero gradient.
    Vector value{broadcast(0.5f), broadcast(0.5f), broadcast(0.5f)};
    for (int k = 0; k < pass.gaussians.coefficients; ++k) value = value + basis[k].value * sh.vector(3 * k);
    d_color = {or_zero(seen & (zero < value.x), d_color.x), or_zero(seen & (zero < value.y), d_color.y),
               or_zero(seen & (zero < value.z), d_color.z)};
    Vector d_unit{zero, zero, zero};
    for (int k = 0; k < pass.gaussians.coefficients; ++k) {
      d_unit = d_unit + dot(sh.vector(3 * k), d_color) * Vector{basis[k].d[0], basis[k].d[1], basis[k].d[2]};
      sh.set(3 * k, basis[k].value * d_color);
    }
    sh.write(pass.gradients.sh + begin, numbers, count);
    return direction.inverse_length * (d_unit + (-dot(unit, d_unit)) * unit);
  }

  // dL/d log_scales and quats, from dL/d (R(q) S).
  SPLATAX_INLINE void orientation(const Matrix& d_oriented) const {
    Matrix d;  // of R(q)
    Columns<3> log_scales;
    for (int k = 0; k < 3; ++k) {
      const Lanes d_scale = dot(p.turn.column[k], d_oriented.column[k]) * p.scale[k];
      const Lanes free = where(p.scale_clamped[k], broadcast(0), d_scale);
      log_scales.set(k, or_zero(seen, free));
      d.column[k] = p.scale[k] * d_oriented.column[k];
    }
    log_scales.write(pass.gradients.log_scales + 3 * row, 3, count);
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
    Lanes along = broadcast(0);
    for (int k = 0; k < 4; ++k) along = multiply_add(d_unit[k], p.quat[k], along);
    const Mask turned = seen & (broadcast(0) < p.quat_length);
    const Lanes inverse = broadcast(1) / where(turned, p.quat_length, broadcast(1));
    Columns<4> quats;
    for (int k = 0; k < 4; ++k) quats.set(k, or_zero(turned, (d_unit[k] - along * p.quat[k]) * inverse));
    quats.write(pass.gradients.quats + 4 * row, 4, count);
  }

  const Pass& pass;
  const size_t row;
  const int count;
  const Projection<Lens> p;
  Mask seen;
};

}  // namespace splatax
