// The loss between an image and a photo, (1 - w) L1 + w (1 - SSIM), and its gradient in one go.
#pragma once

#include "parallel.h"

namespace splatax {

struct Pictures {
  const float* image;  // [height width channels]
  const float* photo;
  int height, width, channels;
};

// As `Photometric` in splatax/losses.py. Returns the loss; `gradient` is dL / d image.
float photometric(const Pictures& pictures, float ssim_weight, float* gradient, float* scratch,
                  Workers& workers);

// Floats that `photometric` wants as scratch.
size_t photometric_scratch(const Pictures& pictures);

}  // namespace splatax
