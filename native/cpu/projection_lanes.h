// Shared part of the projection and its gradient: the chain from a Gaussian to its ellipse, for sixteen
// Gaussians at once.
#pragma once

#include <cmath>

#include "columns.h"
#include "harmonics.h"
#include "logarithm.h"
#include "projection_fisheye.h"
#include "projection_opencv.h"
#include "projection_pinhole.h"
#include "splats.h"

namespace splatax {

constexpr float MAX_LOG_SCALE = 40;  // as in splatax/projection.py
constexpr int PART = 4096;  // Gaussians that one thread works on at a time

// Reads numbers of sixteen Gaussians, from `first` on, as columns.
template <int MAX>
SPLATAX_INLINE void read_fields(Columns<MAX>& columns, const Gaussians& gaussians, const float* array, int width, int first,
                                int count) {
  if (gaussians.rows) return columns.read(array, width, gaussians.rows + first, count);
  columns.read(array + first * static_cast<size_t>(width), width, count);
}

// The part of the chain before the lens: means in camera axes.
struct Means {
  Matrix rotation;      // columns of the camera's rotation
  Vector world, point;  // (0, 0, 1) in camera axes where the lens does not see them
  Mask seen;
};

// Reads means, and turns them into camera axes.
template <class Lens>
SPLATAX_INLINE Means means_of(const Gaussians& gaussians, const View& view, int first, int count) {
  const float* camera = view.camera;
  Means means;
  for (int k = 0; k < 3; ++k) {
    const float* column = camera + ROTATION + k;
    means.rotation.column[k] = {broadcast(column[0]), broadcast(column[3]), broadcast(column[6])};
  }
  Columns<3> world;
  read_fields(world, gaussians, gaussians.means, 3, first, count);
  means.world = world.vector(0);
  const float* t = camera + TRANSLATION;
  const Vector point = means.rotation * means.world + Vector{broadcast(t[0]), broadcast(t[1]), broadcast(t[2])};
  means.seen = Lens::sees(point, camera);
  means.world = or_zero(means.seen, means.world);  // culled rows must not propagate NaN
  means.point = {or_zero(means.seen, point.x), or_zero(means.seen, point.y), where(means.seen, point.z, broadcast(1))};
  return means;
}

// Values that the image, the gradient and the tangents share, for sixteen Gaussians.
template <class Lens>
struct Projection {
  Means means;
  Lens lens;                  // image of the means
  Lanes quat[4], quat_length, scale[3];
  Mask scale_clamped[3];
  Matrix turn, oriented, factor;  // R(q), R(q) S, W R(q) S
  Vector f, g, normal;        // rows of J W R S, and f x g
  Lanes a, b, c, sharp, determinant;
  Lanes own_opacity, fade, opacity;
  Mask usable;

  Projection(const Gaussians& gaussians, const View& view, int first, int count)
      : means(means_of<Lens>(gaussians, view, first, count)), lens(means.point, view) {
    orient(gaussians, first, count);
    for (int k = 0; k < 3; ++k) factor.column[k] = means.rotation * oriented.column[k];
    f = transposed_times(factor, lens.jacobian[0]);
    g = transposed_times(factor, lens.jacobian[1]);
    const Lanes size = dot(f, f) + dot(g, g), square = size * size;
    usable = means.seen & (absolute(square) < broadcast(INFINITY));
    f = or_zero(usable, f);
    g = or_zero(usable, g);
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

    Columns<1> logits;
    read_fields(logits, gaussians, gaussians.opacity_logits, 1, first, count);
    const Lanes logit = logits[0];
    const Lanes decay = exp2(max(min(-LOG2_E * logit, broadcast(120)), broadcast(-120)));
    own_opacity = broadcast(1) / (decay + 1);
    const float least = view.least_fade;
    fade = view.fades ? sqrt(max(sharp / determinant, broadcast(least * least))) : broadcast(1);
    opacity = own_opacity * fade;
  }

 private:
  void orient(const Gaussians& gaussians, int first, int count) {
    Columns<4> quats;
    Columns<3> log_scales;
    read_fields(quats, gaussians, gaussians.quats, 4, first, count);
    read_fields(log_scales, gaussians, gaussians.log_scales, 3, first, count);
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

  Direction(const Vector& mean, const View& view) {
    const float* position = view.camera + POSITION;
    const Vector offset = mean + Vector{broadcast(-position[0]), broadcast(-position[1]), broadcast(-position[2])};
    const Lanes squared = dot(offset, offset);
    const Mask apart = broadcast(0) < squared;
    inverse_length = or_zero(apart, broadcast(1) / sqrt(where(apart, squared, broadcast(1))));
    unit = inverse_length * offset;
  }
};

// Calls body with a null pointer to the type of a lens.
template <class Body>
void with_lens(LensKind lens, const Body& body) {
  if (lens == LensKind::OPENCV) return body(static_cast<OpenCV*>(nullptr));
  if (lens == LensKind::FISHEYE) return body(static_cast<Fisheye*>(nullptr));
  return body(static_cast<Pinhole*>(nullptr));
}

// Calls body(first, count) for each group of sixteen Gaussians of a part.
template <class Body>
void each_lanes(int part, int total, const Body& body) {
  const int end = std::min((part + 1) * PART, total);
  for (int first = part * PART; first < end; first += LANES) body(first, std::min(LANES, end - first));
}

inline int parts_of(int count) { return (count + PART - 1) / PART; }

}  // namespace splatax
