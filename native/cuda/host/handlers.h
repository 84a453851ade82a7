// Shared by the handlers of all XLA custom calls: the GPU's queue, scratch memory, and errors.
#pragma once

#include <cstdlib>
#include <cstring>
#include <memory>
#include <utility>
#include <vector>

#include "../../cpu/ffi.h"
#include "work.h"

namespace splatax::cuda {

#ifdef SPLATAX_EMULATION

// Tests run the same handlers on the host: native/emulation/driver.cc is then the driver.
class Context {
 public:
  template <class Body>
  void run(const Body& body) {
    std::vector<std::unique_ptr<void, decltype(&std::free)>> owned;
    Work work(nullptr, [&](size_t bytes) {
      owned.emplace_back(std::malloc(bytes), &std::free);
      if (!owned.back()) throw std::bad_alloc();
      return std::memset(owned.back().get(), 0xff, bytes);  // so that a read of it does not go unnoticed
    });
    body(work);
  }
};

inline auto call() { return ffi::Ffi::Bind(); }
#define SPLATAX_CONTEXT
#define SPLATAX_TAKE_CONTEXT Context context

#else

class Context {
 public:
  Context(Handle stream, ffi::ScratchAllocator scratch) : stream_(stream), scratch_(std::move(scratch)) {}

  template <class Body>
  void run(const Body& body) {
    Work work(stream_, [&](size_t bytes) {
      constexpr size_t ALIGNMENT = 256;
      const auto memory = scratch_.Allocate(bytes, ALIGNMENT);
      if (!memory) throw std::bad_alloc();
      return *memory;
    });
    body(work);
  }

 private:
  Handle stream_;
  ffi::ScratchAllocator scratch_;
};

inline auto call() { return ffi::Ffi::Bind().Ctx<ffi::PlatformStream<Handle>>().Ctx<ffi::ScratchAllocator>(); }
#define SPLATAX_CONTEXT Handle stream, ffi::ScratchAllocator scratch,
#define SPLATAX_TAKE_CONTEXT Context context(stream, std::move(scratch))

#endif

// Runs body(work), and turns what it throws into an error of the call.
template <class Body>
ffi::Error queued(const char* name, Context& context, const Body& body) {
  try {
    context.run(body);
    return ffi::Error::Success();
  } catch (const std::bad_alloc&) {
    return ffi::Error(ffi::ErrorCode::kResourceExhausted,
                      std::string("splatax: ") + name + ": the GPU has too little free memory for this call");
  } catch (const std::exception& failure) {
    return ffi::Error::Internal(std::string("splatax: ") + name + ": " + failure.what());
  }
}

}  // namespace splatax::cuda
