// Sixteen Gaussians from anywhere in a scene, with the cotangents of their splats, copied so that they are one after
// another, and room for their gradients.
#pragma once

#include <algorithm>
#include <cstdint>

#include "harmonics.h"
#include "lanes.h"
#include "projection.h"

namespace splatax {

class Gathered16 {
 public:
  Gathered16(const Gaussians& scene, const ProjectedCotangents& from, const int32_t* rows, int count)
      : rows_(rows), count_(count), coefficients_(scene.coefficients) {
    const size_t numbers = 3 * static_cast<size_t>(coefficients_);
    for (int i = 0; i < count; ++i) {
      const size_t row = rows[i];
      std::copy_n(scene.means + 3 * row, 3, means_ + 3 * i), std::copy_n(scene.quats + 4 * row, 4, quats_ + 4 * i);
      std::copy_n(scene.log_scales + 3 * row, 3, log_scales_ + 3 * i);
      opacity_logits_[i] = scene.opacity_logits[row];
      std::copy_n(scene.sh + numbers * row, numbers, sh_ + numbers * i);
      std::copy_n(from.means2d + 2 * row, 2, d_means2d_ + 2 * i);
      std::copy_n(from.sqrt_conics + 3 * row, 3, d_sqrt_conics_ + 3 * i);
      std::copy_n(from.colors + 3 * row, 3, d_colors_ + 3 * i);
      std::copy_n(from.extents + 2 * row, 2, extents_ + 2 * i);
      d_depths_[i] = from.depths[row];
      d_opacities_[i] = from.opacities[row];
    }
  }

  Gaussians gaussians() const { return {means_, quats_, log_scales_, opacity_logits_, sh_, count_, coefficients_}; }
  ProjectedCotangents cotangents() const {
    return {d_means2d_, d_sqrt_conics_, d_depths_, d_colors_, d_opacities_, extents_};
  }
  // Where the gradients go. They take the place of what was copied.
  GaussianGradients gradients() { return {means_, quats_, log_scales_, opacity_logits_, sh_, nullptr}; }

  // Writes the gradients to their rows.
  void scatter(const GaussianGradients& to) const {
    const size_t numbers = 3 * static_cast<size_t>(coefficients_);
    for (int i = 0; i < count_; ++i) {
      const ptrdiff_t row = rows_[i];
      std::copy_n(means_ + 3 * i, 3, to.means + 3 * row), std::copy_n(quats_ + 4 * i, 4, to.quats + 4 * row);
      std::copy_n(log_scales_ + 3 * i, 3, to.log_scales + 3 * row);
      to.opacity_logits[row] = opacity_logits_[i];
      std::copy_n(sh_ + numbers * i, numbers, to.sh + static_cast<ptrdiff_t>(numbers) * row);
    }
  }

 private:
  const int32_t* rows_;
  const int count_, coefficients_;
  alignas(64) float means_[3 * LANES], quats_[4 * LANES], log_scales_[3 * LANES], opacity_logits_[LANES];
  alignas(64) float sh_[3 * MAX_COEFFICIENTS * LANES];
  alignas(64) float d_means2d_[2 * LANES], d_sqrt_conics_[3 * LANES], d_depths_[LANES], d_colors_[3 * LANES];
  alignas(64) float d_opacities_[LANES], extents_[2 * LANES];
};

}  // namespace splatax
