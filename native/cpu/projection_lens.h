// What projection needs of a lens. A lens is a type with
//
//   FIELDS                   how many numbers its camera has: `CameraField`, then its own
//   sees(point, camera)      the points in camera axes that it sees
//   Lens(point, view)        the images of sixteen points that it sees
//   pixel_x(), pixel_y(), depth(), jacobian[2]
//   pull(cotangents, camera) adds the gradient of the camera's numbers, and returns that of the points
//   push(d_point, d_camera)  tangents of the images
//
// and a line in `with_lens` and in `LENSES` of splatax/backends/cpu/projection.py.
#pragma once

#include <cmath>

#include "projection.h"
#include "vectors.h"

namespace splatax {

// Same constants as in splatax/cameras/lenses and splatax/footprints.py.
constexpr float NEAR = 0.01f;
constexpr float MAX_SLOPE = 1e6f;
constexpr float FRUSTUM_MARGIN = 0.3f;

// Cotangents or tangents of the image of a point.
struct ImageOfPoint {
  Lanes x, y;          // pixels
  Vector jacobian[2];  // rows, of the pixel by the point in camera axes
  Lanes depth;
};

// x clipped to [low, high], and a mask of the lanes where it was outside.
struct Clipped {
  Lanes value;
  Mask below, above;

  Clipped(Lanes x, Lanes low, Lanes high)
      : value(min(max(x, low), high)), below(x < low), above(high < x) {}
};

// Points in front of the near plane whose slopes do not overflow.
SPLATAX_INLINE Mask in_front(const Vector& point) {
  const Lanes widest = MAX_SLOPE * point.z;
  return (broadcast(NEAR) < point.z) & (point.z < broadcast(INFINITY)) & (absolute(point.x) < widest) &
         (absolute(point.y) < widest);
}

}  // namespace splatax
