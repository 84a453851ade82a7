// The rasterizer and its gradient. Splats are sorted by depth once; their (splat, tile) pairs are listed in one
// round if they fit into the lists, else in several. Blending carries its state from round to round, so memory is
// bounded and no pair is dropped.
//
// The work of one round is queued before the host knows the number of pairs, and does nothing if they do not fit.
// So the GPU does not wait for the host, except where there are several rounds.
#pragma once

#include "work.h"

namespace splatax::cuda {

// Sizes of the lists that the gradient takes over from the image; splatax/backends/cuda/composite.py computes the
// same.
struct Sizes {
  int count, tiles, capacity;  // splats, tiles, pairs in a round

  Sizes(const SplatRows& splats, const Frame& frame, int64_t max_pairs);
  size_t words() const;   // of DepthOrder and TileLists without checkpoints
  size_t chunks() const;  // most that a round can have
};

Frame frame_of(int width, int height);

// Lists in words and floats that the caller provides; no checkpoints if those are null.
struct Lists {
  DepthOrder by_depth;
  TileLists tiles;

  Lists(const Sizes& sizes, uint32_t* words, float* checkpoints);
};

void rasterize(Work& work, const SplatRows& splats, const Frame& frame, const Sizes& sizes, const Lists& lists,
               const Image& image);

// `lists` are those of the image, with checkpoints.
void rasterize_gradient(Work& work, const SplatRows& splats, const Frame& frame, const Sizes& sizes,
                        const Lists& lists, const ImageGradient& image, const SplatGradients& gradients);

}  // namespace splatax::cuda
