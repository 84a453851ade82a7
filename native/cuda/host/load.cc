// The functions that Python calls: load the driver and the kernels, and profile. Each returns an empty text, or
// what went wrong.
#include <string>

#include "driver.h"
#include "profile.h"

namespace {

// Text that stays valid until the next call in the same thread.
template <class Body>
const char* reported(const Body& body) {
  static thread_local std::string text;
  try {
    text = body();
  } catch (const std::exception& failure) {
    text = failure.what();
  }
  return text.c_str();
}

}  // namespace

#pragma GCC visibility push(default)

extern "C" const char* splatax_cuda_open(const char* driver) {
  return reported([&] { return splatax::cuda::open_driver(driver), ""; });
}

extern "C" const char* splatax_cuda_load(int capability, const void* binary) {
  return reported([&] { return splatax::cuda::load_kernels(capability, binary), ""; });
}

extern "C" void splatax_cuda_set_profile(int on) { splatax::cuda::set_profile(on != 0); }

extern "C" const char* splatax_cuda_take_profile() {
  return reported([] { return splatax::cuda::take_profile(); });
}

#pragma GCC visibility pop
