// Scratch memory that is kept from one call to the next, because fresh pages are slow.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "rasterize.h"

namespace splatax {

// Lends one scratch memory to each call, and keeps some of them. The forward call leaves its lists there,
// which saves the backward call the binning. The image carries a ticket, and the backward call with this
// ticket gets the memory back, unless another call has taken it in between. Results do not depend on it.
class ScratchPool {
 public:
  std::unique_ptr<Scratch> take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    const bool expected = !free_.empty() && free_.front()->expected;
    if (free_.empty() || (expected && free_.size() < KEPT)) return std::make_unique<Scratch>();
    return remove(free_.begin());
  }
  // Returns the memory of a ticket if it still holds the lists of this input; null otherwise, and for ticket 0.
  std::unique_ptr<Scratch> take(int32_t ticket, const Input& input) {
    if (ticket == 0) return nullptr;
    const std::lock_guard<std::mutex> lock(mutex_);
    for (auto it = free_.begin(); it != free_.end(); ++it) {
      if ((*it)->ticket == ticket && (*it)->binning.fits(input)) return remove(it);
    }
    return nullptr;
  }
  void give_back(std::unique_ptr<Scratch> scratch) {
    const std::lock_guard<std::mutex> lock(mutex_);
    if (free_.size() < KEPT) free_.insert(scratch->expected ? free_.end() : free_.begin(), std::move(scratch));
  }
  int32_t new_ticket() {
    const std::lock_guard<std::mutex> lock(mutex_);
    last_ = last_ == INT32_MAX ? 1 : last_ + 1;
    return last_;
  }

 private:
  static constexpr size_t KEPT = 3;
  using List = std::vector<std::unique_ptr<Scratch>>;

  std::unique_ptr<Scratch> remove(List::iterator it) {
    auto scratch = std::move(*it);
    free_.erase(it);
    return scratch;
  }

  std::mutex mutex_;
  int32_t last_ = 0;
  List free_;  // in the order of reuse
};

inline ScratchPool pool;

}  // namespace splatax
