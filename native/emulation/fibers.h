// Runs the threads of a CUDA block on the host, as fibers of one operating system thread. They take turns: a
// fiber runs until it waits at a barrier. SPLATAX_EMULATION_SEED chooses the order of turns and of blocks, so that a
// missing barrier or a race between blocks changes the results: with an even seed a warp runs until all of it
// waits for the block, with an odd one all threads of the block take turns. Seeds other than 0 and 1 shuffle too.
// A deadlock is reported.
#pragma once

#include <setjmp.h>
#include <ucontext.h>

#include <atomic>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <memory>
#include <numeric>
#include <utility>
#include <vector>

namespace emulation {

constexpr int WARP = 32, MOST_THREADS = 1024, STACK_BYTES = 64 << 10;

inline std::atomic<uint64_t>& order_seed() {
  static std::atomic<uint64_t> seed = [] {
    const char* text = std::getenv("SPLATAX_EMULATION_SEED");
    return text ? std::strtoull(text, nullptr, 10) : 0ull;
  }();
  return seed;
}

// 0, 1, ... in an order that depends on the seed; unchanged for seeds 0 and 1.
inline std::vector<int> shuffled(int count, uint64_t stream) {
  std::vector<int> order(count);
  std::iota(order.begin(), order.end(), 0);
  const uint64_t seed = order_seed();
  uint64_t state = seed * 0x9E3779B97F4A7C15ull + stream;
  for (int i = count; seed > 1 && i > 1; --i) {
    state = state * 6364136223846793005ull + 1442695040888963407ull;
    std::swap(order[i - 1], order[(state >> 33) % i]);
  }
  return order;
}

struct Index {
  unsigned x;
};

// Of a block or a warp. It opens when all threads that still run have arrived.
struct Barrier {
  int running = 0, arrived = 0;
  uint64_t generation = 0;  // how often it has opened
};

struct Vote {
  uint64_t generation = ~0ull;  // of the barrier at which it is taken
  bool result = false;
};

struct WarpState {
  Barrier barrier;
  int at_block_barrier = 0;  // lanes that wait for the block
  uint64_t slots[2][WARP];  // of even and odd exchanges: no lane is two exchanges ahead of another
};

struct Fiber {
  jmp_buf resume;
  ucontext_t entry;
  std::unique_ptr<char[]> stack{new char[STACK_BYTES]};
  Index thread{0};
  int next_turn = 0;  // its place in the order of turns
  bool started = false, done = true;
};

class Block;
inline thread_local Block* running_block = nullptr;

class Block {
 public:
  Index index{0}, size{0}, grid{0};
  Vote votes[2];  // at even and odd barriers
  Barrier barrier;
  WarpState warps[MOST_THREADS / WARP];

  // Runs body(arguments) in each thread of one block, to the end.
  void run(unsigned number, unsigned blocks, unsigned threads, void (*body)(void*), void* arguments) {
    index = {number}, grid = {blocks}, size = {threads};
    body_ = body, arguments_ = arguments;
    turns_ = shuffled(static_cast<int>(threads), number + 1);
    while (fibers_.size() < threads) fibers_.emplace_back(new Fiber);
    barrier = Barrier(), barrier.running = static_cast<int>(threads);
    for (WarpState& warp : warps) warp.barrier = Barrier(), warp.at_block_barrier = 0;
    for (Vote& vote : votes) vote = Vote();
    for (unsigned i = 0; i < threads; ++i) prepare(i);
    for (unsigned i = 0; i < threads; ++i) fibers_[turns_[i]]->next_turn = static_cast<int>(i);
    waits_ = 0;
    running_block = this;
    if (_setjmp(finished_) == 0) switch_to(turns_[0]);
    running_block = nullptr;
  }

  unsigned thread() const { return fibers_[current_]->thread.x; }
  const Index& thread_index() const { return fibers_[current_]->thread; }
  WarpState& warp() { return warps[thread() / WARP]; }

  void wait(Barrier& at) {
    const uint64_t generation = at.generation;
    ++at.arrived;
    if (&at == &barrier) ++warp().at_block_barrier;
    open_if_full(at);
    while (at.generation == generation) take_turns();
  }

 private:
  void prepare(unsigned i) {
    Fiber& fiber = *fibers_[i];
    fiber.thread = {i}, fiber.started = false, fiber.done = false;
    ++warps[i / WARP].barrier.running;
  }

  // A stack whose thread has returned runs the next thread that was not started, so a kernel without barriers
  // never switches stacks.
  static void enter() {
    Block& block = *running_block;
    for (;;) {
      block.body_(block.arguments_);
      block.leave();
      if (block.barrier.running == 0) _longjmp(block.finished_, 1);
      const int next = block.next();
      if (block.fibers_[next]->started) block.switch_to(next);
      block.fibers_[next]->started = true;
      block.current_ = next;
    }
  }

  void leave() {
    Fiber& fiber = *fibers_[current_];
    fiber.done = true;
    for (Barrier* at : {&warps[fiber.thread.x / WARP].barrier, &barrier}) {
      --at->running;
      open_if_full(*at);  // a barrier does not wait for a thread that has returned
    }
  }

  void open_if_full(Barrier& at) {
    if (at.running == 0 || at.arrived < at.running) return;
    at.arrived = 0;
    ++at.generation;
    waits_ = 0;
    if (&at != &barrier) return;
    for (WarpState& warp : warps) warp.at_block_barrier = 0;
  }

  // The fiber whose turn it is.
  int next() {
    const WarpState& own = warp();
    const bool stay = order_seed() % 2 == 0 && own.at_block_barrier < own.barrier.running;
    const int count = static_cast<int>(size.x), warp_number = current_ / WARP;
    int turn = fibers_[current_]->next_turn;
    do {
      turn = (turn + 1) % count;
    } while (fibers_[turns_[turn]]->done || (stay && turns_[turn] / WARP != warp_number));
    return turns_[turn];
  }

  void take_turns() {
    if (++waits_ > 4 * static_cast<long>(size.x)) {
      std::fprintf(stderr, "deadlock in block %u: its threads wait at different barriers\n", index.x);
      std::abort();
    }
    const int other = next();
    if (other != current_ && _setjmp(fibers_[current_]->resume) == 0) switch_to(other);
  }

  void switch_to(int fiber) {
    current_ = fiber;
    Fiber& chosen = *fibers_[fiber];
    if (chosen.started) _longjmp(chosen.resume, 1);
    chosen.started = true;
    getcontext(&chosen.entry);
    chosen.entry.uc_stack.ss_sp = chosen.stack.get();
    chosen.entry.uc_stack.ss_size = STACK_BYTES;
    chosen.entry.uc_link = nullptr;
    makecontext(&chosen.entry, &Block::enter, 0);
    setcontext(&chosen.entry);
  }

  std::vector<std::unique_ptr<Fiber>> fibers_;
  std::vector<int> turns_;
  int current_ = 0;
  long waits_ = 0;  // turns since a barrier last opened
  jmp_buf finished_;
  void (*body_)(void*) = nullptr;
  void* arguments_ = nullptr;
};

// Launches kernel(arguments...) on `blocks` blocks of `threads` threads, one block after the other.
template <class... P>
void launch(void (*kernel)(P...), unsigned blocks, unsigned threads, P... arguments) {
  static thread_local Block block;  // keeps its stacks
  auto call = [=] { kernel(arguments...); };
  using Call = decltype(call);
  for (const int number : shuffled(static_cast<int>(blocks), 0)) {
    block.run(static_cast<unsigned>(number), blocks, threads, [](void* c) { (*static_cast<Call*>(c))(); }, &call);
  }
}

}  // namespace emulation
