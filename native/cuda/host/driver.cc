#include "driver.h"

#include <dlfcn.h>

#include <map>
#include <mutex>

namespace splatax::cuda {
namespace {

// Values of CUdevice_attribute.
constexpr int CAPABILITY_MAJOR = 75, CAPABILITY_MINOR = 76;

struct Program {
  Handle library = nullptr;
  std::map<std::string, Handle> kernels;
};

std::mutex mutex;
Driver functions;
bool opened = false;
std::map<int, Program> programs;  // by compute capability; a library serves all GPUs of one

int current_capability() {
  int device = 0, major = 0, minor = 0;
  check(driver().cuCtxGetDevice(&device), "cuCtxGetDevice");
  check(driver().cuDeviceGetAttribute(&major, CAPABILITY_MAJOR, device), "cuDeviceGetAttribute");
  check(driver().cuDeviceGetAttribute(&minor, CAPABILITY_MINOR, device), "cuDeviceGetAttribute");
  return 10 * major + minor;
}

}  // namespace

void check(int code, const char* function) {
  if (code == 0) return;
  const char* name = nullptr;
  if (functions.cuGetErrorName) functions.cuGetErrorName(code, &name);
  throw Failure(std::string(function) + " failed with " + (name ? name : std::to_string(code)));
}

void open_driver(const char* path) {
  const std::lock_guard<std::mutex> lock(mutex);
  if (opened) return;
  void* library = dlopen(path, RTLD_NOW);
  if (!library) throw Failure(std::string("NVIDIA's driver cannot be opened: ") + dlerror());
  Driver found{};
#define FIND(name)                                                                                  \
  if (!(found.name = reinterpret_cast<decltype(found.name)>(dlsym(library, #name)))) {              \
    throw Failure("NVIDIA's driver has no function " #name "; a driver for CUDA 12 or newer does"); \
  }
  FIND(cuInit) FIND(cuGetErrorName) FIND(cuLibraryLoadData) FIND(cuLibraryGetKernel) FIND(cuLaunchKernel)
  FIND(cuMemsetD8Async) FIND(cuMemcpyDtoDAsync_v2) FIND(cuMemcpyDtoHAsync_v2) FIND(cuMemHostAlloc)
  FIND(cuStreamSynchronize) FIND(cuStreamGetCtx) FIND(cuCtxPushCurrent_v2) FIND(cuCtxPopCurrent_v2)
  FIND(cuCtxGetDevice) FIND(cuDeviceGetAttribute) FIND(cuEventCreate) FIND(cuEventRecord) FIND(cuEventSynchronize)
  FIND(cuEventElapsedTime) FIND(cuEventDestroy_v2)
#undef FIND
  functions = found;
  check(functions.cuInit(0), "cuInit");
  opened = true;
}

const Driver& driver() {
  if (!opened) throw Failure("NVIDIA's driver was not opened");
  return functions;
}

void load_kernels(int capability, const void* binary) {
  Handle library = nullptr;
  check(driver().cuLibraryLoadData(&library, binary, nullptr, nullptr, 0, nullptr, nullptr, 0), "cuLibraryLoadData");
  const std::lock_guard<std::mutex> lock(mutex);
  programs[capability] = {library, {}};
}

Handle kernel(const std::string& name) {
  const int capability = current_capability();
  const std::lock_guard<std::mutex> lock(mutex);
  const auto program = programs.find(capability);
  if (program == programs.end()) {
    throw Failure("no kernels were loaded for GPUs of compute capability " + std::to_string(capability / 10) + "." +
                  std::to_string(capability % 10));
  }
  Handle& found = program->second.kernels[name];
  if (!found) check(driver().cuLibraryGetKernel(&found, program->second.library, name.c_str()), name.c_str());
  return found;
}

}  // namespace splatax::cuda
