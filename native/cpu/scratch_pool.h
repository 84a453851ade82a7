// Scratch memory that lasts from one call to the next: fresh pages are slow.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "rasterize.h"

namespace splatax {

// Lends scratch memory to calls, one each, and keeps some of it. The lists that the forward call leaves there
// spare the gradient the binning: a ticket goes with the image, and a gradient that shows the ticket gets that
// memory back, if no other call has taken it in between. Results do not depend on it.
class ScratchPool {
 public:
  std::unique_ptr<Scratch> take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    const bool expected = !free_.empty() && free_.front()->expected;
    if (free_.empty() || (expected && free_.size() < KEPT)) return std::make_unique<Scratch>();
    return remove(free_.begin());
  }
  // The memory of a ticket, if it still holds the lists of this input; null otherwise.
  std::unique_ptr<Scratch> take(int32_t ticket, const Input& input) {
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
  List free_;  // in the order in which they are to be used again
};

inline ScratchPool pool;

}  // namespace splatax
