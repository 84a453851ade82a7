#include "profile.h"

#include <algorithm>
#include <atomic>
#include <map>
#include <mutex>

namespace splatax::cuda {
namespace {

struct Times {
  int launches = 0;
  float least = 0, total = 0;  // milliseconds
};

std::atomic<bool> profiling{false};
std::mutex mutex;
std::map<std::string, Times> times;

}  // namespace

Stopwatch::Stopwatch(const std::string& name, Handle stream) : stream_(stream) {
  if (!profiling) return;
  name_ = name;
  check(driver().cuEventCreate(&begin_, 0), "cuEventCreate");
  check(driver().cuEventCreate(&end_, 0), "cuEventCreate");
  check(driver().cuEventRecord(begin_, stream_), "cuEventRecord");
}

Stopwatch::~Stopwatch() {
  if (!begin_) return;
  float took = 0;
  const bool measured = driver().cuEventRecord(end_, stream_) == 0 && driver().cuEventSynchronize(end_) == 0 &&
                        driver().cuEventElapsedTime(&took, begin_, end_) == 0;
  driver().cuEventDestroy_v2(begin_);
  driver().cuEventDestroy_v2(end_);
  if (!measured) return;
  const std::lock_guard<std::mutex> lock(mutex);
  Times& sum = times[name_];
  sum.least = sum.launches ? std::min(sum.least, took) : took;
  sum.total += took;
  ++sum.launches;
}

void set_profile(bool on) { profiling = on; }

std::string take_profile() {
  const std::lock_guard<std::mutex> lock(mutex);
  std::string text;
  for (const auto& [name, sum] : times) {
    text += name + " " + std::to_string(sum.launches) + " " + std::to_string(sum.least) + " " +
            std::to_string(sum.total) + "\n";
  }
  times.clear();
  return text;
}

}  // namespace splatax::cuda
