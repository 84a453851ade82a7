// The chain from a Gaussian to its ellipse on the image, as in splatax/projection.py:
//
//   F = J W R(q) S with rows f, g;   Sigma' = F F^T + v I = [[a, b], [b, c]];   D = |f x g|^2 + v (|f|^2 + |g|^2) + v^2
#pragma once

#include "arguments.cuh"
#include "vectors.cuh"

// Same constants as in splatax/projection.py.
constexpr float NEAR = 0.01f, MAX_SLOPE = 1e6f, MAX_LOG_SCALE = 40, FRUSTUM_MARGIN = 0.3f;

// Slope x / z in the Jacobian, limited to the image and a margin around it.
struct Slope {
  float free, value;
  bool below, above;

  INLINE Slope(float free, float centre, float focal, int size) : free(free) {
    const float margin = FRUSTUM_MARGIN * 0.5f * size;
    const float low = -(centre + margin) / focal, high = (size - centre + margin) / focal;
    below = free < low;
    above = high < free;
    value = fminf(fmaxf(free, low), high);
  }
};

struct Turn {
  float w, x, y, z, length;  // unit quaternion, and the length before; a zero quaternion stays zero: no rotation

  INLINE Turn(const float* quat) : w(quat[0]), x(quat[1]), y(quat[2]), z(quat[3]) {
    length = sqrtf(fmaf(w, w, fmaf(x, x, fmaf(y, y, z * z))));
    const float inverse = length > 0 ? 1 / length : 0.0f;
    w *= inverse;
    x *= inverse;
    y *= inverse;
    z *= inverse;
  }
  INLINE bool is_finite() const { return ::is_finite(w) && ::is_finite(x) && ::is_finite(y) && ::is_finite(z); }
  INLINE Matrix rotation() const {
    return {{{1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)},
             {2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)},
             {2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)}}};
  }
};

struct Lens {
  float fx, fy, cx, cy;
  Matrix rotation;
  Vector translation, position;

  INLINE Lens(const float* camera) : fx(camera[FX]), fy(camera[FY]), cx(camera[CX]), cy(camera[CY]) {
    for (int k = 0; k < 3; ++k) {
      const float* column = camera + ROTATION + k;
      rotation.column[k] = {column[0], column[3], column[6]};
    }
    translation = vector_at(camera + TRANSLATION);
    position = vector_at(camera + POSITION);
  }
};

struct Projection {
  Vector mean, point;  // in the world and in camera axes; (0, 0, 0) and (0, 0, 1) where not in front
  float inverse_z;
  Slope x, y;
  Turn turn;
  Vector scale;
  Matrix oriented, factor;  // R(q) S, W R(q) S
  Vector f, g, normal;      // normal = f x g
  float a, b, c, sharp, determinant;
  float own_opacity, fade, opacity;
  bool usable;

  // A number that is not finite must not reach the results: operands are replaced before use.
  INLINE Projection(const GaussianRows& gaussians, const View& view, const Lens& lens, int row)
      : mean(vector_at(gaussians.means + 3 * (size_t)row)), point(in_view(lens)), inverse_z(1 / point.z),
        x(point.x * inverse_z, lens.cx, lens.fx, view.width), y(point.y * inverse_z, lens.cy, lens.fy, view.height),
        turn(gaussians.quats + 4 * (size_t)row) {
    const Vector log_scales = vector_at(gaussians.log_scales + 3 * (size_t)row);
    const float logit = gaussians.opacity_logits[row];
    usable = usable && turn.is_finite() && may_scale(log_scales.x) && may_scale(log_scales.y) &&
             may_scale(log_scales.z) && logit == logit;
    scale = {scale_of(log_scales.x), scale_of(log_scales.y), scale_of(log_scales.z)};
    if (!usable) scale = {0, 0, 0};
    const Matrix axes = turn.rotation();
    oriented = {{scale.x * axes.column[0], scale.y * axes.column[1], scale.z * axes.column[2]}};
    for (int k = 0; k < 3; ++k) factor.column[k] = lens.rotation * oriented.column[k];
    f = row_of_factor(jacobian_x(lens));
    g = row_of_factor(jacobian_y(lens));
    const float size = dot(f, f) + dot(g, g);
    if (!usable || !::is_finite(size * size)) clear();
    normal = cross(f, g);
    sharp = dot(normal, normal);
    const float aa = dot(f, f), cc = dot(g, g), variance = view.variance;
    determinant = fmaf(variance, aa + cc, sharp) + variance * variance;
    usable = usable && determinant > 0;  // without a low-pass, a Gaussian can be too thin
    a = usable ? aa + variance : 1;
    b = usable ? dot(f, g) : 0;
    c = usable ? cc + variance : 1;
    determinant = usable ? determinant : 1;
    own_opacity = logit == logit ? 1 / (1 + expf(-logit)) : 0.0f;
    fade = view.fades ? sqrtf(fmaxf(sharp / determinant, view.least_fade * view.least_fade)) : 1;
    opacity = own_opacity * fade;
  }

  // Rows of the Jacobian J.
  INLINE Vector jacobian_x(const Lens& lens) const {
    const float k = lens.fx * inverse_z;
    return {k, 0, -(k * x.value)};
  }
  INLINE Vector jacobian_y(const Lens& lens) const {
    const float k = lens.fy * inverse_z;
    return {0, k, -(k * y.value)};
  }
  INLINE static bool is_clamped(float log_scale) { return log_scale > MAX_LOG_SCALE; }

 private:
  // Sets `usable` to whether the mean is in front of the camera.
  INLINE Vector in_view(const Lens& lens) {
    const Vector seen = lens.rotation * mean + lens.translation;
    const float widest = MAX_SLOPE * seen.z;
    usable = seen.z > NEAR && ::is_finite(seen.z) && fabsf(seen.x) < widest && fabsf(seen.y) < widest;
    if (usable) return seen;
    mean = {0, 0, 0};
    return {0, 0, 1};
  }
  INLINE static bool may_scale(float log_scale) { return log_scale <= 3.402823466e38f; }  // -inf is a flat Gaussian
  INLINE static float scale_of(float log_scale) { return expf(fminf(log_scale, MAX_LOG_SCALE)); }
  INLINE Vector row_of_factor(const Vector& jacobian) const { return transposed_times(factor, jacobian); }
  INLINE void clear() {
    usable = false;
    f = g = Vector{0, 0, 0};
    oriented = factor = Matrix{};
  }
};
