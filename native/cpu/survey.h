// The image together with what label and depth cameras need, in one walk over the splats of each tile: the sums of the
// weights of each part of the scene, and the splat that makes each pixel half opaque.
#pragma once

#include "rasterize.h"

namespace splatax {

constexpr int MOST_PARTS = 32;  // whose sums a tile has room for

struct Survey {
  Image image;              // of at most GROUP channels
  float* parts;             // [height width part_count]: sums of weights
  int32_t* median;          // [height width]: as that of `Selection`
  const uint8_t* part_of;   // [count]: part of each row of the input
  int part_count;           // up to MOST_PARTS; 0 for no sums of parts
};

void survey(const Input& input, const Survey& results, Workers& workers, Scratch& scratch, int64_t max_pairs);

}  // namespace splatax
