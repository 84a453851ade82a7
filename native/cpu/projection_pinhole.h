// The pinhole: (x, y) / z.
#pragma once

#include "projection_lens.h"

namespace splatax {

// Slope in the Jacobian, clipped to the image and a margin around it.
SPLATAX_INLINE Clipped clipped(Lanes slope, Lanes centre, Lanes focal, float size) {
  const Lanes margin = broadcast(FRUSTUM_MARGIN * 0.5f * size);
  return {slope, -(centre + margin) / focal, (broadcast(size) - centre + margin) / focal};
}

struct Pinhole {
  static constexpr int FIELDS = CAMERA_FIELDS;

  Lanes inverse_z, fx, fy, cx, cy, slope_x, slope_y, z, kx, ky;
  Clipped x, y;
  Vector jacobian[2];

  static SPLATAX_INLINE Mask sees(const Vector& point, const float*) { return in_front(point); }

  SPLATAX_INLINE Pinhole(const Vector& point, const View& view)
      : inverse_z(broadcast(1) / point.z),
        fx(broadcast(view.camera[FX])),
        fy(broadcast(view.camera[FY])),
        cx(broadcast(view.camera[CX])),
        cy(broadcast(view.camera[CY])),
        slope_x(point.x * inverse_z),
        slope_y(point.y * inverse_z),
        z(point.z),
        kx(fx * inverse_z),
        ky(fy * inverse_z),
        x(clipped(slope_x, cx, fx, view.width)),
        y(clipped(slope_y, cy, fy, view.height)),
        jacobian{{kx, broadcast(0), -(kx * x.value)}, {broadcast(0), ky, -(ky * y.value)}} {}

  SPLATAX_INLINE Lanes pixel_x() const { return multiply_add(fx, slope_x, cx); }
  SPLATAX_INLINE Lanes pixel_y() const { return multiply_add(fy, slope_y, cy); }
  SPLATAX_INLINE Lanes depth() const { return z; }

  template <class Camera>
  SPLATAX_INLINE Vector pull(const ImageOfPoint& d, Camera& camera) const {
    const Lanes d_kx = d.jacobian[0].x - x.value * d.jacobian[0].z, d_ky = d.jacobian[1].y - y.value * d.jacobian[1].z;
    const Lanes d_slope_x = d.x * fx + clip_gradient(x, -(kx * d.jacobian[0].z), fx, FX, CX, camera);
    const Lanes d_slope_y = d.y * fy + clip_gradient(y, -(ky * d.jacobian[1].z), fy, FY, CY, camera);
    camera.add(FX, d_kx * inverse_z + d.x * slope_x);
    camera.add(FY, d_ky * inverse_z + d.y * slope_y);
    camera.add(CX, d.x);
    camera.add(CY, d.y);
    return {d_slope_x * inverse_z, d_slope_y * inverse_z,
            d.depth - (d_kx * kx + d_ky * ky + d_slope_x * slope_x + d_slope_y * slope_y) * inverse_z};
  }

  SPLATAX_INLINE ImageOfPoint push(const Vector& d_point, const float* d_camera) const {
    const Lanes d_fx = broadcast(d_camera[FX]), d_fy = broadcast(d_camera[FY]);
    const Lanes d_cx = broadcast(d_camera[CX]), d_cy = broadcast(d_camera[CY]);
    const Lanes d_slope_x = (d_point.x - slope_x * d_point.z) * inverse_z;
    const Lanes d_slope_y = (d_point.y - slope_y * d_point.z) * inverse_z;
    const Lanes d_kx = (d_fx - kx * d_point.z) * inverse_z, d_ky = (d_fy - ky * d_point.z) * inverse_z;
    const Lanes d_x = clip_tangent(x, d_slope_x, fx, d_fx, d_cx), d_y = clip_tangent(y, d_slope_y, fy, d_fy, d_cy);
    return {multiply_add(d_fx, slope_x, multiply_add(fx, d_slope_x, d_cx)),
            multiply_add(d_fy, slope_y, multiply_add(fy, d_slope_y, d_cy)),
            {{d_kx, broadcast(0), -(d_kx * x.value + kx * d_x)}, {broadcast(0), d_ky, -(d_ky * y.value + ky * d_y)}},
            d_point.z};
  }

 private:
  // Gradient of the clipped slope x / z in the Jacobian, to the point and, through the bounds, to the camera.
  //
  // Returns dL/d (x / z); the bounds are -(c + margin) / f and (size - c + margin) / f.
  template <class Camera>
  static SPLATAX_INLINE Lanes clip_gradient(const Clipped& slope, Lanes d_slope, Lanes focal, int focal_field,
                                            int centre_field, Camera& camera) {
    const Lanes d_outside = where(slope.below, d_slope, or_zero(slope.above, d_slope));
    camera.add(centre_field, -(d_outside / focal));
    camera.add(focal_field, -(d_outside * slope.value / focal));
    return d_slope - d_outside;
  }
  static SPLATAX_INLINE Lanes clip_tangent(const Clipped& slope, Lanes d_slope, Lanes focal, Lanes d_focal,
                                           Lanes d_centre) {
    const Lanes d_bound = -((d_centre + slope.value * d_focal) / focal);
    return where(slope.below, d_bound, where(slope.above, d_bound, d_slope));
  }
};

}  // namespace splatax
