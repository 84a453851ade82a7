// Operations of the rasterizer: the image, and its gradient.
#pragma once

#include <memory>
#include <vector>

#include "binning.h"
#include "parallel.h"
#include "splats.h"

namespace splatax {

constexpr int NARROW_WALK = 16, WIDE_WALK = 64;  // channels of one walk over the splats

struct Image {
  float* sums;   // [height width channel_count]
  float* alpha;  // [height width]
};

struct Cotangents {
  const float* sums;     // the image, from which the gradient starts
  const float* alpha;
  const float* d_sums;   // dL / d of it
  const float* d_alpha;
};

// dL / d of the inputs of the same names.
struct Gradients {
  float* means2d;
  float* sqrt_conics;
  float* opacities;
  float* channels;
  float* pull;  // [count 2]: sums over pixels of |dL / d means2d|; null if not requested. Up to NARROW_WALK channels
};

// Memory of a call, which is kept for the next one.
struct Scratch {
  int32_t ticket = 0;  // of the call of `rasterize` whose splats and lists it holds; 0 for none
  bool expected = false;  // true until the gradient of that call arrives
  Binning binning;
  Buffer<unsigned char> states;
  Buffer<float> partial_sums;
  Buffer<uint8_t> flags;
  Buffer<float> derivatives;  // of `photometric`
  std::vector<std::unique_ptr<Scratch>> threads;  // one for each thread that draws a view of a batch by itself
};

void rasterize(const Input& input, const Image& image, Workers& workers, Scratch& scratch, int64_t max_pairs);

// `binned`: true if the scratch memory still holds the lists of `rasterize` for the same input.
void rasterize_gradient(const Input& input, const Cotangents& cotangents, const Gradients& gradients,
                        Workers& workers, Scratch& scratch, bool binned, int64_t max_pairs);

}  // namespace splatax
