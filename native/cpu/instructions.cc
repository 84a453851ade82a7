// The fastest instruction set that the machine can run: a library of its own, and a program for CMake.

#include <cstdio>

extern "C" __attribute__((visibility("default"))) const char* splatax_best_instructions() {
#if defined(__x86_64__)
  __builtin_cpu_init();
  const bool avx2 = __builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma");
  if (avx2 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512vl")) {
    return "avx512";
  }
  if (avx2) return "avx2";
#endif
  return "baseline";
}

#if defined(SPLATAX_PRINT_INSTRUCTIONS)
int main() { std::fputs(splatax_best_instructions(), stdout); }
#endif
