// Time of each kernel on the GPU, measured while a profile is on. Each launch then waits for the one before, so
// a call takes longer than the sum of its kernels without a profile.
#pragma once

#include <string>

#include "driver.h"

namespace splatax::cuda {

// Measures from its construction to its destruction, if a profile is on.
class Stopwatch {
 public:
  Stopwatch(const std::string& name, Handle stream);
  ~Stopwatch();
  Stopwatch(const Stopwatch&) = delete;

 private:
  std::string name_;
  Handle stream_, begin_ = nullptr, end_ = nullptr;
};

void set_profile(bool on);

// Returns a line "name launches least_ms total_ms" for each kernel since the last call.
std::string take_profile();

}  // namespace splatax::cuda
