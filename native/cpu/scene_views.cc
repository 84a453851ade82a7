#include "scene_views.h"

#include <algorithm>
#include <vector>

#include "harmonics.h"
#include "views.h"

namespace splatax {
namespace {

constexpr int PART_OF_SUM = 1024;  // Gaussians whose gradients one thread sums over the views
constexpr int PULLED_BACK = 64;    // rows that are pulled back at a time

Input input_of(const SceneViews& scene, Visible& visible) {
  const float* channels = visible.colors.get();
  if (scene.channel_count == GROUP) {
    float* widened = visible.channels.at_least(GROUP * static_cast<size_t>(visible.count));
    for (int i = 0; i < visible.count; ++i) {
      for (int k = 0; k < 3; ++k) widened[GROUP * i + k] = visible.colors[3 * i + k];
      widened[GROUP * i + 3] = visible.depths[i];
    }
    channels = widened;
  }
  const float* order = scene.by_distance ? visible.distances.get() : visible.depths.get();
  return {visible.means2d.get(),   visible.sqrt_conics.get(), order,         visible.extents.get(),
          visible.opacities.get(), channels,                  visible.count, scene.channel_count,
          scene.width,             scene.height};
}

// Keeps the gradients of splats that are not all zero, without gaps, and with depths by themselves.
void compress(const Visible& visible, const SplatGradients& all, int channel_count, SplatGradients& kept) {
  const size_t most = visible.count;
  int32_t* rows = kept.rows.at_least(most);
  float *means2d = kept.means2d.at_least(2 * most), *sqrt_conics = kept.sqrt_conics.at_least(3 * most);
  float *opacities = kept.opacities.at_least(most), *colors = kept.colors.at_least(3 * most);
  float* depths = kept.depths.at_least(most);
  kept.count = 0;
  const auto none = [](const float* numbers, int count) {
    return std::all_of(numbers, numbers + count, [](float number) { return number == 0; });
  };
  for (size_t i = 0; i < most; ++i) {
    const float *d_mean = &all.means2d[2 * i], *d_root = &all.sqrt_conics[3 * i], *d_channels = &all.colors[channel_count * i];
    if (!(visible.extents[2 * i] > 0)) continue;
    if (none(d_mean, 2) && none(d_root, 3) && none(&all.opacities[i], 1) && none(d_channels, channel_count)) continue;
    const size_t to = kept.count++;
    rows[to] = visible.rows[i];
    std::copy_n(d_mean, 2, means2d + 2 * to), std::copy_n(d_root, 3, sqrt_conics + 3 * to);
    std::copy_n(d_channels, 3, colors + 3 * to);
    opacities[to] = all.opacities[i];
    depths[to] = channel_count == GROUP ? d_channels[3] : 0;
  }
}

// Projects the scene to all views, and calls body(view, visible, workers, memory) for each. A thread that works by itself
// projects a part of the scene to several views before the next part, because the scene may be larger than its caches.
template <class Body>
void each_projected(const SceneViews& scene, Workers& workers, SceneMemory& memory, const Body& body) {
  memory.bounds.fill(scene.gaussians, workers);
  const int together = std::clamp(scene.views / (2 * workers.count()), 1, VIEWS_TOGETHER);
  each_view((scene.views + together - 1) / together, workers, memory, [&](int group, Workers& threads, SceneMemory& own) {
    const int first = group * together, count = std::min(together, scene.views - first);
    if (threads.count() == 1) {
      for (int i = 0; i < count; ++i) {
        own.visible[i].count = 0;
        own.visible[i].make_room(scene.gaussians.count);
      }
      for (int part = 0; part < parts_of_scene(scene.gaussians.count); ++part) {
        for (int i = 0; i < count; ++i) own.visible[i].append(scene.gaussians, memory.bounds, scene.view(first + i), part);
      }
    }
    for (int i = 0; i < count; ++i) {
      if (threads.count() > 1) own.visible[i].collect(scene.gaussians, memory.bounds, scene.view(first + i), threads);
      body(first + i, own.visible[i], threads, own);
    }
  });
}

// Finds the gradients of the splats of one view, and keeps those that are not zero.
void keep_gradient(const SceneViews& scene, int number, const Cotangents& cotangents, Visible& visible, Workers& workers,
                   SceneMemory& memory, SplatGradients& kept) {
  const size_t count = visible.count, pixels = scene.pixels() * number, channels = scene.channel_count;
  SplatGradients& all = memory.gradients;
  const Gradients to{all.means2d.at_least(2 * count), all.sqrt_conics.at_least(3 * count), all.opacities.at_least(count),
                     all.colors.at_least(channels * count), nullptr};
  const Cotangents own{cotangents.sums + pixels * channels, cotangents.alpha + pixels, cotangents.d_sums + pixels * channels,
                       cotangents.d_alpha + pixels};
  rasterize_gradient(input_of(scene, visible), own, to, workers, memory.drawing, false, scene.max_pairs);
  compress(visible, all, scene.channel_count, kept);
}

// Gradients of up to PULLED_BACK Gaussians, one after another.
struct GradientsOfSome {
  alignas(64) float means[3 * PULLED_BACK], quats[4 * PULLED_BACK], log_scales[3 * PULLED_BACK], opacity_logits[PULLED_BACK];
  alignas(64) float sh[3 * MAX_COEFFICIENTS * PULLED_BACK];

  GaussianGradients arrays() { return {means, quats, log_scales, opacity_logits, sh, nullptr}; }

  // Adds them to these rows of arrays.
  void add_to(const GaussianGradients& to, const int32_t* rows, int count, int coefficients) const {
    const size_t numbers = 3 * static_cast<size_t>(coefficients);
    const auto add = [](const float* from, size_t size, float* sum) {
      for (size_t k = 0; k < size; ++k) sum[k] += from[k];
    };
    for (int i = 0; i < count; ++i) {
      const size_t row = rows[i];
      add(means + 3 * i, 3, to.means + 3 * row);
      add(quats + 4 * i, 4, to.quats + 4 * row);
      add(log_scales + 3 * i, 3, to.log_scales + 3 * row);
      add(opacity_logits + i, 1, to.opacity_logits + row);
      add(sh + numbers * i, numbers, to.sh + numbers * row);
    }
  }
};

// Sums the gradients of rows [begin, end) of the scene over the views, in their order.
void sum_over_views(const SceneViews& scene, const std::vector<SplatGradients>& kept, int begin, int end,
                    const GaussianGradients& to, double* cameras, size_t stride) {
  const int coefficients = scene.gaussians.coefficients;
  const auto clear = [&](float* array, size_t columns) { std::fill(array + begin * columns, array + end * columns, 0.0f); };
  clear(to.means, 3);
  clear(to.quats, 4);
  clear(to.log_scales, 3);
  clear(to.opacity_logits, 1);
  clear(to.sh, 3 * static_cast<size_t>(coefficients));
  GradientsOfSome gradient;
  float ones[2 * PULLED_BACK];  // extents: none of these splats is culled
  std::fill_n(ones, 2 * PULLED_BACK, 1.0f);
  for (int number = 0; number < scene.views; ++number) {
    const SplatGradients& d = kept[number];
    const int32_t* rows = d.rows.get();
    const size_t last = std::lower_bound(rows, rows + d.count, end) - rows;
    for (size_t at = std::lower_bound(rows, rows + d.count, begin) - rows; at < last; at += PULLED_BACK) {
      const int count = static_cast<int>(std::min<size_t>(PULLED_BACK, last - at));
      const ProjectedCotangents cotangents{d.means2d.get() + 2 * at, d.sqrt_conics.get() + 3 * at, d.depths.get() + at,
                                           d.colors.get() + 3 * at, d.opacities.get() + at, ones};
      pull_back_rows({gaussians_at(scene.gaussians, rows + at, count), scene.view(number), cotangents, gradient.arrays()},
                     cameras + number * stride);
      gradient.add_to(to, rows + at, count, coefficients);
    }
  }
}

}  // namespace

void draw_views(const SceneViews& scene, const Image& images, Workers& workers, SceneMemory& memory) {
  each_projected(scene, workers, memory, [&](int number, Visible& visible, Workers& threads, SceneMemory& own) {
    const size_t pixels = scene.pixels() * number;
    const Image image{images.sums + pixels * scene.channel_count, images.alpha + pixels};
    rasterize(input_of(scene, visible), image, threads, own.drawing, scene.max_pairs);
  });
}

void draw_views_gradient(const SceneViews& scene, const Cotangents& cotangents, const GaussianGradients& gradients,
                         Workers& workers, SceneMemory& memory) {
  if (static_cast<int>(memory.kept.size()) < scene.views) memory.kept.resize(scene.views);
  each_projected(scene, workers, memory, [&](int number, Visible& visible, Workers& threads, SceneMemory& own) {
    keep_gradient(scene, number, cotangents, visible, threads, own, memory.kept[number]);
  });
  const int total = scene.gaussians.count, parts = (total + PART_OF_SUM - 1) / PART_OF_SUM;
  // The size of parts does not depend on the number of threads, so their sums do not either.
  std::vector<double> cameras(static_cast<size_t>(scene.views) * parts * CAMERA_FIELDS, 0.0);
  const size_t stride = static_cast<size_t>(parts) * CAMERA_FIELDS;
  workers.each(parts, [&](int part) {
    const int begin = part * PART_OF_SUM, end = std::min(total - begin, PART_OF_SUM) + begin;
    sum_over_views(scene, memory.kept, begin, end, gradients, &cameras[static_cast<size_t>(part) * CAMERA_FIELDS], stride);
  });
  for (int number = 0; number < scene.views; ++number) {
    for (int field = 0; field < CAMERA_FIELDS; ++field) {
      double sum = 0;
      for (int part = 0; part < parts; ++part) sum += cameras[number * stride + part * CAMERA_FIELDS + field];
      gradients.camera[static_cast<size_t>(number) * CAMERA_FIELDS + field] = static_cast<float>(sum);
    }
  }
}

}  // namespace splatax
