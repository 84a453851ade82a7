// A stand-in for NVIDIA's driver that runs the kernels on the host, for tests where there is no GPU. The
// host side of the backend calls it as it would call the driver.
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <map>
#include <string>
#include <utility>

#include "kernels.cu"

namespace {

constexpr int INVALID_VALUE = 1, NOT_FOUND = 500;  // of CUresult
constexpr int CAPABILITY = 90;

using Launcher = void (*)(unsigned blocks, unsigned threads, void** arguments);

template <auto kernel>
struct Entry;
template <class... P, void (*kernel)(P...)>
struct Entry<kernel> {
  static void launch(unsigned blocks, unsigned threads, void** arguments) {
    unpack(blocks, threads, arguments, std::index_sequence_for<P...>());
  }
  template <size_t... I>
  static void unpack(unsigned blocks, unsigned threads, void** arguments, std::index_sequence<I...>) {
    emulation::launch<P...>(kernel, blocks, threads, *static_cast<P*>(arguments[I])...);
  }
};

#define ENTRY(name) {#name, Entry<&name>::launch}
const std::map<std::string, Launcher>& entries() {
  static const std::map<std::string, Launcher> all = {
#include "entries.inc"
  };
  return all;
}

}  // namespace

extern "C" {

// For tests: the order in which threads and blocks take turns.
void emulation_set_order(unsigned long long seed) { emulation::order_seed() = seed; }

int cuInit(unsigned) { return 0; }
int cuGetErrorName(int code, const char** name) {
  *name = code == NOT_FOUND ? "CUDA_ERROR_NOT_FOUND" : "CUDA_ERROR_INVALID_VALUE";
  return 0;
}
int cuLibraryLoadData(void** library, const void*, void*, void**, unsigned, void*, void**, unsigned) {
  *library = library;  // any address
  return 0;
}
int cuLibraryGetKernel(void** kernel, void*, const char* name) {
  const auto entry = entries().find(name);
  if (entry == entries().end()) return NOT_FOUND;
  *kernel = reinterpret_cast<void*>(entry->second);
  return 0;
}
int cuLaunchKernel(void* kernel, unsigned x, unsigned y, unsigned z, unsigned threads, unsigned threads_y,
                   unsigned threads_z, unsigned shared_bytes, void*, void** arguments, void** extra) {
  if (!x || y != 1 || z != 1 || !threads || threads > emulation::MOST_THREADS || threads_y != 1 || threads_z != 1 ||
      shared_bytes || extra) {
    return INVALID_VALUE;
  }
  reinterpret_cast<Launcher>(kernel)(x, threads, arguments);
  return 0;
}
int cuMemsetD8Async(unsigned long long at, unsigned char value, size_t bytes, void*) {
  std::memset(reinterpret_cast<void*>(at), value, bytes);
  return 0;
}
int cuMemcpyDtoDAsync_v2(unsigned long long to, unsigned long long from, size_t bytes, void*) {
  std::memcpy(reinterpret_cast<void*>(to), reinterpret_cast<void*>(from), bytes);
  return 0;
}
int cuMemcpyDtoHAsync_v2(void* to, unsigned long long from, size_t bytes, void*) {
  std::memcpy(to, reinterpret_cast<void*>(from), bytes);
  return 0;
}
int cuMemHostAlloc(void** memory, size_t bytes, unsigned) { return (*memory = std::malloc(bytes)) ? 0 : INVALID_VALUE; }
int cuStreamSynchronize(void*) { return 0; }
int cuStreamGetCtx(void*, void** context) {
  *context = nullptr;
  return 0;
}
int cuCtxPushCurrent_v2(void*) { return 0; }
int cuCtxPopCurrent_v2(void**) { return 0; }
int cuCtxGetDevice(int* device) {
  *device = 0;
  return 0;
}
int cuDeviceGetAttribute(int* value, int attribute, int) {
  constexpr int CAPABILITY_MAJOR = 75, CAPABILITY_MINOR = 76;
  if (attribute != CAPABILITY_MAJOR && attribute != CAPABILITY_MINOR) return INVALID_VALUE;
  *value = attribute == CAPABILITY_MAJOR ? CAPABILITY / 10 : CAPABILITY % 10;
  return 0;
}
using Time = std::chrono::steady_clock::time_point;
int cuEventCreate(void** event, unsigned) {
  *event = new Time;
  return 0;
}
int cuEventRecord(void* event, void*) {
  *static_cast<Time*>(event) = std::chrono::steady_clock::now();
  return 0;
}
int cuEventSynchronize(void*) { return 0; }
int cuEventElapsedTime(float* milliseconds, void* begin, void* end) {
  *milliseconds = std::chrono::duration<float, std::milli>(*static_cast<Time*>(end) - *static_cast<Time*>(begin)).count();
  return 0;
}
int cuEventDestroy_v2(void* event) {
  delete static_cast<Time*>(event);
  return 0;
}

}  // extern "C"
