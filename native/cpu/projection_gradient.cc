#include <type_traits>
#include <vector>

#include "gathered.h"
#include "pull_back.h"

namespace splatax {
namespace {

constexpr int SHORT = 256;  // Gaussians whose parts of the camera's gradient are summed in single precision
static_assert(PART % SHORT == 0);

// Gradients of one part of the Gaussians, summed over views in order.
class PartSum {
 public:
  PartSum(int part, int total, int coefficients)
      : first_(part * PART), rows_(std::min(PART, total - first_)), columns_{3, 4, 3, 1, 3 * coefficients} {
    for (int field = 0; field < FIELDS; ++field) {
      own_[field].resize(static_cast<size_t>(rows_) * columns_[field]);
      sum_[field].resize(own_[field].size());
    }
  }

  // Arrays to which a view writes; their row 0 would be the first Gaussian of all.
  GaussianGradients of_one_view() {
    const auto at = [&](int field) { return own_[field].data() - static_cast<ptrdiff_t>(first_) * columns_[field]; };
    return {at(0), at(1), at(2), at(3), at(4), nullptr};
  }
  void add(int view) {
    for (int field = 0; field < FIELDS; ++field) {
      if (view == 0) {
        sum_[field].swap(own_[field]);
      } else {
        for (size_t i = 0; i < own_[field].size(); ++i) sum_[field][i] += own_[field][i];
      }
    }
  }
  void write(const GaussianGradients& to) const {
    float* const arrays[FIELDS] = {to.means, to.quats, to.log_scales, to.opacity_logits, to.sh};
    for (int field = 0; field < FIELDS; ++field) {
      std::copy(sum_[field].begin(), sum_[field].end(), arrays[field] + static_cast<ptrdiff_t>(first_) * columns_[field]);
    }
  }

 private:
  static constexpr int FIELDS = 5;
  const int first_, rows_;
  const int columns_[FIELDS];
  std::vector<float> own_[FIELDS], sum_[FIELDS];
};

// Sets the gradients of some rows to zero.
void clear(const GaussianGradients& to, int first, int count, int coefficients) {
  const auto rows = [&](float* array, int columns) {
    std::fill_n(array + static_cast<ptrdiff_t>(first) * columns, static_cast<ptrdiff_t>(count) * columns, 0.0f);
  };
  rows(to.means, 3);
  rows(to.quats, 4);
  rows(to.log_scales, 3);
  rows(to.opacity_logits, 1);
  rows(to.sh, 3 * coefficients);
}

// Rows of a view that it shows.
struct Shown {
  int count = 0;
  int32_t rows[SHORT];

  Shown(const ProjectedCotangents& cotangents, int first, int many) {
    for (int row = first; row < first + many; ++row) {
      rows[count] = row;
      count += cotangents.extents[2 * static_cast<size_t>(row)] > 0;
    }
  }
};

// Gradients of up to SHORT Gaussians of a view. Those that the view shows are computed sixteen at a time, wherever
// they are; those of the others are not written.
template <class Lens>
void pull_back_shown(const Pass& pass, const Shown& shown, CameraGradient<Lens::FIELDS>& camera) {
  const int found = shown.count;
  const int32_t* seen = shown.rows;
  for (int at = 0; at < found; at += LANES) {
    const int number = std::min(LANES, found - at);
    if (seen[at + number - 1] == seen[at] + number - 1) {  // one after another
      PullBack<Lens>(pass, seen[at], number).run(camera);
      continue;
    }
    Gathered16 own(pass.gaussians, pass.cotangents, seen + at, number);
    const Gaussians gaussians = own.gaussians();
    const ProjectedCotangents cotangents = own.cotangents();
    const GaussianGradients gradients = own.gradients();
    PullBack<Lens>({gaussians, pass.view, cotangents, gradients}, 0, number).run(camera);
    own.scatter(pass.gradients);
  }
}

// Gradients of Gaussians [first, end) of a view; adds the camera's to sums.
template <class Lens>
void pull_back(const Pass& pass, int first, int end, double* camera_sums) {
  CameraGradient<Lens::FIELDS> camera;
  for (; first < end; first += SHORT) {
    const int count = std::min(SHORT, end - first);
    const Shown shown(pass.cotangents, first, count);
    if (shown.count < count) clear(pass.gradients, first, count, pass.gaussians.coefficients);
    pull_back_shown<Lens>(pass, shown, camera);
    camera.move_to(camera_sums);
  }
}

// Writes the sums over all parts of a camera's gradient, `fields` numbers for each part.
void write_sums(const double* sums, int parts, int fields, float* camera) {
  for (int field = 0; field < fields; ++field) {
    double value = 0;
    for (int part = 0; part < parts; ++part) value += sums[static_cast<size_t>(part) * fields + field];
    camera[field] = static_cast<float>(value);
  }
}

}  // namespace

void pull_back_rows(const PulledBackView& job, double camera[CAMERA_FIELDS]) {
  CameraGradient<Pinhole::FIELDS> sums;
  for (int first = 0; first < job.gaussians.count; first += LANES) {
    PullBack<Pinhole>({job.gaussians, job.view, job.cotangents, job.gradients}, first, std::min(LANES, job.gaussians.count - first))
        .run(sums);
  }
  sums.move_to(camera);
}

void project_gradient(int views, bool summed, Workers& workers, const std::function<PulledBackView(int)>& view_of) {
  if (views == 0) return;
  const PulledBackView one = view_of(0);
  const int total = one.gaussians.count, parts = parts_of(total), fields = camera_fields(one.view.lens);
  // The size of parts does not depend on the number of threads, so their sum does not either.
  std::vector<double> sums(static_cast<size_t>(views) * parts * fields, 0.0);
  const auto pull = [&](const Pass& pass, int view, int part) {
    double* camera_sums = &sums[(static_cast<size_t>(view) * parts + part) * fields];
    with_lens(pass.view.lens, [&](auto* chosen) {
      pull_back<std::remove_pointer_t<decltype(chosen)>>(pass, part * PART, std::min((part + 1) * PART, total), camera_sums);
    });
  };
  if (summed) {
    workers.each(parts, [&](int part) {
      PartSum sum(part, total, one.gaussians.coefficients);
      for (int view = 0; view < views; ++view) {
        const PulledBackView job = view_of(view);
        const GaussianGradients own = sum.of_one_view();
        pull({job.gaussians, job.view, job.cotangents, own}, view, part);
        sum.add(view);
      }
      sum.write(one.gradients);
    });
  } else {
    workers.each(views * parts, [&](int task) {
      const PulledBackView job = view_of(task / parts);
      pull({job.gaussians, job.view, job.cotangents, job.gradients}, task / parts, task % parts);
    });
  }
  for (int view = 0; view < views; ++view) {
    write_sums(&sums[static_cast<size_t>(view) * parts * fields], parts, fields, view_of(view).gradients.camera);
  }
}

GradientByRows::GradientByRows(const Gaussians& gaussians, const View& view, const ProjectedCotangents& cotangents)
    : gaussians_(gaussians), view_(view), cotangents_(cotangents), fields_(camera_fields(view.lens)) {
  sums_.assign(static_cast<size_t>(parts_of(gaussians.count)) * fields_, 0.0);
}

int GradientByRows::find(int first, int count, const GaussianGradients& to, uint8_t* seen) {
  const Shown shown(cotangents_, first, count);
  std::fill_n(seen, count, uint8_t{0});
  for (int i = 0; i < shown.count; ++i) seen[shown.rows[i] - first] = 1;
  if (shown.count < count) clear(to, first, count, gaussians_.coefficients);
  with_lens(view_.lens, [&](auto* chosen) {
    using Lens = std::remove_pointer_t<decltype(chosen)>;
    CameraGradient<Lens::FIELDS> camera;
    pull_back_shown<Lens>({gaussians_, view_, cotangents_, to}, shown, camera);
    camera.move_to(&sums_[first / PART * fields_]);
  });
  return shown.count;
}

void GradientByRows::write_camera(float* camera) const {
  write_sums(sums_.data(), parts_of(gaussians_.count), fields_, camera);
}

}  // namespace splatax
