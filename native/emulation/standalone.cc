// Runs all kernels on small random scenes, without JAX, and prints a hash of each result. For sanitizers, which
// then know the bounds of every array, and for tests that insert errors into the kernels.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <memory>
#include <random>

#include "rasterize.h"

namespace {

using namespace splatax::cuda;

std::mt19937 random_numbers(0);

std::vector<float> uniform(size_t count, float low, float high) {
  std::vector<float> numbers(count);
  for (float& number : numbers) number = std::uniform_real_distribution<float>(low, high)(random_numbers);
  return numbers;
}

// Memory of its own for each array, so that an access beyond its end is found.
class Memory {
 public:
  template <class T>
  T* get(size_t count) {
    blocks_.emplace_back(std::malloc(std::max<size_t>(count, 1) * sizeof(T)), &std::free);
    return static_cast<T*>(std::memset(blocks_.back().get(), 0xff, count * sizeof(T)));
  }

 private:
  std::vector<std::unique_ptr<void, decltype(&std::free)>> blocks_;
};

uint64_t hash_of(const float* numbers, size_t count) {
  uint64_t hash = 14695981039346656037ull;
  const auto* bytes = reinterpret_cast<const unsigned char*>(numbers);
  for (size_t i = 0; i < count * sizeof(float); ++i) hash = (hash ^ bytes[i]) * 1099511628211ull;
  return hash;
}

void print(const char* name, const float* numbers, size_t count) {
  double sum = 0;
  for (size_t i = 0; i < count; ++i) sum += std::fabs(numbers[i]);
  std::printf("%s %016llx %.4g\n", name, static_cast<unsigned long long>(hash_of(numbers, count)), sum);
}

// An image and its gradient, with at most `max_pairs` pairs in a round.
void rasterize_scene(Work& work, int max_pairs) {
  constexpr int N = 220, C = 4, WIDTH = 18, HEIGHT = 17, PICTURE = WIDTH * HEIGHT;
  const auto x = uniform(N, 0, WIDTH), y = uniform(N, 0, HEIGHT), sigma = uniform(N, 0.7f, 5);
  const auto depths = uniform(N, 1, 9), opacities = uniform(N, 0.05f, 0.99f), channels = uniform(C * N, 0, 1);
  std::vector<float> means2d(2 * N), sqrt_conics(3 * N), extents(2 * N);
  for (int i = 0; i < N; ++i) {
    means2d[2 * i] = x[i], means2d[2 * i + 1] = y[i];
    sqrt_conics[3 * i] = sqrt_conics[3 * i + 2] = 1 / sigma[i], sqrt_conics[3 * i + 1] = 0.1f / sigma[i];
    extents[2 * i] = extents[2 * i + 1] = i % 10 ? 4 * sigma[i] : 0;
  }
  const SplatRows splats{means2d.data(), sqrt_conics.data(), depths.data(), extents.data(), opacities.data(),
                         channels.data(), N, C};
  const Frame frame = frame_of(WIDTH, HEIGHT);
  const Sizes sizes(splats, frame, max_pairs);
  Memory memory;
  Lists lists(sizes, memory.get<uint32_t>(sizes.words()), memory.get<float>(sizes.chunks() * (1 + C) * PIXELS));
  lists.by_depth = {memory.get<uint32_t>(N), memory.get<uint32_t>(N + 1)};
  lists.tiles.pairs = memory.get<uint32_t>(sizes.capacity), lists.tiles.owners = memory.get<uint32_t>(sizes.capacity);
  lists.tiles.starts = memory.get<uint32_t>(sizes.tiles + 1);
  lists.tiles.first_chunks = memory.get<uint32_t>(sizes.tiles + 1);
  lists.tiles.last_chunks = memory.get<uint32_t>(sizes.tiles);
  float *sums = memory.get<float>(PICTURE * C), *alpha = memory.get<float>(PICTURE);
  rasterize(work, splats, frame, sizes, lists, {sums, alpha, nullptr, 0, false});
  print("sums", sums, PICTURE * C), print("alpha", alpha, PICTURE);

  const auto d_sums = uniform(PICTURE * C, -1, 1), d_alpha = uniform(PICTURE, -1, 1);
  float *d_means2d = memory.get<float>(2 * N), *d_conics = memory.get<float>(3 * N), *pull = memory.get<float>(2 * N);
  float *d_opacities = memory.get<float>(N), *d_channels = memory.get<float>(C * N);
  rasterize_gradient(work, splats, frame, sizes, lists, {sums, alpha, d_sums.data(), d_alpha.data(), 0},
                     {d_means2d, d_conics, d_opacities, d_channels, pull, 0});
  print("d_means2d", d_means2d, 2 * N), print("d_sqrt_conics", d_conics, 3 * N), print("pull", pull, 2 * N);
  print("d_opacities", d_opacities, N), print("d_channels", d_channels, C * N);
}

void project_scene(Work& work) {
  constexpr int N = 300, K = 25;
  const auto means = uniform(3 * N, -2, 2), quats = uniform(4 * N, -1, 1), log_scales = uniform(3 * N, -4, -1);
  const auto logits = uniform(N, -3, 3), sh = uniform(3 * K * N, -0.5f, 0.5f);
  const float camera[CAMERA_FIELDS] = {30, 31, 16, 12, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 4, 0, 0, -4};
  const GaussianRows gaussians{means.data(), quats.data(), log_scales.data(), logits.data(), sh.data(), N, K};
  const View view{camera, 32, 24, 0.3f, true, 0.005f};
  Memory memory;
  const ProjectedRows splats{memory.get<float>(2 * N), memory.get<float>(3 * N), memory.get<float>(N),
                             memory.get<float>(2 * N), memory.get<float>(3 * N), memory.get<float>(N)};
  work.launch("project", blocks_for(N), gaussians, view, splats);
  print("means2d", splats.means2d, 2 * N), print("sqrt_conics", splats.sqrt_conics, 3 * N);
  print("colors", splats.colors, 3 * N), print("opacities", splats.opacities, N);

  const auto d2 = uniform(2 * N, -1, 1), d3 = uniform(3 * N, -1, 1), d1 = uniform(N, -1, 1);
  const int blocks = blocks_for(N);
  const GaussianGradients gradients{memory.get<float>(3 * N), memory.get<float>(4 * N), memory.get<float>(3 * N),
                                    memory.get<float>(N), memory.get<float>(3 * K * N),
                                    memory.get<float>(blocks * CAMERA_FIELDS)};
  const ProjectedCotangents cotangents{d2.data(), d3.data(), d1.data(), splats.extents, d3.data(), d1.data()};
  work.launch("project_gradient", blocks, gaussians, view, cotangents, gradients);
  float* d_camera = memory.get<float>(CAMERA_FIELDS);
  work.launch("sum_camera_parts", 1, blocks, static_cast<const float*>(gradients.camera_parts), d_camera);
  print("d_means", gradients.means, 3 * N), print("d_quats", gradients.quats, 4 * N);
  print("d_sh", gradients.sh, 3 * K * N), print("d_camera", d_camera, CAMERA_FIELDS);
}

void compare_pictures(Work& work) {
  constexpr int WIDTH = 21, HEIGHT = 18, C = 3, NUMBERS = WIDTH * HEIGHT * C;
  const auto image = uniform(NUMBERS, 0, 1), photo = uniform(NUMBERS, 0, 1);
  const Pictures pictures{image.data(), photo.data(), WIDTH, HEIGHT, C};
  const LossWeights weights{0.8f / NUMBERS, 0.2f / NUMBERS};
  const int blocks = blocks_for(WIDTH, TILE) * blocks_for(HEIGHT, TILE) * C;
  Memory memory;
  float *derivatives = memory.get<float>(3 * NUMBERS), *parts = memory.get<float>(blocks);
  float *gradient = memory.get<float>(NUMBERS), *loss = memory.get<float>(1);
  work.launch("photometric_loss", blocks, pictures, weights, derivatives, parts);
  work.launch("photometric_gradient", blocks, pictures, weights, static_cast<const float*>(derivatives), gradient);
  work.launch("sum_loss_parts", 1, blocks, static_cast<const float*>(parts), loss);
  print("loss", loss, 1), print("d_image", gradient, NUMBERS);
}

void move_scene(Work& work) {
  constexpr int N = 75, K = 4, WIDTHS[] = {3, 4, 3, 1, 3 * K};
  Memory memory;
  const auto fields = [&](float low, float high, int still) {  // the first rows are zero
    float* found[5];
    for (int field = 0; field < 5; ++field) {
      const auto numbers = uniform(N * WIDTHS[field], low, high);
      found[field] = memory.get<float>(numbers.size());
      std::copy(numbers.begin(), numbers.end(), found[field]);
      std::fill_n(found[field], still * WIDTHS[field], 0.0f);
    }
    return Fields<float>{found[0], found[1], found[2], found[3], found[4]};
  };
  const Fields<float> scene = fields(-6, 1, 0), gradients = fields(-1, 1, 40), mean = fields(-1, 1, 20);
  const Fields<float> square = fields(0, 1, 0);
  const float numbers[MOVE_NUMBERS] = {1,     0.9f,  0.1f,  0.999f, 0.001f, 1e-15f, 3.7f, 300,
                                       1e-3f, 5e-3f, 5e-2f, 0.01f,  0.02f,  1e5f,   0.3f};
  const auto rates = uniform(N, 1e-4f, 1e-3f), sh_rates = uniform(K, 1e-4f, 1e-3f);
  const float sh_free[K] = {1, 1, 1, 0};
  const uint32_t keys[] = {1, 2, 3, 4, 5, 6};  // of 32 rows each
  const Move move{numbers, rates.data(), sh_rates.data(), sh_free, keys, N, K, 32, true,
                  {gradients.means, gradients.quats, gradients.log_scales, gradients.opacity_logits, gradients.sh},
                  scene, mean, square};
  work.launch("move_rows", blocks_for(N), move);
  print("means", scene.means, 3 * N), print("quats", scene.quats, 4 * N), print("sh", scene.sh, 3 * K * N);
  print("m_means", mean.means, 3 * N), print("s_sh", square.sh, 3 * K * N);
}

}  // namespace

// With an argument, the rasterizer alone.
int main(int arguments, char**) {
  Memory scratch;
  open_driver(nullptr);  // the functions of driver.cc, in this program
  load_kernels(90, "");
  Work work(nullptr, [&](size_t bytes) { return scratch.get<char>(bytes); });
  rasterize_scene(work, 1 << 12);
  rasterize_scene(work, 300);  // in several rounds
  if (arguments > 1) return 0;
  project_scene(work);
  compare_pictures(work);
  move_scene(work);
}
