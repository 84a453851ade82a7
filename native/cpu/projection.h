// EWA projection of sixteen Gaussians at a time, as in splatax/projection.py, and its gradient.
#pragma once

#include "parallel.h"

namespace splatax {

struct Gaussians {
  const float* means;           // [count 3]
  const float* quats;           // [count 4]
  const float* log_scales;      // [count 3]
  const float* opacity_logits;  // [count]
  const float* sh;              // [count coefficients 3]
  int count, coefficients;
};

// Numbers of a camera; their gradients have the same layout.
enum CameraField { FX, FY, CX, CY, ROTATION, TRANSLATION = ROTATION + 9, POSITION = TRANSLATION + 3,
                   CAMERA_FIELDS = POSITION + 3 };

struct View {
  const float* camera;  // [CAMERA_FIELDS]; rotation row by row
  int width, height;
  float variance;    // variance of the low-pass filter, pixels^2
  bool fades;        // true if the low-pass filter multiplies opacity by a factor,
  float least_fade;  // which is at least this
};

// Rows of `Splats`.
struct Projected {
  float *means2d, *sqrt_conics, *depths, *extents, *colors, *opacities;
};

// dL / d of the fields that have a gradient.
struct ProjectedCotangents {
  const float *means2d, *sqrt_conics, *depths, *colors, *opacities;
  const float* extents;  // extents of the forward pass: zero where culled
};

struct GaussianGradients {
  float *means, *quats, *log_scales, *opacity_logits, *sh, *camera;
};

// Inputs and outputs of one view of a batch.
struct ProjectedView {
  Gaussians gaussians;
  View view;
  Projected splats;
};
struct PulledBackView {
  Gaussians gaussians;
  View view;
  ProjectedCotangents cotangents;
  GaussianGradients gradients;
};

// Projects to all views of a batch. All have the same number of Gaussians.
void project(int views, Workers& workers, const std::function<ProjectedView(int)>& view_of);

// Projects up to sixteen Gaussians to one view.
void project_rows(const Gaussians& gaussians, const View& view, const Projected& splats);

// Pulls back the gradient of the splats of one view, and adds the camera's to `camera`.
void pull_back_rows(const PulledBackView& job, double camera[CAMERA_FIELDS]);

// `summed`: the views share one scene, and its gradients are summed over them.
void project_gradient(int views, bool summed, Workers& workers, const std::function<PulledBackView(int)>& view_of);

}  // namespace splatax
