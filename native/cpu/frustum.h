// Gaussians that may reach into the image of a pinhole, from bounds of their size: faster than to project them.
#pragma once

#include <algorithm>
#include <cmath>

#include "projection_lanes.h"

namespace splatax {

// The half side of a splat's box is sqrt(reach (|f|^2 + v)) with f = S R^T W^T J^T, so at most
// sqrt(reach v + spread |W|^2 |J|^2) for either row of J.
class Frustum {
 public:
  Frustum(const View& view) : view_(view), norm_(broadcast(1.002f * squared_norm(view.camera + ROTATION))) {}

  // Whether Gaussians may reach into the image. NaN in a bound does not cull.
  //   seen: their means in camera axes
  //   reach: squared distance in standard deviations from which alpha is under 1/255; below 0 for none
  //   spread: reach times the largest variance
  SPLATAX_INLINE Mask may_see(const Vector& seen, Lanes reach, Lanes spread) const {
    const Mask candidate = (broadcast(NEAR) < seen.z) & (broadcast(0) <= reach);
    if (!any(candidate)) return candidate;
    const Lanes inverse_z = broadcast(1) / seen.z;
    const float* camera = view_.camera;
    const Mask beside_x = outside(seen.x * inverse_z, inverse_z, camera[FX], camera[CX], view_.width, reach, spread);
    const Mask beside_y = outside(seen.y * inverse_z, inverse_z, camera[FY], camera[CY], view_.height, reach, spread);
    return and_not(and_not(candidate, beside_x), beside_y);
  }

 private:
  SPLATAX_INLINE Mask outside(Lanes slope, Lanes inverse_z, float focal, float centre, float size, Lanes reach,
                              Lanes spread) const {
    const Lanes f = broadcast(focal), c = broadcast(centre), k = f * inverse_z;
    const Lanes tilt = clipped(slope, c, f, size).value, middle = multiply_add(f, slope, c);
    const Lanes widened = multiply_add(tilt, tilt, broadcast(1)) * (k * k) * norm_;
    const Lanes squared_half = multiply_add(spread, widened, reach * broadcast(1.002f * view_.variance));
    // The distance of the splat's middle from the image, less a margin for rounding.
    const Lanes apart = absolute(middle - broadcast(0.5f * size)) -
                        multiply_add(broadcast(1e-5f), absolute(middle), broadcast(0.5f * size + 0.05f));
    return (broadcast(0) < apart) & (squared_half < apart * apart);
  }

  // Upper bound of the squared norm of a matrix M, row by row: the largest sum over a row of |M^T M|.
  static float squared_norm(const float* matrix) {
    double largest = 0;
    for (int i = 0; i < 3; ++i) {
      double sum = 0;
      for (int j = 0; j < 3; ++j) {
        double product = 0;
        for (int k = 0; k < 3; ++k) product += static_cast<double>(matrix[3 * k + i]) * matrix[3 * k + j];
        sum += std::abs(product);
      }
      largest = std::max(largest, sum);
    }
    return static_cast<float>(largest);
  }

  const View& view_;
  Lanes norm_;
};

}  // namespace splatax
