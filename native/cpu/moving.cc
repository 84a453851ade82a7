// This file is compiled without contraction of a * b + c, so that every operation of Adam rounds once: each build
// gives the bits that tests/contracts/test_moving.py derives with NumPy.
#include "moving.h"

#include <algorithm>
#include <vector>

#include "flushing.h"
#include "mover.h"

namespace splatax {
namespace {

constexpr int PART = 4096;  // rows that one thread works on at a time
constexpr int CHUNK = 256;  // rows whose gradients are kept at a time

// Gradients of up to CHUNK rows.
class ChunkOfGradients {
 public:
  explicit ChunkOfGradients(int coefficients) : columns_{3, 4, 3, 1, 3 * coefficients} {
    for (int field = 0; field < FIELDS; ++field) numbers_[field].resize(static_cast<size_t>(CHUNK) * columns_[field]);
  }
  // Arrays for rows from `first` on; their row 0 would be the first of the scene.
  GaussianGradients from(int first) {
    const auto at = [&](int field) { return numbers_[field].data() - static_cast<ptrdiff_t>(first) * columns_[field]; };
    return {at(0), at(1), at(2), at(3), at(4), nullptr};
  }

 private:
  static constexpr int FIELDS = 5;
  const int columns_[FIELDS];
  std::vector<float> numbers_[FIELDS];
};

// Moves rows [first, end). `seen`, for each of them, as of `Mover::run`.
void move_some(Mover& mover, int first, int end, const uint8_t* seen) {
  const Flushing flushing;
  for (int row = first; row < end; row += LANES) {
    mover.run(row, std::min(LANES, end - row), seen ? seen + (row - first) : nullptr);
  }
}

}  // namespace

void move_rows(const Move& move, Workers& workers) {
  workers.each((move.rows + PART - 1) / PART, [&](int part) {
    Mover mover(move, move.gradients);
    move_some(mover, part * PART, std::min(move.rows, (part + 1) * PART), nullptr);
  });
}

void move_rows(const Move& move, GradientByRows& gradients, Workers& workers) {
  workers.each((move.rows + PART - 1) / PART, [&](int part) {
    ChunkOfGradients chunk(move.coefficients);
    Mover mover(move, {});
    const int end = std::min(move.rows, (part + 1) * PART);
    for (int first = part * PART; first < end; first += CHUNK) {
      const int last = std::min(end, first + CHUNK);
      const GaussianGradients found = chunk.from(first);
      uint8_t seen[CHUNK];
      const int shown = gradients.find(first, last - first, found, seen);
      if (2 * shown < last - first) mover.expect(first, last - first, seen);
      mover.follow({found.means, found.quats, found.log_scales, found.opacity_logits, found.sh});
      move_some(mover, first, last, seen);
    }
  });
}

}  // namespace splatax
