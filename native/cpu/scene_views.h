// A batch of views of one scene, from Gaussians to images and back, without arrays of splats in between.
#pragma once

#include <memory>
#include <mutex>
#include <vector>

#include "rasterize.h"
#include "visible.h"

namespace splatax {

// Views of a scene: colour, and the depth as a fourth channel if there are four.
struct SceneViews {
  Gaussians gaussians;
  const float* cameras;  // [views CAMERA_FIELDS]
  const float* frames;   // [views 2]: width and height of what each view fills of its image, pixels
  View settings;         // of all views; its camera and its size are not used
  int width, height;     // of the images, pixels
  int views, channel_count;
  int64_t max_pairs;
  bool by_distance;  // whether splats are drawn in the order of their distances, and not of their depths

  View view(int number) const {
    View result = settings;
    result.camera = cameras + static_cast<size_t>(number) * CAMERA_FIELDS;
    result.width = frames[2 * static_cast<size_t>(number)];
    result.height = frames[2 * static_cast<size_t>(number) + 1];
    return result;
  }
  size_t pixels() const { return static_cast<size_t>(width) * height; }
};

constexpr int VIEWS_TOGETHER = 8;

// Memory of a call, which is kept for the next one.
struct SceneMemory {
  Scratch drawing;
  Visible visible[VIEWS_TOGETHER];   // of the views that a thread draws together
  SplatGradients gradients;          // of all splats of a view; `colors` has all channels
  std::vector<std::unique_ptr<SceneMemory>> threads;  // one for each thread that draws views by itself
  Bounds bounds;                     // of the scene
  std::vector<SplatGradients> kept;  // gradients that are not zero, for each view
};

// Lends memory to each call, and keeps the last one that came back.
class SceneMemories {
 public:
  std::unique_ptr<SceneMemory> take() {
    const std::lock_guard<std::mutex> lock(mutex_);
    return kept_ ? std::move(kept_) : std::make_unique<SceneMemory>();
  }
  void give_back(std::unique_ptr<SceneMemory> memory) {
    const std::lock_guard<std::mutex> lock(mutex_);
    kept_ = std::move(memory);
  }

 private:
  std::mutex mutex_;
  std::unique_ptr<SceneMemory> kept_;
};

// Writes sums [views height width channel_count] and alpha [views height width].
void draw_views(const SceneViews& scene, const Image& images, Workers& workers, SceneMemory& memory);

// Writes the gradients: of the scene summed over the views, and of each camera. `cotangents` are those of all images.
void draw_views_gradient(const SceneViews& scene, const Cotangents& cotangents, const GaussianGradients& gradients,
                         Workers& workers, SceneMemory& memory);

}  // namespace splatax
