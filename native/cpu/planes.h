// Planes of Gaussians in one view, as in splatax/surfaces.py: slopes of inverse depth, normals and shortest axes, sixteen
// rows at a time. Each row depends on itself alone.
#pragma once

#include "parallel.h"

namespace splatax {

// Numbers of the rows of a view. They are those of the inputs, of their gradients, or of their tangents.
template <class Number>
struct PlaneRows {
  Number* places;       // [count 9]: how x, y and the inverse depth change with the point in the world
  Number* disparities;  // [count]: inverse depth
  Number* quats;        // [count 4]
  Number* log_scales;   // [count 3]
  Number* sqrt_conics;  // [count 3]
  Number* opacities;    // [count]
  Number* blurs;        // [count]: variances of splats that are drawn along rays; null for ellipses
};

template <class Number>
struct PlaneResults {
  Number* slopes;   // [count 2]
  Number* normals;  // [count 3]
  Number* axes;     // [count 3]
};

struct PlanesOfView {
  PlaneRows<const float> rows;
  const float* extents;  // [count 2]: zero where culled
  int count;
};

struct FoundPlanes {
  PlanesOfView of;
  PlaneResults<float> results;
};
struct PulledBackPlanes {
  PlanesOfView of;
  PlaneResults<const float> cotangents;
  PlaneRows<float> gradients;
};
struct PushedPlanes {
  PlanesOfView of;
  PlaneRows<const float> directions;
  PlaneResults<float> tangents;
};

// Each calls `job_of(view)` for each view of a batch. All have the same number of rows.
void find_planes(int views, Workers& workers, const std::function<FoundPlanes(int)>& job_of);
void pull_back_planes(int views, Workers& workers, const std::function<PulledBackPlanes(int)>& job_of);
void push_planes(int views, Workers& workers, const std::function<PushedPlanes(int)>& job_of);

}  // namespace splatax
