// XLA custom call of a training step of the rows of a scene.
#include "handlers.h"

namespace splatax::cuda {
namespace {

constexpr int64_t MOST_GAUSSIANS = 1 << 30;
constexpr int64_t MOST_COEFFICIENTS = 25;  // degree 4
constexpr size_t FIELDS = 5;
enum Place : size_t {  // of arguments; scene, gradients and moments have FIELDS arrays each
  SCENE,
  GRADIENTS = FIELDS,
  MEAN = 2 * FIELDS,
  SQUARE = 3 * FIELDS,
  NUMBERS = 4 * FIELDS,
  MEAN_RATES,
  SH_RATES,
  SH_FREE,
  KEYS
};

// Returns an argument or a result. Throws Failure if there is none, or if it has another type.
template <class Array, class Arrays>
auto array(const Arrays& arrays, size_t place) {
  const auto found = arrays.template get<Array>(place);
  if (!found.has_value()) throw Failure("array " + std::to_string(place) + " is missing or of another type");
  return *found;
}

// Checks the fields from `first` on; returns pointers to their numbers.
template <class Number, class Arrays>
Fields<Number> fields(Checks& checks, const char* name, const Arrays& arrays, size_t first, int64_t n, int64_t k) {
  const auto numbers = [&](size_t at, std::initializer_list<int64_t> expected) {
    auto field = array<FloatArray>(arrays, first + at);
    checks.shape(name, field, expected);
    if constexpr (std::is_same_v<Arrays, ffi::RemainingRets>) {
      return field->typed_data();
    } else {
      return field.typed_data();
    }
  };
  return {numbers(0, {n, 3}), numbers(1, {n, 4}), numbers(2, {n, 3}), numbers(3, {n}), numbers(4, {n, k, 3})};
}

// Copies fields to the results, unless XLA gave both one buffer.
void hold(Work& work, const Fields<float>& from, const Fields<float>& to, int64_t n, int64_t k) {
  work.copy(to.means, from.means, 3 * n * sizeof(float));
  work.copy(to.quats, from.quats, 4 * n * sizeof(float));
  work.copy(to.log_scales, from.log_scales, 3 * n * sizeof(float));
  work.copy(to.opacity_logits, from.opacity_logits, n * sizeof(float));
  work.copy(to.sh, from.sh, 3 * n * k * sizeof(float));
}

ffi::Error moved(Context& context, const ffi::RemainingArgs& arguments, const ffi::RemainingRets& results,
                 int64_t block) {
  auto sh = array<FloatArray>(arguments, SCENE + FIELDS - 1), mean_rates = array<FloatArray>(arguments, MEAN_RATES);
  auto numbers = array<FloatArray>(arguments, NUMBERS), sh_rates = array<FloatArray>(arguments, SH_RATES);
  auto sh_free = array<FloatArray>(arguments, SH_FREE);
  auto keys = array<ffi::Buffer<ffi::U32>>(arguments, KEYS);
  Checks checks;
  const auto [n, k, three] = checks.sizes<3>("sh", sh);
  const auto [rates] = checks.sizes<1>("mean_rates", mean_rates);
  checks.range("the number of Gaussians", n, 0, MOST_GAUSSIANS);
  checks.range("the number of SH coefficients", k, 1, MOST_COEFFICIENTS);
  checks.range("the rows of a block", block, 1, MOST_ROWS);
  if (checks.failed()) return checks.error("move");
  const auto scene = fields<float>(checks, "a field of the scene", arguments, SCENE, n, k);
  const auto gradients = fields<const float>(checks, "a gradient", arguments, GRADIENTS, n, k);
  const auto mean = fields<float>(checks, "a mean", arguments, MEAN, n, k);
  const auto square = fields<float>(checks, "a square", arguments, SQUARE, n, k);
  const auto new_scene = fields<float>(checks, "a moved field", results, 0, n, k);
  const auto new_mean = fields<float>(checks, "a new mean", results, FIELDS, n, k);
  const auto new_square = fields<float>(checks, "a new square", results, 2 * FIELDS, n, k);
  checks.shape("numbers", numbers, {MOVE_NUMBERS}).shape("mean_rates", mean_rates, {rates == 1 ? 1 : n});
  checks.shape("sh_rates", sh_rates, {k}).shape("sh_free", sh_free, {k});
  checks.shape("keys", keys, {(n + block - 1) / block, 2});
  if (checks.failed()) return checks.error("move");
  return queued("move", context, [&, n = n, k = k, rates = rates](Work& work) {
    hold(work, scene, new_scene, n, k);
    hold(work, mean, new_mean, n, k);
    hold(work, square, new_square, n, k);
    const Move move{numbers.typed_data(),  mean_rates.typed_data(), sh_rates.typed_data(),   sh_free.typed_data(),
                    keys.typed_data(),     static_cast<int>(n),     static_cast<int>(k),     static_cast<int>(block),
                    rates != 1,            gradients,               new_scene,               new_mean,
                    new_square};
    work.launch("move_rows", blocks_for(n), move);
  });
}

ffi::Error move(SPLATAX_CONTEXT ffi::RemainingArgs arguments, ffi::RemainingRets results, int64_t block) {
  SPLATAX_TAKE_CONTEXT;
  try {
    return moved(context, arguments, results, block);
  } catch (const Failure& failure) {
    return ffi::Error::InvalidArgument(std::string("splatax: move: ") + failure.what());
  }
}

}  // namespace
}  // namespace splatax::cuda

#pragma GCC visibility push(default)

using namespace splatax;

// (the fields of a scene, of its gradients, of the first and of the second moments: means [n 3], quats [n 4],
// log_scales [n 3], opacity_logits [n], sh [n k 3]; numbers as MoveNumber, mean_rates [1 or n], sh_rates [k],
// sh_free [k], keys [b 2]) -> the fields of the moved scene and of its moments
XLA_FFI_DEFINE_HANDLER_SYMBOL(splatax_cuda_move, cuda::move,
                              cuda::call().RemainingArgs().RemainingRets().Attr<int64_t>("block"));

#pragma GCC visibility pop
