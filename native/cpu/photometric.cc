// SSIM (Wang et al. 2004) with moments in an 11 x 11 Gaussian window, zeros beyond the border:
//
//   S = A1 A2 / (B1 B2),   A1 = 2 mx my + C1,   B1 = mx^2 + my^2 + C1,
//                          A2 = 2 (xy - mx my) + C2,   B2 = xx - mx^2 + yy - my^2 + C2
//
// with blurred moments mx, my, xx, yy, xy. The window is symmetric, so blurring is its own adjoint:
//
//   dS/dx = blur(dS/dmx) + 2 x blur(dS/dxx) + y blur(dS/dxy) .
//
// Rows keep their channels interleaved: a row is blurred across as one long line, with neighbours
// `channels` floats apart. First down, from the rows around, then across, from a padded buffer.
#include "photometric.h"

#include <cmath>
#include <cstring>
#include <vector>

#include "lanes.h"

namespace splatax {
namespace {

constexpr int RADIUS = 5, WINDOW = 2 * RADIUS + 1;
constexpr double SIGMA = 1.5;
constexpr float C1 = 0.01f * 0.01f, C2 = 0.03f * 0.03f;
constexpr int DERIVATIVES = 3;  // dS/dmx, dS/dxx, dS/dxy
constexpr int MOMENTS = 5;      // mx, my, xx, yy, xy

struct Kernel {
  float weight[WINDOW];

  Kernel() {
    double total = 0, exact[WINDOW];
    for (int k = 0; k < WINDOW; ++k) total += exact[k] = std::exp(-(k - RADIUS) * (k - RADIUS) / (2 * SIGMA * SIGMA));
    for (int k = 0; k < WINDOW; ++k) weight[k] = static_cast<float>(exact[k] / total);
  }
};

// Number of floats in a row, and the number padded to whole vectors.
struct Line {
  int length, padded;

  explicit Line(const Pictures& pictures)
      : length(pictures.width * pictures.channels), padded((length + LANES - 1) / LANES * LANES) {}
};

// Up to sixteen floats; zeros past `count`.
SPLATAX_INLINE Lanes load_some(const float* from, int count) {
  if (count >= LANES) return load(from);
  alignas(64) float values[LANES] = {};
  std::memcpy(values, from, sizeof(float) * count);
  return load(values);
}
SPLATAX_INLINE void store_some(float* to, Lanes values, int count) {
  if (count >= LANES) return store(to, values);
  alignas(64) float each[LANES];
  store(each, values);
  std::memcpy(to, each, sizeof(float) * count);
}
SPLATAX_INLINE float sum_of(Lanes values, int count) {
  alignas(64) float each[LANES];
  store(each, values);
  float total = 0;
  for (int lane = 0; lane < std::min(count, LANES); ++lane) total += each[lane];
  return total;
}

// Rows blurred vertically, padded for the horizontal blur.
template <int Planes>
class Rows {
 public:
  Rows(const Line& line, int channels)
      : margin_(RADIUS * channels), step_(channels), stride_(line.padded + 2 * margin_ + LANES),
        values_(static_cast<size_t>(Planes) * stride_, 0.0f) {}

  float* at(int plane, int i) { return &values_[static_cast<size_t>(plane) * stride_ + margin_ + i]; }

  SPLATAX_INLINE Lanes across(const Kernel& kernel, int plane, int i) {
    const float* centre = at(plane, i);
    Lanes sum = broadcast(0);
    for (int k = 0; k < WINDOW; ++k) {
      sum = multiply_add(broadcast(kernel.weight[k]), load(centre + (k - RADIUS) * step_), sum);
    }
    return sum;
  }

 private:
  int margin_, step_, stride_;
  std::vector<float> values_;
};

struct RowSums {
  double absolute = 0, similarity = 0;
};

// Similarity of a row, and its derivatives with respect to the moments.
RowSums similarity_row(const Pictures& pictures, const Kernel& kernel, const Line& line, int row,
                       Rows<MOMENTS>& down, float* derivatives) {
  const int first = std::max(row - RADIUS, 0), last = std::min(row + RADIUS, pictures.height - 1);
  RowSums sums;
  for (int i = 0; i < line.length; i += LANES) {
    const int count = line.length - i;
    Lanes moments[MOMENTS];
    for (Lanes& moment : moments) moment = broadcast(0);
    for (int r = first; r <= last; ++r) {
      const size_t at = static_cast<size_t>(r) * line.length + i;
      const Lanes x = load_some(pictures.image + at, count), y = load_some(pictures.photo + at, count);
      const Lanes weight = broadcast(kernel.weight[r - row + RADIUS]), wx = weight * x, wy = weight * y;
      moments[0] += wx;
      moments[1] += wy;
      moments[2] = multiply_add(wx, x, moments[2]);
      moments[3] = multiply_add(wy, y, moments[3]);
      moments[4] = multiply_add(wx, y, moments[4]);
    }
    for (int m = 0; m < MOMENTS; ++m) store_some(down.at(m, i), moments[m], count);
    const size_t at = static_cast<size_t>(row) * line.length + i;
    const Lanes error = load_some(pictures.image + at, count) - load_some(pictures.photo + at, count);
    sums.absolute += sum_of(absolute(error), count);
  }
  for (int i = 0; i < line.length; i += LANES) {
    const Lanes mx = down.across(kernel, 0, i), my = down.across(kernel, 1, i);
    const Lanes xx = down.across(kernel, 2, i), yy = down.across(kernel, 3, i), xy = down.across(kernel, 4, i);
    const Lanes a1 = 2.0f * (mx * my) + C1, b1 = mx * mx + my * my + C1;
    const Lanes a2 = 2.0f * (xy - mx * my) + C2, b2 = (xx - mx * mx) + (yy - my * my) + C2;
    const Lanes inverse = broadcast(1) / (b1 * b2), similarity = a1 * a2 * inverse;
    const Lanes d_xx = -(similarity * b1 * inverse), d_xy = 2.0f * a1 * inverse;
    const Lanes d_mx = 2.0f * (my * (a2 - a1) * inverse + mx * (-d_xx - similarity * b2 * inverse));
    store(derivatives + i, d_mx);
    store(derivatives + line.padded + i, d_xx);
    store(derivatives + 2 * static_cast<size_t>(line.padded) + i, d_xy);
    sums.similarity += sum_of(similarity, line.length - i);
  }
  return sums;
}

// dL / d image of a row.
void gradient_row(const Pictures& pictures, const Kernel& kernel, const Line& line, int row,
                  const float* derivatives, float of_similarity, float of_absolute, Rows<DERIVATIVES>& down,
                  float* gradient) {
  const int first = std::max(row - RADIUS, 0), last = std::min(row + RADIUS, pictures.height - 1);
  for (int i = 0; i < line.length; i += LANES) {
    for (int d = 0; d < DERIVATIVES; ++d) {
      Lanes sum = broadcast(0);
      for (int r = first; r <= last; ++r) {
        const size_t at = (static_cast<size_t>(r) * DERIVATIVES + d) * line.padded + i;
        sum = multiply_add(broadcast(kernel.weight[r - row + RADIUS]), load(derivatives + at), sum);
      }
      store_some(down.at(d, i), sum, line.length - i);
    }
  }
  for (int i = 0; i < line.length; i += LANES) {
    const size_t at = static_cast<size_t>(row) * line.length + i;
    const int count = line.length - i;
    const Lanes x = load_some(pictures.image + at, count), y = load_some(pictures.photo + at, count);
    const Lanes d_similarity = down.across(kernel, 0, i) + 2.0f * x * down.across(kernel, 1, i) +
                               y * down.across(kernel, 2, i);
    const Lanes sign = or_zero(y < x, broadcast(of_absolute)) - or_zero(x < y, broadcast(of_absolute));
    store_some(gradient + at, multiply_add(broadcast(of_similarity), d_similarity, sign), count);
  }
}

}  // namespace

size_t photometric_scratch(const Pictures& pictures) {
  return static_cast<size_t>(pictures.height) * DERIVATIVES * Line(pictures).padded;
}

float photometric(const Pictures& pictures, float ssim_weight, float* gradient, float* scratch,
                  Workers& workers) {
  const Kernel kernel;
  const Line line(pictures);
  const size_t row_size = static_cast<size_t>(DERIVATIVES) * line.padded;
  std::vector<RowSums> sums(pictures.height);
  workers.ranges(pictures.height, [&](int, int begin, int end) {
    Rows<MOMENTS> down(line, pictures.channels);
    for (int row = begin; row < end; ++row) {
      sums[row] = similarity_row(pictures, kernel, line, row, down, scratch + row * row_size);
    }
  });
  const double pixels = static_cast<double>(pictures.height) * line.length;
  const float of_similarity = static_cast<float>(-ssim_weight / pixels);
  const float of_absolute = static_cast<float>((1 - ssim_weight) / pixels);
  workers.ranges(pictures.height, [&](int, int begin, int end) {
    Rows<DERIVATIVES> down(line, pictures.channels);
    for (int row = begin; row < end; ++row) {
      gradient_row(pictures, kernel, line, row, scratch, of_similarity, of_absolute, down, gradient);
    }
  });
  RowSums total;
  for (const RowSums& row : sums) {
    total.absolute += row.absolute;
    total.similarity += row.similarity;
  }
  return static_cast<float>(((1 - ssim_weight) * total.absolute - ssim_weight * total.similarity) / pixels +
                            ssim_weight);
}

}  // namespace splatax
