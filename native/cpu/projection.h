// EWA projection of sixteen Gaussians at a time, as in splatax/projection.py, its gradient and its tangents.
#pragma once

#include <cstdint>
#include <vector>

#include "parallel.h"

namespace splatax {

constexpr int MAX_COEFFICIENTS = 25;  // of spherical harmonics: degree 4

struct Gaussians {
  const float* means;           // [count 3]
  const float* quats;           // [count 4]
  const float* log_scales;      // [count 3]
  const float* opacity_logits;  // [count]
  const float* sh;              // [count coefficients 3]
  int count, coefficients;
  const int32_t* rows = nullptr;  // the rows of the arrays that are meant, by number; null for all in order
};

// Numbers of a camera, before those of its lens; their gradients have the same layout.
enum CameraField { FX, FY, CX, CY, ROTATION, TRANSLATION = ROTATION + 9, POSITION = TRANSLATION + 3,
                   CAMERA_FIELDS = POSITION + 3 };

// Lenses that have a kernel, in the order of `LENSES` in splatax/backends/cpu/projection.py.
enum class LensKind { PINHOLE, OPENCV, FISHEYE, COUNT };
// Numbers of a camera with such a lens.
int camera_fields(LensKind lens);

struct View {
  const float* camera;  // [camera_fields(lens)]; rotation row by row
  LensKind lens;
  float width, height;  // pixels; of its frame, if the view fills only a part of the image
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

// Direction in the inputs of the same names, null where they stay, and where the splats' derivatives go.
struct Direction3d {
  const float *means, *quats, *log_scales, *opacity_logits, *sh, *camera;
  float *means2d, *sqrt_conics, *depths, *colors, *opacities;
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
struct PushedView {
  Gaussians gaussians;
  View view;
  const float* extents;  // of the forward pass: the derivatives of culled splats are zero
  std::vector<Direction3d> directions;
};

// Projects to all views of a batch. All have the same number of Gaussians, and the same lens.
void project(int views, Workers& workers, const std::function<ProjectedView(int)>& view_of);

// Projects up to sixteen Gaussians, from `first` on, to one view through a pinhole.
void project_rows(const Gaussians& gaussians, const View& view, const Projected& splats, int first, int count);

// Pulls back the gradient of the splats of one view through a pinhole, and adds the camera's to `camera`.
void pull_back_rows(const PulledBackView& job, double camera[CAMERA_FIELDS]);

// `summed`: the views share one scene, and its gradients are summed over them.
void project_gradient(int views, bool summed, Workers& workers, const std::function<PulledBackView(int)>& view_of);

// The gradient of the splats of one view, pulled back row by row, so that nobody has to keep that of the whole scene.
class GradientByRows {
 public:
  // The arrays must outlive the object.
  GradientByRows(const Gaussians& gaussians, const View& view, const ProjectedCotangents& cotangents);

  // Writes the gradients of up to 256 rows, and tells which of them the view shows: the others have none. Row 0 of the
  // gradients would be the first Gaussian of all. Returns the number of rows that are shown. The rows of each 4,096 are asked
  // for by one thread, once each, in their order and in multiples of 256.
  int find(int first, int count, const GaussianGradients& to, uint8_t* seen);
  // Writes the gradient of the camera, when all rows are found.
  void write_camera(float* camera) const;

 private:
  const Gaussians gaussians_;
  const View view_;
  const ProjectedCotangents cotangents_;
  const int fields_;
  std::vector<double> sums_;  // of the camera's gradient, for each 4,096 rows
};

// Derivatives along any number of directions, which share what they have in common.
void project_tangents(const std::vector<PushedView>& views, Workers& workers);

}  // namespace splatax
