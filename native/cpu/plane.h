// The planes of sixteen Gaussians in one view: what `planes.cc` writes and differentiates.
#pragma once

#include <cmath>

#include "columns.h"
#include "logarithm.h"
#include "planes.h"
#include "splats.h"

namespace splatax {

// Same constants as in splatax/surfaces.py.
constexpr float LEAST_LOG_SCALE = -60, FLATTEST = -12, STEEPEST = 2, FARTHEST = 0.9f;
constexpr float LARGEST_LOG_SCALE = 40;  // whose square is a float; the limit by depth is then the smaller one
constexpr float LEAST_REACH = 1e-6f;     // squared

SPLATAX_INLINE Vector zero_vector() { return {broadcast(0), broadcast(0), broadcast(0)}; }
SPLATAX_INLINE Vector operator-(const Vector& a) { return broadcast(-1) * a; }
SPLATAX_INLINE Vector operator-(const Vector& a, const Vector& b) { return a + -b; }
SPLATAX_INLINE Vector& operator+=(Vector& a, const Vector& b) { return a = a + b; }
SPLATAX_INLINE Vector where(Mask mask, const Vector& a, const Vector& b) {
  return {where(mask, a.x, b.x), where(mask, a.y, b.y), where(mask, a.z, b.z)};
}
SPLATAX_INLINE Lanes where(Mask mask, Lanes a, float b) { return where(mask, a, broadcast(b)); }

// The planes of sixteen rows. Names are those of splatax/surfaces.py; letters e are the axes of the Gaussian.
struct Plane {
  Mask shown;
  Vector x, y, near, along[3];
  Lanes disparity, quat[4], inverse_length;
  Mask turned;
  Vector e[3];
  Lanes log_scale[3], scale[3], precision[3], onto[3];  // onto: e . facing
  Mask sized[3], flatter[3], shortest[3];               // flatter: those whose precision is not clamped
  Lanes sign, inverse_area;
  Vector facing, normal, unit, axis;
  Lanes inverse_normal, down, slope[2], spread, flip;
  Lanes u, v, w, opacity, blur, first, second, drawn, reach, most, limit;
  Mask limited, by_spread, reaches;
  bool along_rays;

  Plane(const PlanesOfView& of, int start, int count) {
    const size_t row = start;
    const Columns<2> extents(of.extents + 2 * row, 2, count);
    shown = (broadcast(0) < extents[0]) & (broadcast(0) < extents[1]);
    read(of.rows, row, count);
    orient();
    tilt();
    bound();
  }

 private:
  void read(const PlaneRows<const float>& rows, size_t row, int count) {
    const Columns<9> places(rows.places + 9 * row, 9, count);
    x = places.vector(0);
    y = places.vector(3);
    near = places.vector(6);
    disparity = read_numbers(rows.disparities + row, count);
    const Columns<4> quats(rows.quats + 4 * row, 4, count);
    for (int k = 0; k < 4; ++k) quat[k] = where(shown, quats[k], k == 0 ? 1 : 0);
    const Columns<3> log_scales(rows.log_scales + 3 * row, 3, count);
    for (int k = 0; k < 3; ++k) {
      const Lanes given = where(shown, log_scales[k], 0);
      log_scale[k] = min(max(given, broadcast(LEAST_LOG_SCALE)), broadcast(LARGEST_LOG_SCALE));
      sized[k] = (broadcast(LEAST_LOG_SCALE) <= given) & (given <= broadcast(LARGEST_LOG_SCALE));
    }
    const Columns<3> conics(rows.sqrt_conics + 3 * row, 3, count);
    u = where(shown, conics[0], 1);
    v = where(shown, conics[1], 0);
    w = where(shown, conics[2], 1);
    opacity = where(shown, read_numbers(rows.opacities + row, count), 1);
    along_rays = rows.blurs != nullptr;
    blur = along_rays ? where(shown, read_numbers(rows.blurs + row, count), 0) : broadcast(0);
  }

  void orient() {
    Lanes squared = broadcast(0);
    for (const Lanes part : quat) squared = multiply_add(part, part, squared);
    turned = broadcast(0) < squared;
    inverse_length = or_zero(turned, broadcast(1) / sqrt(where(turned, squared, 1)));
    for (Lanes& part : quat) part = part * inverse_length;
    const Lanes q = quat[0], i = quat[1], j = quat[2], k = quat[3];
    e[0] = {1 - 2.0f * (j * j + k * k), 2.0f * (i * j + q * k), 2.0f * (i * k - q * j)};
    e[1] = {2.0f * (i * j - q * k), 1 - 2.0f * (i * i + k * k), 2.0f * (j * k + q * i)};
    e[2] = {2.0f * (i * k + q * j), 2.0f * (j * k - q * i), 1 - 2.0f * (i * i + j * j)};
    const Lanes least = min(min(log_scale[0], log_scale[1]), log_scale[2]);
    shortest[0] = log_scale[0] <= least;
    shortest[1] = and_not(log_scale[1] <= least, shortest[0]);
    shortest[2] = and_not(and_not(log_scale[2] <= least, shortest[0]), shortest[1]);
    for (int n = 0; n < 3; ++n) {
      const Lanes ratio = least - log_scale[n];
      flatter[n] = broadcast(FLATTEST) < ratio;
      precision[n] = exp2((2 * LOG2_E) * max(ratio, broadcast(FLATTEST)));
      scale[n] = exp2(LOG2_E * log_scale[n]);
    }
  }

  void tilt() {
    along[0] = cross(y, near);
    along[1] = cross(near, x);
    along[2] = cross(x, y);
    inverse_area = broadcast(1) / sqrt(dot(along[2], along[2]));
    const Lanes volume = dot(near, along[2]);
    sign = where(broadcast(0) < volume, broadcast(1), or_zero(volume < broadcast(0), broadcast(-1)));
    facing = (sign * inverse_area) * along[2];
    normal = zero_vector();
    Lanes squared = broadcast(0);
    for (int n = 0; n < 3; ++n) {
      onto[n] = dot(e[n], facing);
      normal += (precision[n] * onto[n]) * e[n];
      const Lanes deep = dot(near, e[n]) * scale[n];
      squared = multiply_add(deep, deep, squared);
    }
    down = dot(normal, along[2]);
    for (int n = 0; n < 2; ++n) slope[n] = -(dot(normal, along[n]) / down);
    spread = sqrt(squared);
    inverse_normal = broadcast(1) / sqrt(dot(normal, normal));
    unit = inverse_normal * normal;
    axis = where(shortest[0], e[0], where(shortest[1], e[1], e[2]));
    flip = where(dot(axis, facing) < broadcast(0), broadcast(-1), broadcast(1));
    axis = flip * axis;
  }

  // The limit of the slope; see `planes` in splatax/surfaces.py.
  void bound() {
    first = slope[0] / u;
    second = (slope[1] - v * first) / w;
    const Lanes squared = first * first + second * second;
    const Mask sloped = broadcast(0) < squared;
    drawn = sqrt(where(sloped, along_rays ? (slope[0] * slope[0] + slope[1] * slope[1]) * blur : squared, 1));
    const Lanes reached = 2.0f * log(max(opacity * broadcast(1 / MIN_ALPHA), broadcast(1)));
    reaches = broadcast(LEAST_REACH) < reached;
    reach = sqrt(max(reached, broadcast(LEAST_REACH)));
    const Lanes steepest = STEEPEST * spread, farthest = FARTHEST * disparity / reach;
    by_spread = steepest <= farthest;
    most = min(steepest, farthest);
    limited = sloped & (most < drawn);
    limit = where(limited, most / where(limited, drawn, 1), 1);
  }
};

}  // namespace splatax
