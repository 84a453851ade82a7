// Real spherical harmonics and their gradients, as in splatax/math/harmonics.py.
#pragma once

#include "duals.h"
#include "projection.h"

namespace splatax {

// Computes the basis functions at a unit direction, band by band; T is Lanes, or Dual<3> for gradients too.
template <class T>
SPLATAX_INLINE void harmonics(const T& x, const T& y, const T& z, int coefficients, T basis[MAX_COEFFICIENTS]) {
  basis[0] = 0.0f * x + 0.28209479177387814f;
  if (coefficients < 4) return;
  basis[1] = -0.4886025119029199f * y;
  basis[2] = 0.4886025119029199f * z;
  basis[3] = -0.4886025119029199f * x;
  if (coefficients < 9) return;
  const T xx = x * x, yy = y * y, zz = z * z, xy = x * y, yz = y * z, xz = x * z;
  basis[4] = 1.0925484305920792f * xy;
  basis[5] = -1.0925484305920792f * yz;
  basis[6] = 0.31539156525252005f * (2.0f * zz - xx - yy);
  basis[7] = -1.0925484305920792f * xz;
  basis[8] = 0.5462742152960396f * (xx - yy);
  if (coefficients < 16) return;
  basis[9] = -0.5900435899266435f * (y * (3.0f * xx - yy));
  basis[10] = 2.890611442640554f * (xy * z);
  basis[11] = -0.4570457994644658f * (y * (4.0f * zz - xx - yy));
  basis[12] = 0.3731763325901154f * (z * (2.0f * zz - 3.0f * xx - 3.0f * yy));
  basis[13] = -0.4570457994644658f * (x * (4.0f * zz - xx - yy));
  basis[14] = 1.445305721320277f * (z * (xx - yy));
  basis[15] = -0.5900435899266435f * (x * (xx - 3.0f * yy));
  if (coefficients < 25) return;
  basis[16] = 2.5033429417967046f * (xy * (xx - yy));
  basis[17] = -1.7701307697799304f * (yz * (3.0f * xx - yy));
  basis[18] = 0.9461746957575601f * (xy * (7.0f * zz - 1.0f));
  basis[19] = -0.6690465435572892f * (yz * (7.0f * zz - 3.0f));
  basis[20] = 0.10578554691520431f * (zz * (35.0f * zz - 30.0f) + 3.0f);
  basis[21] = -0.6690465435572892f * (xz * (7.0f * zz - 3.0f));
  basis[22] = 0.47308734787878004f * ((xx - yy) * (7.0f * zz - 1.0f));
  basis[23] = -1.7701307697799304f * (xz * (xx - 3.0f * yy));
  basis[24] = 0.6258357354491761f * (xx * (xx - 3.0f * yy) - yy * (3.0f * xx - yy));
}

}  // namespace splatax
