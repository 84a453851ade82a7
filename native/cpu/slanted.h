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

// Channels of one walk: GROUP for colours, WIDE_GROUP for what penalties on geometry blend. Others are zeros.
constexpr int WIDE_GROUP = 12;

struct SlantedShape {
  float x, y, u, v, w, level, gx, gy, a, b, c, blur;
};
template <int C>
struct SlantedRow : SlantedShape {
  float channels[C];
};
static_assert(sizeof(SlantedRow<GROUP>) == 64, "one cache line");
constexpr int SLANTED_SHAPE = sizeof(SlantedShape) / sizeof(float);  // floats of a row before its channels

// Sums over pixels for a splat. With g = alpha dL/d alpha, k = g / (m^2 + d^T H d) and l = k q, both 0 where the
// blur is drawn, and e = g there:
//
//   g,  k dx, k dy, k dx^2, k dx dy, k dy^2,  l, l dx, l dy, l dx^2, l dx dy, l dy^2,  e dx, e dy,
//   dL/d channels,  |dL/dx|, |dL/dy| from numbers that are scaled as above
constexpr int SLANTED_MOMENTS = 14;
constexpr int slanted_sums(int channels) { return SLANTED_MOMENTS + channels + 2; }

// `input.channel_count` is SLANTED_SHAPE and the channels of a walk, and `image.sums` has those channels.
void slanted(const Input& input, const Image& image, Workers& workers, Scratch& scratch, int64_t max_pairs);

// `sums`: `slanted_sums` floats for each splat; the last two are zeros unless `pulled`, which needs GROUP channels.
// `binned`: as in `rasterize_gradient`.
void slanted_gradient(const Input& input, const Cotangents& cotangents, bool pulled, float* sums, Workers& workers,
                      Scratch& scratch, bool binned, int64_t max_pairs);

}  // namespace splatax
