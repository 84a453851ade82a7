// Arrays from XLA, and checks of their shapes. Every handler checks before it reads a number, because arrays
// of wrong shapes, from a file or a caller's mistake, must never reach a kernel's pointers.
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <initializer_list>
#include <new>
#include <string>
#include <vector>

#include "xla/ffi/api/ffi.h"

namespace splatax {

namespace ffi = xla::ffi;
using FloatArray = ffi::Buffer<ffi::F32>;
using FloatResult = ffi::ResultBuffer<ffi::F32>;
using Ticket = ffi::Buffer<ffi::S32>;
using Counts = ffi::ResultBuffer<ffi::S32>;

constexpr int64_t LONGEST_SIDE = 1000000;  // pixels; as in splatax/shapes.py. Tiles are counted in 16 bits
constexpr int64_t MOST_ROWS = INT32_MAX;   // rows are counted in 32 bits

template <ffi::DataType dtype>
ffi::Span<const int64_t> dimensions_of(const ffi::Buffer<dtype>& array) {
  return array.dimensions();
}
template <ffi::DataType dtype>
ffi::Span<const int64_t> dimensions_of(ffi::Result<ffi::Buffer<dtype>>& array) {
  return array->dimensions();
}

// Leading axes of a call's arrays, one for each `jax.vmap` around it. They are as long as those of the results, or
// 1 where all views of the batch share the array.
class Batch {
 public:
  Batch() = default;
  // The leading axes of a result that has `rank` axes of its own.
  template <class Array>
  Batch(Array& result, size_t rank) {
    const auto dimensions = dimensions_of(result);
    if (dimensions.size() > rank) sizes_.assign(dimensions.begin(), dimensions.end() - rank);
    for (const int64_t size : sizes_) views_ *= size;
  }

  size_t rank() const { return sizes_.size(); }
  int64_t views() const { return views_; }
  bool fits(ffi::Span<const int64_t> dimensions, bool shared) const {
    if (dimensions.size() < rank()) return false;
    for (size_t i = 0; i < rank(); ++i) {
      if (dimensions[i] != sizes_[i] && !(shared && dimensions[i] == 1)) return false;
    }
    return true;
  }

  // First element of an array that belongs to a view.
  template <class Array>
  auto* of(Array& array, int64_t view) const {
    const auto dimensions = dimensions_of(array);
    int64_t slice = 0, stride = 1, own = 1;
    for (size_t i = rank(); i < dimensions.size(); ++i) own *= dimensions[i];
    for (size_t i = rank(); i-- > 0; view /= sizes_[i]) {
      if (dimensions[i] != 1) slice += view % sizes_[i] * stride;
      stride *= dimensions[i];
    }
    return data_of(array) + slice * own;
  }

 private:
  template <ffi::DataType dtype>
  static auto* data_of(const ffi::Buffer<dtype>& array) {
    return array.typed_data();
  }
  template <ffi::DataType dtype>
  static auto* data_of(ffi::Result<ffi::Buffer<dtype>>& array) {
    return array->typed_data();
  }

  std::vector<int64_t> sizes_;
  int64_t views_ = 1;
};

// Collects errors in the arrays of a call; the first one is reported.
class Checks {
 public:
  Checks() = default;
  explicit Checks(const Batch& batch) : batch_(batch) { range("the number of views", batch.views(), 0, MOST_ROWS); }

  // Returns an array's own sizes, of this rank; reports an error and returns zeros if it has another rank.
  template <size_t RANK, class Array>
  std::array<int64_t, RANK> sizes(const char* name, Array& array) {
    std::array<int64_t, RANK> result{};
    const auto dimensions = dimensions_of(array);
    const size_t leading = batch_.rank();
    if (dimensions.size() != leading + RANK) {
      report(std::string(name) + " has " + std::to_string(dimensions.size()) + " axes, not " +
             std::to_string(leading + RANK));
    } else {
      for (size_t i = 0; i < RANK; ++i) result[i] = dimensions[leading + i];
    }
    return result;
  }

  // Reports an array whose own shape differs, or whose leading axes are not those of the batch.
  template <class Array>
  Checks& shape(const char* name, Array& array, std::initializer_list<int64_t> expected) {
    const auto dimensions = dimensions_of(array);
    const size_t leading = batch_.rank();
    const bool same = dimensions.size() == leading + expected.size() && batch_.fits(dimensions, may_be_shared(array)) &&
                      std::equal(dimensions.begin() + leading, dimensions.end(), expected.begin());
    if (!same) report(std::string(name) + " has shape " + words(dimensions) + ", not " + words(expected));
    return *this;
  }

  // Reports a number that is outside of [least, most].
  Checks& range(const char* name, int64_t value, int64_t least, int64_t most) {
    if (value < least || value > most) {
      report(std::string(name) + " is " + std::to_string(value) + ", not from " + std::to_string(least) + " to " +
             std::to_string(most));
    }
    return *this;
  }

  // Reports a finding unless a condition holds.
  Checks& require(bool holds, const std::string& finding) {
    if (!holds) report(finding);
    return *this;
  }

  bool failed() const { return !finding_.empty(); }
  ffi::Error error(const char* call) const {
    return ffi::Error::InvalidArgument(std::string("splatax: ") + call + ": " + finding_);
  }

 private:
  template <ffi::DataType dtype>
  static bool may_be_shared(const ffi::Buffer<dtype>&) {
    return true;
  }
  template <ffi::DataType dtype>
  static bool may_be_shared(ffi::Result<ffi::Buffer<dtype>>&) {
    return false;
  }

  template <class Sizes>
  static std::string words(const Sizes& sizes) {
    std::string text = "[";
    for (const int64_t size : sizes) text += (text.size() > 1 ? " " : "") + std::to_string(size);
    return text + "]";
  }

  void report(std::string finding) {
    if (finding_.empty()) finding_ = std::move(finding);
  }

  Batch batch_;
  std::string finding_;
};

// Runs the body of a handler, which returns nothing, and turns a failed allocation into an error of the call.
template <class Body>
ffi::Error guarded(const char* call, const Body& body) {
  try {
    body();
    return ffi::Error::Success();
  } catch (const std::bad_alloc&) {
    return ffi::Error(ffi::ErrorCode::kResourceExhausted,
                      std::string("splatax: ") + call + ": the machine has too little free memory for this call");
  }
}

// Binding to which `add` was applied N times.
template <int N, class Binding, class Add>
auto repeated(Binding&& binding, const Add& add) {
  if constexpr (N == 1) {
    return add(std::move(binding));
  } else {
    return repeated<N - 1>(add(std::move(binding)), add);
  }
}

// Binding with N more float32 arrays as arguments or results.
template <int N, class Binding>
auto arrays(Binding&& binding) {
  return repeated<N>(std::move(binding), [](auto&& b) { return std::move(b).template Arg<FloatArray>(); });
}
template <int N, class Binding>
auto results(Binding&& binding) {
  return repeated<N>(std::move(binding), [](auto&& b) { return std::move(b).template Ret<FloatArray>(); });
}

// Beginning of every binding.
inline auto call() { return ffi::Ffi::Bind().Ctx<ffi::ThreadPool>(); }

}  // namespace splatax
