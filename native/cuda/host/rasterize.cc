#include "rasterize.h"

#include <algorithm>

#include "sorting.h"

namespace splatax::cuda {
namespace {

int bits_for(int numbers) {
  int bits = 1;
  while (bits < 31 && (1 << bits) < numbers) ++bits;
  return bits;
}

// Everything that the functions below share.
struct Pass {
  Work& work;
  const SplatRows& splats;
  const Frame& frame;
  const Sizes& sizes;
  Lists lists;

  const uint32_t* pair_total() const { return lists.by_depth.offsets + sizes.count; }

  Round round(int begin, int end) const {
    const uint32_t* offsets = lists.by_depth.offsets;
    return {begin, end, {sizes.capacity, offsets + begin, offsets + end}};
  }
};

// Calls visit(first, size) for each group of channels that are blended together.
template <class Visit>
void each_group(int channels, const Visit& visit) {
  for (int first = 0; first < channels;) {
    const int left = channels - first, size = left >= 4 ? 4 : left == 3 ? 3 : 1;
    visit(first, size);
    first += size;
  }
}

void sort_by_depth(const Pass& pass) {
  Work& work = pass.work;
  const Work::Scope scope(work);
  const int n = pass.sizes.count, blocks = blocks_for(n);
  auto* counts = work.allocate<uint32_t>(n);
  const KeysAndValues unsorted{work.allocate<uint32_t>(n), work.allocate<uint32_t>(n)};
  work.launch("count_tiles", blocks, pass.splats, pass.frame, counts, unsorted.keys, unsorted.values);
  const KeysAndValues sorted = sort(work, Items{n, nullptr, nullptr}, 32, unsorted);
  work.launch("order_counts", blocks, n, static_cast<const uint32_t*>(sorted.values),
              static_cast<const uint32_t*>(counts), pass.lists.by_depth);
  prefix_sums(work, n, pass.lists.by_depth.offsets, pass.lists.by_depth.offsets);
}

void list_pairs(const Pass& pass, const Round& round) {
  Work& work = pass.work;
  const Work::Scope scope(work);
  const int capacity = pass.sizes.capacity, tiles = pass.sizes.tiles;
  const KeysAndValues unsorted{work.allocate<uint32_t>(capacity), work.allocate<uint32_t>(capacity)};
  work.launch("emit_pairs", blocks_for(round.end - round.begin), pass.splats, pass.frame, pass.lists.by_depth, round,
              unsorted.keys, unsorted.values, pass.lists.tiles.owners);
  const KeysAndValues sorted = sort(work, round.pairs, bits_for(tiles), unsorted);
  work.launch("find_starts", blocks_for(static_cast<int64_t>(capacity) + 1), round.pairs, tiles,
              static_cast<const uint32_t*>(sorted.keys), static_cast<const uint32_t*>(sorted.values),
              pass.lists.tiles);
  work.launch("count_chunks", blocks_for(tiles), tiles, pass.lists.tiles);
  prefix_sums(work, tiles, pass.lists.tiles.first_chunks, pass.lists.tiles.first_chunks);
}

void blend(const Pass& pass, Image image) {
  each_group(pass.splats.channel_count, [&](int first, int size) {
    image.first = first;
    pass.work.launch("blend_" + std::to_string(size), pass.sizes.tiles, pass.splats, pass.frame, pass.lists.tiles,
                     image);
  });
}

// Rounds whose pairs fit into the lists. Each splat alone fits, because there is room for one pair a tile.
std::vector<Round> several_rounds(const Pass& pass) {
  const size_t n = pass.sizes.count;
  const std::vector<uint32_t> offsets = pass.work.read(pass.lists.by_depth.offsets, n + 1);
  if (offsets[n] == UINT32_MAX) throw Failure("the splats touch more than 2^32 tiles in sum, which is not supported");
  std::vector<Round> rounds;
  for (size_t begin = 0; begin < n;) {
    const uint64_t most = uint64_t{offsets[begin]} + pass.sizes.capacity;
    const size_t end = std::upper_bound(offsets.begin() + begin, offsets.end(), most) - offsets.begin() - 1;
    rounds.push_back(pass.round(static_cast<int>(begin), static_cast<int>(end)));
    begin = end;
  }
  return rounds;
}

bool fits(const Pass& pass, uint32_t pairs) { return pairs <= static_cast<uint32_t>(pass.sizes.capacity); }

// Calls after_each(round) once a round is blended. The groups of channels blend the same splats, so each has its
// own transmittance between rounds.
void blend_in_rounds(const Pass& pass, const Image& image, const std::vector<Round>& rounds,
                     const std::function<void(const Round&)>& after_each) {
  const size_t pixels = static_cast<size_t>(pass.frame.width) * pass.frame.height;
  std::vector<float*> light;
  each_group(pass.splats.channel_count, [&](int, int) { light.push_back(pass.work.allocate<float>(pixels)); });
  for (const Round& round : rounds) {
    list_pairs(pass, round);
    size_t group = 0;
    each_group(pass.splats.channel_count, [&](int first, int size) {
      Image part = image;
      part.first = first;
      part.light = light[group++];
      part.continues = round.begin > 0;
      pass.work.launch("blend_" + std::to_string(size), pass.sizes.tiles, pass.splats, pass.frame, pass.lists.tiles,
                       part);
    });
    after_each(round);
  }
}

void add_gradients(const Pass& pass, const Round& round, ImageGradient image, SplatGradients gradients,
                   const PairRecords& records) {
  const int chunks = static_cast<int>(pass.sizes.chunks());
  each_group(pass.splats.channel_count, [&](int first, int size) {
    image.first = gradients.first = first;
    pass.work.clear(records.written, pass.sizes.capacity);
    const std::string kind = gradients.pull ? "blend_gradient_pulled_" : "blend_gradient_";
    pass.work.launch(kind + std::to_string(size), chunks, pass.splats, pass.frame, round.pairs, pass.lists.tiles,
                     image, records);
    pass.work.launch("add_records_" + std::to_string(size), blocks_for(round.end - round.begin), pass.splats,
                     pass.lists.by_depth, round, records, gradients);
  });
}

}  // namespace

Frame frame_of(int width, int height) { return {width, height, blocks_for(width, TILE), blocks_for(height, TILE)}; }

Sizes::Sizes(const SplatRows& splats, const Frame& frame, int64_t max_pairs)
    : count(splats.count), tiles(frame.columns * frame.rows),
      capacity(static_cast<int>(std::max<int64_t>(max_pairs, tiles))) {}

size_t Sizes::words() const {
  return 2 * static_cast<size_t>(count) + 1 + 2 * static_cast<size_t>(capacity) + 3 * static_cast<size_t>(tiles) + 2;
}

size_t Sizes::chunks() const { return static_cast<size_t>(capacity) / CHUNK + tiles; }

Lists::Lists(const Sizes& sizes, uint32_t* words, float* checkpoints) {
  const auto next = [&](size_t count) {
    uint32_t* begin = words;
    words += count;
    return begin;
  };
  by_depth.order = next(sizes.count);
  by_depth.offsets = next(sizes.count + size_t{1});
  tiles.pairs = next(sizes.capacity);
  tiles.owners = next(sizes.capacity);
  tiles.starts = next(sizes.tiles + size_t{1});
  tiles.first_chunks = next(sizes.tiles + size_t{1});
  tiles.last_chunks = next(sizes.tiles);
  tiles.checkpoints = checkpoints;
}

void rasterize(Work& work, const SplatRows& splats, const Frame& frame, const Sizes& sizes, const Lists& lists,
               const Image& image) {
  const Pass pass{work, splats, frame, sizes, lists};
  sort_by_depth(pass);
  Count pairs(pass.pair_total(), work.stream());
  list_pairs(pass, pass.round(0, sizes.count));
  blend(pass, image);
  if (fits(pass, pairs.wait())) return;
  blend_in_rounds(pass, image, several_rounds(pass), [](const Round&) {});
}

void rasterize_gradient(Work& work, const SplatRows& splats, const Frame& frame, const Sizes& sizes,
                        const Lists& lists, const ImageGradient& image, const SplatGradients& gradients) {
  Pass pass{work, splats, frame, sizes, lists};
  Count pairs(pass.pair_total(), work.stream());
  const PairRecords records{work.allocate<float>(static_cast<size_t>(sizes.capacity) * RECORD),
                            work.allocate<uint8_t>(sizes.capacity)};
  add_gradients(pass, pass.round(0, sizes.count), image, gradients, records);
  if (fits(pass, pairs.wait())) return;

  // Only the last round's lists were kept: each round is listed and blended again, then its gradient is added.
  const Lists own(sizes, work.allocate<uint32_t>(sizes.words()),
                  work.allocate<float>(sizes.chunks() * (1 + splats.channel_count) * PIXELS));
  pass.lists.tiles = own.tiles;
  const size_t pixels = static_cast<size_t>(frame.width) * frame.height;
  const Image again{work.allocate<float>(pixels * splats.channel_count), work.allocate<float>(pixels), nullptr, 0,
                    false};
  blend_in_rounds(pass, again, several_rounds(pass),
                  [&](const Round& round) { add_gradients(pass, round, image, gradients, records); });
}

}  // namespace splatax::cuda
