// Splats that are drawn along rays: the blend of tiles, with the response of src/splatax/along_rays.py.
//
// With d = pixel - mean, t = u dx + v dy, s = w dy, m = 1 + g . d and H = (a, b; b, c), alpha is 2^(level - q),
//
//   q = (t^2 + s^2) / (m^2 + d^T H d)   where that is less than blur |d|^2 and m > 0,   else blur |d|^2 .
//
// u, v, w and blur are those of `Splats`, times sqrt(log2(e) / 2) or its square. Lists and blocks come from
// ellipses that hold all pixels where a splat is drawn: these stand in for the splats in `Input`, whose channels
// are the rows below.
#pragma once

#include "rasterize.h"

namespace splatax {

struct SlantedRow {
  float x, y, u, v, w, level, gx, gy, a, b, c, blur;
  float channels[GROUP];  // those of the splat, and zeros
};
static_assert(sizeof(SlantedRow) == 64, "one cache line");
constexpr int SLANTED_ROW = sizeof(SlantedRow) / sizeof(float);

// Sums over pixels for a splat. With g = alpha dL/d alpha, k = g / (m^2 + d^T H d) and l = k q, both 0 where the
// blur is drawn, and e = g there:
//
//   g,  k dx, k dy, k dx^2, k dx dy, k dy^2,  l, l dx, l dy, l dx^2, l dx dy, l dy^2,  e dx, e dy,
//   dL/d channels (GROUP),  |dL/dx|, |dL/dy| from numbers that are scaled as above
constexpr int SLANTED_SUMS = 20;

// `image.sums` has GROUP channels.
void slanted(const Input& input, const Image& image, Workers& workers, Scratch& scratch, int64_t max_pairs);

// `sums`: [count SLANTED_SUMS]; the last two are zeros unless `pulled`.
void slanted_gradient(const Input& input, const Cotangents& cotangents, bool pulled, float* sums, Workers& workers,
                      Scratch& scratch, int64_t max_pairs);

}  // namespace splatax
