// Forward mode of the rasterizer: the derivative of the image along up to six directions in one walk.
#pragma once

#include "rasterize.h"

namespace splatax {

constexpr int MOST_DIRECTIONS = 6;  // of one walk: those of a camera's pose

// A direction in the inputs of the same names, and where the image's derivative along it goes: to [h w channels spacing] and
// [h w spacing], in which `number` is its place along the last axis.
struct Direction2d {
  const float *means2d, *sqrt_conics, *opacities, *channels;
  float *sums, *alpha;
  int number, spacing;
};

// Writes the derivatives along `count` directions, at most MOST_DIRECTIONS.
void rasterize_tangent(const Input& input, const Direction2d* directions, int count, Workers& workers, Scratch& scratch,
                       int64_t max_pairs);

}  // namespace splatax
