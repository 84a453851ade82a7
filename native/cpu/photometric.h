// Loss between an image and a photo, (1 - w) L1 + w (1 - SSIM), computed together with its gradient.
#pragma once

#include "parallel.h"

namespace splatax {

struct Pictures {
  const float* image;  // [height width channels]
  const float* photo;
  int height, width, channels;
};

// Computes the loss of `Photometric` in splatax/losses.py, and returns it; `gradient` is dL / d image.
float photometric(const Pictures& pictures, float ssim_weight, float* gradient, float* scratch,
                  Workers& workers);

// Number of floats that `photometric` needs as scratch memory.
size_t photometric_scratch(const Pictures& pictures);

}  // namespace splatax
