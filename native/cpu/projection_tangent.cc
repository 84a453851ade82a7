#include <type_traits>
#include <vector>

#include "projection_lanes.h"

namespace splatax {
namespace {

constexpr float STILL[96] = {};  // the tangent of a camera that does not move
static_assert(OpenCV::FIELDS <= 96 && Fisheye::FIELDS <= 96);

SPLATAX_INLINE Vector operator-(const Vector& a, const Vector& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
SPLATAX_INLINE Vector three(const float* numbers) {
  return {broadcast(numbers[0]), broadcast(numbers[1]), broadcast(numbers[2])};
}
SPLATAX_INLINE Vector rows_or_zero(const float* rows, size_t row, int count) {
  return rows == nullptr ? Vector{broadcast(0), broadcast(0), broadcast(0)} : read_vectors(rows + 3 * row, count);
}

// Colours of sixteen Gaussians, and their derivatives by the unit vector to each.
struct Colors {
  Direction direction;
  Lanes basis[MAX_COEFFICIENTS];
  Vector value, by_unit[3];  // columns

  Colors(const Vector& mean, const Gaussians& gaussians, const View& view, int first, int count) : direction(mean, view) {
    const Vector& unit = direction.unit;
    const Lanes zero = broadcast(0), one = broadcast(1), half = broadcast(0.5f);
    Dual<3> duals[MAX_COEFFICIENTS];
    harmonics<Dual<3>>({unit.x, {one, zero, zero}}, {unit.y, {zero, one, zero}}, {unit.z, {zero, zero, one}},
                       gaussians.coefficients, duals);
    Columns<3 * MAX_COEFFICIENTS> sh;
    read_fields(sh, gaussians, gaussians.sh, 3 * gaussians.coefficients, first, count);
    value = {half, half, half};
    for (Vector& column : by_unit) column = {zero, zero, zero};
    for (int k = 0; k < gaussians.coefficients; ++k) {
      const Vector coefficients = sh.vector(3 * k);
      basis[k] = duals[k].value;
      value = value + basis[k] * coefficients;
      for (int axis = 0; axis < 3; ++axis) by_unit[axis] = by_unit[axis] + duals[k].d[axis] * coefficients;
    }
  }
};

// Forward mode of sixteen Gaussians of a view, along one direction after another.
template <class Lens>
class Push {
 public:
  Push(const PushedView& job, int first, int count)
      : job_(job),
        row_(first),
        count_(count),
        p_(job.gaussians, job.view, first, count),
        colors_(p_.means.world, job.gaussians, job.view, first, count) {
    const Lanes extent = Columns<2>(job.extents + 2 * row_, 2, count)[0];
    seen_ = p_.usable & (broadcast(0) < extent);
  }

  // The chain rule forwards through `Projection`, with the names of `PullBack::run`.
  void along(const Direction3d& to) const {
    const float* d_camera = to.camera == nullptr ? STILL : to.camera;
    const Matrix d_rotation = rotation_of(d_camera);
    const Vector d_mean = or_zero(seen_, rows_or_zero(to.means, row_, count_));
    const Vector d_point = p_.means.rotation * d_mean + d_rotation * p_.means.world + three(d_camera + TRANSLATION);
    const ImageOfPoint image = p_.lens.push(d_point, d_camera);

    Matrix d_factor, d_oriented;
    if (to.quats != nullptr || to.log_scales != nullptr) orient(to, d_oriented);
    for (int k = 0; k < 3; ++k) {
      d_factor.column[k] = d_rotation * p_.oriented.column[k];
      if (to.quats != nullptr || to.log_scales != nullptr) {
        d_factor.column[k] = d_factor.column[k] + p_.means.rotation * d_oriented.column[k];
      }
    }
    const Vector d_f = transposed_times(d_factor, p_.lens.jacobian[0]) + transposed_times(p_.factor, image.jacobian[0]);
    const Vector d_g = transposed_times(d_factor, p_.lens.jacobian[1]) + transposed_times(p_.factor, image.jacobian[1]);
    const Lanes d_a = 2.0f * dot(p_.f, d_f), d_b = dot(d_f, p_.g) + dot(p_.f, d_g), d_c = 2.0f * dot(p_.g, d_g);
    const Lanes d_sharp = 2.0f * dot(p_.normal, cross(d_f, p_.g) + cross(p_.f, d_g));
    const Lanes d_determinant = d_sharp + job_.view.variance * (d_a + d_c);

    const Lanes u = sqrt(p_.c / p_.determinant), v = -(p_.b * u) / p_.c, w = broadcast(1) / sqrt(p_.c);
    const Lanes c_rate = d_c / p_.c, rate = d_determinant / p_.determinant;
    const Lanes d_u = 0.5f * u * (c_rate - rate);
    const Lanes d_v = -(d_b * u + p_.b * d_u) / p_.c - v * c_rate;

    Lanes d_opacity = broadcast(0);
    if (to.opacity_logits != nullptr) {
      d_opacity = p_.opacity * (1 - p_.own_opacity) * read_numbers(to.opacity_logits + row_, count_);
    }
    if (job_.view.fades) {
      const Mask fading = broadcast(job_.view.least_fade) < p_.fade;
      d_opacity += or_zero(fading, 0.5f * p_.opacity * (d_sharp / where(fading, p_.sharp, broadcast(1)) - rate));
    }
    write_pairs(or_zero(seen_, image.x), or_zero(seen_, image.y), to.means2d + 2 * row_, count_);
    write_vectors(or_zero(seen_, Vector{d_u, d_v, -0.5f * (w * c_rate)}), to.sqrt_conics + 3 * row_, count_);
    write_numbers(or_zero(seen_, image.depth), to.depths + row_, count_);
    write_numbers(or_zero(seen_, d_opacity), to.opacities + row_, count_);
    color(to, d_mean - three(d_camera + POSITION));
  }

 private:
  static SPLATAX_INLINE Matrix rotation_of(const float* camera) {
    Matrix result;
    for (int k = 0; k < 3; ++k) {
      const float* column = camera + ROTATION + k;
      result.column[k] = {broadcast(column[0]), broadcast(column[3]), broadcast(column[6])};
    }
    return result;
  }

  // Tangents of R(q) S. A unit quaternion that moves by dq turns about the axis omega = 2 Im(q* dq), in its own axes.
  SPLATAX_INLINE void orient(const Direction3d& to, Matrix& d_oriented) const {
    Vector omega{broadcast(0), broadcast(0), broadcast(0)};
    if (to.quats != nullptr) {
      const Columns<4> d(to.quats + 4 * row_, 4, count_);
      const Mask turned = broadcast(0) < p_.quat_length;
      const Lanes twice = or_zero(turned, broadcast(2) / where(turned, p_.quat_length, broadcast(1)));
      const Lanes w = p_.quat[0], x = p_.quat[1], y = p_.quat[2], z = p_.quat[3];
      omega = twice * Vector{w * d[1] - x * d[0] - y * d[3] + z * d[2], w * d[2] - y * d[0] - z * d[1] + x * d[3],
                             w * d[3] - z * d[0] - x * d[2] + y * d[1]};
    }
    const Vector rates = rows_or_zero(to.log_scales, row_, count_);
    const Lanes rate[3] = {rates.x, rates.y, rates.z};
    const Vector* axes = p_.turn.column;
    const Vector turned[3] = {omega.z * axes[1] - omega.y * axes[2], omega.x * axes[2] - omega.z * axes[0],
                              omega.y * axes[0] - omega.x * axes[1]};
    for (int k = 0; k < 3; ++k) {
      const Lanes growth = where(p_.scale_clamped[k], broadcast(0), rate[k]);
      d_oriented.column[k] = or_zero(p_.usable, p_.scale[k] * (turned[k] + growth * axes[k]));
    }
  }

  SPLATAX_INLINE void color(const Direction3d& to, const Vector& d_offset) const {
    const Vector& unit = colors_.direction.unit;
    const Vector d_unit = colors_.direction.inverse_length * (d_offset - dot(unit, d_offset) * unit);
    Vector d = d_unit.x * colors_.by_unit[0] + d_unit.y * colors_.by_unit[1] + d_unit.z * colors_.by_unit[2];
    if (to.sh != nullptr) {
      const int coefficients = job_.gaussians.coefficients;
      const Columns<3 * MAX_COEFFICIENTS> d_sh(to.sh + row_ * 3 * coefficients, 3 * coefficients, count_);
      for (int k = 0; k < coefficients; ++k) d = d + colors_.basis[k] * d_sh.vector(3 * k);
    }
    const Lanes zero = broadcast(0);  // a colour that is clamped to zero stays
    write_vectors({or_zero(seen_ & (zero < colors_.value.x), d.x), or_zero(seen_ & (zero < colors_.value.y), d.y),
                   or_zero(seen_ & (zero < colors_.value.z), d.z)},
                  to.colors + 3 * row_, count_);
  }

  const PushedView& job_;
  const size_t row_;
  const int count_;
  const Projection<Lens> p_;
  const Colors colors_;
  Mask seen_;
};

}  // namespace

void project_tangents(const std::vector<PushedView>& views, Workers& workers) {
  if (views.empty()) return;
  const int total = views[0].gaussians.count, parts = parts_of(total);
  with_lens(views[0].view.lens, [&](auto* chosen) {
    using Lens = std::remove_pointer_t<decltype(chosen)>;
    workers.each(static_cast<int>(views.size()) * parts, [&](int task) {
      const PushedView& job = views[task / parts];
      each_lanes(task % parts, total, [&](int first, int count) {
        const Push<Lens> push(job, first, count);
        for (const Direction3d& direction : job.directions) push.along(direction);
      });
    });
  });
}

}  // namespace splatax
