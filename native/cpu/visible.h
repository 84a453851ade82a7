// The Gaussians that a camera may see, and their splats: rows of a scene in rising order, without the others.
//
// A batch of views of one scene is drawn from these, view by view, so that its splats never fill arrays of as many rows
// as the scene has for each view, and stay in the caches of the thread that draws them.
#pragma once

#include <algorithm>
#include <cstdint>

#include "buffer.h"
#include "parallel.h"
#include "projection.h"

namespace splatax {

// Bounds of all Gaussians of a scene, which do not depend on the view.
struct Bounds {
  Buffer<float> x, y, z;   // means
  Buffer<float> reach;     // squared distance in standard deviations from which alpha is under 1/255; below 0 for none
  Buffer<float> spread;    // reach times the largest variance

  void fill(const Gaussians& gaussians, Workers& workers);
};

// A scene is searched part by part, so that a part is in the caches while several views are searched for it.
constexpr int ROWS_OF_PART = 1024;
inline int parts_of_scene(int count) { return (count + ROWS_OF_PART - 1) / ROWS_OF_PART; }

// Splats of one view; `count` rows, of which the projection has culled some (extent 0).
struct Visible {
  int count = 0;
  Buffer<int32_t> rows;
  Buffer<float> means2d, sqrt_conics, depths, extents, colors, opacities;
  Buffer<float> distances;  // of the means from the camera
  Buffer<float> channels;   // colors and depths side by side

  // Finds the rows whose sphere may reach into the image, and projects them.
  void collect(const Gaussians& gaussians, const Bounds& bounds, const View& view, Workers& workers);

  void make_room(int rows_at_most);
  // Appends and projects the rows of a part of the scene.
  void append(const Gaussians& gaussians, const Bounds& bounds, const View& view, int part);

 private:
  void project(const Gaussians& gaussians, const View& view, int begin, int end);

  Buffer<int32_t> found_;  // numbers of rows that parts have found
};

// dL / d of the splats of one view.
struct SplatGradients {
  int count = 0;
  Buffer<int32_t> rows;  // of the scene, rising
  Buffer<float> means2d, sqrt_conics, opacities, colors, depths;
};

// The Gaussians of a scene that have these numbers; nothing is copied.
inline Gaussians gaussians_at(const Gaussians& scene, const int32_t* rows, int count) {
  Gaussians some = scene;
  some.rows = rows;
  some.count = count;
  return some;
}

// Prefetches the rows into the caches.
inline void prefetch(const Gaussians& from, const int32_t* rows, int count) {
  constexpr size_t LINE = 16;  // floats
  const size_t numbers = 3 * static_cast<size_t>(from.coefficients);
  for (int i = 0; i < count; ++i) {
    const size_t row = rows[i];
    __builtin_prefetch(from.means + 3 * row);
    __builtin_prefetch(from.quats + 4 * row);
    __builtin_prefetch(from.log_scales + 3 * row);
    __builtin_prefetch(from.opacity_logits + row);
    const float* sh = from.sh + numbers * row;
    for (size_t k = 0; k < numbers; k += LINE) __builtin_prefetch(sh + k);
    __builtin_prefetch(sh + numbers - 1);  // rows may begin inside a line
  }
}

}  // namespace splatax
