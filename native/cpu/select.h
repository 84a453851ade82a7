// The splats that decide a pixel: those with the largest weights, and the one that makes it half opaque.
#pragma once

#include "rasterize.h"

namespace splatax {

constexpr int MOST_SELECTED = 64;
constexpr int MOST_SELECTABLE = 1 << 29;  // rows; see `marked`

struct Selection {
  int32_t* rows;     // [height width count]: largest weight first, equal weights nearest first; -1 for none
  float* weights;    // [height width count]
  int32_t* median;   // [height width]: first row after which transmittance is at most 1/2; -1 for none
  int count;         // up to MOST_SELECTED
};

void select(const Input& input, const Selection& selection, Workers& workers, Scratch& scratch, int64_t max_pairs);

}  // namespace splatax
