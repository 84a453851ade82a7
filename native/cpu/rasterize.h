// The two operations of the library: the image, and its gradient.
#pragma once

#include "binning.h"
#include "parallel.h"
#include "splats.h"

namespace splatax {

struct Image {
  float* sums;   // [height width channel_count]
  float* alpha;  // [height width]
};

struct Cotangents {
  const float* sums;     // the image itself, which the gradient starts from
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
  float* pull;  // [count 2]: sums over pixels of |dL / d means2d|; null if nobody asks. Up to GROUP channels
};

// Memory of a call, kept for the next one.
struct Scratch {
  int32_t ticket = 0;  // of the call of `rasterize` whose splats and lists are in it; 0 for none
  bool expected = false;  // whether the gradient of that call is yet to come
  Binning binning;
  Buffer<unsigned char> states;
  Buffer<float> partial_sums;
  Buffer<uint8_t> flags;
  Buffer<float> derivatives;  // of `photometric`
};

void rasterize(const Input& input, const Image& image, Workers& workers, Scratch& scratch, int64_t max_pairs);

// `binned`: whether the scratch memory is as `rasterize` of the same input has left it.
void rasterize_gradient(const Input& input, const Cotangents& cotangents, const Gradients& gradients,
                        Workers& workers, Scratch& scratch, bool binned, int64_t max_pairs);

}  // namespace splatax
