// Shared part of the projection and its gradient: the chain from a Gaussian to its ellipse, for sixteen
// Gaussians at once.
#pragma once

#include <cmath>

#include "columns.h"
#include "harmonics.h"
#include "projection.h"
#include "splats.h"

namespace splatax {

// Same constants as in splatax/projection.py.
constexpr float NEAR = 0.01f;
constexpr float MAX_SLOPE = 1e6f;
constexpr float MAX_LOG_SCALE = 40;
constexpr float FRUSTUM_MARGIN = 0.3f;
constexpr float LOG2_E = 1.442695041f;
constexpr int PART = 4096;  // Gaussians that one thread works on at a time

// x clipped to [low, high], and a mask of the lanes where it was inside.
struct Clipped {
  Lanes value;
  Mask below, above;

  Clipped(Lanes x, Lanes low, Lanes high)
      : value(min(max(x, low), high)), below(x < low), above(high < x) {}
};

// Slope in the Jacobian, clipped to the image and a margin around it.
SPLATAX_INLINE Clipped clipped(Lanes slope, Lanes centre, Lanes focal, int size) {
  const Lanes margin = broadcast(FRUSTUM_MARGIN * 0.5f * size);
  return {slope, -(centre + margin) / focal, (broadcast(size) - centre + margin) / focal};
}

// Values that the image and the gradient share, for sixteen Gaussians.
struct Projection {
  Matrix rotation;            // columns of the camera's rotation
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
    fx = broadcast(camera[FX]), fy = broadcast(camera[FY]), cx = broadcast(camera[CX]), cy = broadcast(camera[CY]);
    for (int k = 0; k < 3; ++k) {
      const float* column = camera + ROTATION + k;
      rotation.column[k] = {broadcast(column[0]), broadcast(column[3]), broadcast(column[6])};
    }
    mean = read_vectors(gaussians.means + 3 * static_cast<size_t>(first), count);
    const float* t = camera + TRANSLATION;
    const Vector seen = rotation * mean + Vector{broadcast(t[0]), broadcast(t[1]), broadcast(t[2])};
    const Lanes widest = MAX_SLOPE * seen.z;
    const Mask in_front = (broadcast(NEAR) < seen.z) & (seen.z < broadcast(INFINITY)) & (absolute(seen.x) < widest) &
                          (absolute(seen.y) < widest);
    mean = or_zero(in_front, mean);  // culled rows must not propagate NaN
    point = {or_zero(in_front, seen.x), or_zero(in_front, seen.y), where(in_front, seen.z, broadcast(1))};
    inverse_z = broadcast(1) / point.z;

    slope_x = point.x * inverse_z, slope_y = point.y * inverse_z;
    const Clipped x = clipped_x(view), y = clipped_y(view);
    const Lanes kx = fx * inverse_z, ky = fy * inverse_z;
    jacobian[0] = {kx, broadcast(0), -(kx * x.value)};
    jacobian[1] = {broadcast(0), ky, -(ky * y.value)};

    orient(gaussians, first, count);
    for (int k = 0; k < 3; ++k) factor.column[k] = rotation * oriented.column[k];
    f = transposed_times(factor, jacobian[0]), g = transposed_times(factor, jacobian[1]);
    const Lanes size = dot(f, f) + dot(g, g), square = size * size;
    usable = in_front & (absolute(square) < broadcast(INFINITY));
    f = or_zero(usable, f), g = or_zero(usable, g);
    for (int k = 0; k < 3; ++k) {
      oriented.column[k] = or_zero(usable, oriented.column[k]);
      factor.column[k] = or_zero(usable, factor.column[k]);
    }
    normal = cross(f, g);
    sharp = dot(normal, normal);
    const Lanes variance = broadcast(view.variance), aa = dot(f, f), cc = dot(g, g);
    determinant = multiply_add(variance, aa + cc, sharp) + variance * variance;
    usable = usable & (broadcast(0) < determinant);  // without a low-pass, a Gaussian can be too thin
    determinant = where(usable, determinant, broadcast(1));
    a = where(usable, aa + variance, broadcast(1));
    b = dot(f, g);
    c = where(usable, cc + variance, broadcast(1));

    const Lanes logit = read_numbers(gaussians.opacity_logits + first, count);
    const Lanes decay = exp2(max(min(-LOG2_E * logit, broadcast(120)), broadcast(-120)));
    own_opacity = broadcast(1) / (decay + 1);
    const float least = view.least_fade;
    fade = view.fades ? sqrt(max(sharp / determinant, broadcast(least * least))) : broadcast(1);
    opacity = own_opacity * fade;
  }

  Clipped clipped_x(const View& view) const { return clipped(slope_x, cx, fx, view.width); }
  Clipped clipped_y(const View& view) const { return clipped(slope_y, cy, fy, view.height); }

 private:
  void orient(const Gaussians& gaussians, int first, int count) {
    const Columns<4> quats(gaussians.quats + 4 * static_cast<size_t>(first), 4, count);
    const Columns<3> log_scales(gaussians.log_scales + 3 * static_cast<size_t>(first), 3, count);
    Lanes squared = broadcast(0);
    for (int k = 0; k < 4; ++k) {
      quat[k] = quats[k];
      squared = multiply_add(quat[k], quat[k], squared);
    }
    quat_length = sqrt(squared);
    const Mask turned = broadcast(0) < squared;  // a zero quaternion stays zero: no rotation
    const Lanes unit = or_zero(turned, broadcast(1) / where(turned, quat_length, broadcast(1)));
    for (Lanes& component : quat) component = component * unit;
    const Lanes w = quat[0], x = quat[1], y = quat[2], z = quat[3];
    turn.column[0] = {1 - 2.0f * (y * y + z * z), 2.0f * (x * y + w * z), 2.0f * (x * z - w * y)};
    turn.column[1] = {2.0f * (x * y - w * z), 1 - 2.0f * (x * x + z * z), 2.0f * (y * z + w * x)};
    turn.column[2] = {2.0f * (x * z + w * y), 2.0f * (y * z - w * x), 1 - 2.0f * (x * x + y * y)};
    for (int k = 0; k < 3; ++k) {
      const Lanes log_scale = log_scales[k];
      scale_clamped[k] = broadcast(MAX_LOG_SCALE) < log_scale;
      scale[k] = exp2(LOG2_E * max(min(log_scale, broadcast(MAX_LOG_SCALE)), broadcast(-60)));
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
    const Vector offset = p.mean + Vector{broadcast(-position[0]), broadcast(-position[1]), broadcast(-position[2])};
    const Lanes squared = dot(offset, offset);
    const Mask apart = broadcast(0) < squared;
    inverse_length = or_zero(apart, broadcast(1) / sqrt(where(apart, squared, broadcast(1))));
    unit = inverse_length * offset;
  }
};

// Calls body(first, count) for each group of sixteen Gaussians of a part.
template <class Body>
void each_lanes(int part, int total, const Body& body) {
  const int end = std::min((part + 1) * PART, total);
  for (int first = part * PART; first < end; first += LANES) body(first, std::min(LANES, end - first));
}

inline int parts_of(int count) { return (count + PART - 1) / PART; }

}  // namespace splatax
