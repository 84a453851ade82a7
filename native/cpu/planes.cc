#include "planes.h"

#include "plane.h"

namespace splatax {
namespace {

constexpr int PART = 4096;  // rows that one thread works on at a time

// Cross product's chain rule: gradients of a and b from that of a x b.
SPLATAX_INLINE void pull_cross(const Vector& a, const Vector& b, const Vector& d, Vector& d_a, Vector& d_b) {
  d_a += cross(b, d);
  d_b += cross(d, a);
}

// The chain rule backwards through `Plane`.
struct PlanePullBack {
  const Plane& p;
  Vector d_x = zero_vector(), d_y = zero_vector(), d_near = zero_vector(), d_facing = zero_vector();
  Vector d_normal = zero_vector();
  Vector d_along[3] = {zero_vector(), zero_vector(), zero_vector()}, d_e[3] = {zero_vector(), zero_vector(), zero_vector()};
  Lanes d_slope[2], d_scale[3];
  Lanes d_disparity = broadcast(0), d_spread = broadcast(0), d_opacity = broadcast(0), d_blur = broadcast(0);
  Lanes d_u = broadcast(0), d_v = broadcast(0), d_w = broadcast(0);

  PlanePullBack(const Plane& plane, const PlaneResults<const float>& given, size_t row, int count) : p(plane) {
    const Columns<2> slopes(given.slopes + 2 * row, 2, count);
    const Vector d_unit = read_vectors(given.normals + 3 * row, count), d_axis = read_vectors(given.axes + 3 * row, count);
    for (Lanes& d : d_scale) d = broadcast(0);
    bound(slopes[0], slopes[1]);
    d_normal += p.inverse_normal * (d_unit - dot(p.unit, d_unit) * p.unit);
    Lanes d_down = broadcast(0);
    for (int n = 0; n < 2; ++n) {
      const Lanes d = -(d_slope[n] / p.down);
      d_normal += d * p.along[n];
      d_along[n] += d * p.normal;
      d_down += d * p.slope[n];
    }
    d_normal += d_down * p.along[2];
    d_along[2] += d_down * p.normal;
    axes(d_axis);
    const Vector square = p.inverse_area * p.along[2];
    d_along[2] += (p.sign * p.inverse_area) * (d_facing - dot(square, d_facing) * square);
    pull_cross(p.y, p.near, d_along[0], d_y, d_near);
    pull_cross(p.near, p.x, d_along[1], d_near, d_x);
    pull_cross(p.x, p.y, d_along[2], d_x, d_y);
  }

  void write(const PlaneRows<float>& to, size_t row, int count) const {
    Columns<9> places;
    places.set(0, or_zero(p.shown, d_x));
    places.set(3, or_zero(p.shown, d_y));
    places.set(6, or_zero(p.shown, d_near));
    places.write(to.places + 9 * row, 9, count);
    write_numbers(or_zero(p.shown, d_disparity), to.disparities + row, count);
    // Turning by a small angle about an axis moves a unit quaternion by half the product of both.
    Vector torque = zero_vector();
    for (int n = 0; n < 3; ++n) torque += cross(p.e[n], d_e[n]);
    torque = (2.0f * p.inverse_length) * torque;
    const Lanes w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3];
    const Mask turns = p.shown & p.turned;
    Columns<4> quats;
    quats.set(0, or_zero(turns, -(torque.x * x + torque.y * y + torque.z * z)));
    quats.set(1, or_zero(turns, torque.x * w + torque.y * z - torque.z * y));
    quats.set(2, or_zero(turns, torque.y * w + torque.z * x - torque.x * z));
    quats.set(3, or_zero(turns, torque.z * w + torque.x * y - torque.y * x));
    quats.write(to.quats + 4 * row, 4, count);
    const auto free = [&](int n) { return or_zero(p.shown & p.sized[n], d_scale[n]); };
    write_vectors({free(0), free(1), free(2)}, to.log_scales + 3 * row, count);
    write_vectors(or_zero(p.shown, Vector{d_u, d_v, d_w}), to.sqrt_conics + 3 * row, count);
    write_numbers(or_zero(p.shown, d_opacity), to.opacities + row, count);
    if (p.along_rays) write_numbers(or_zero(p.shown, d_blur), to.blurs + row, count);
  }

 private:
  void bound(Lanes d_first_out, Lanes d_second_out) {
    d_slope[0] = d_first_out * p.limit;
    d_slope[1] = d_second_out * p.limit;
    const Lanes drawn = where(p.limited, p.drawn, 1);
    const Lanes rate = or_zero(p.limited, (d_first_out * p.slope[0] + d_second_out * p.slope[1]) / drawn);
    d_spread = or_zero(p.by_spread, STEEPEST * rate);
    const Lanes far = where(p.by_spread, broadcast(0), rate);
    d_disparity = FARTHEST * far / p.reach;
    d_opacity = or_zero(p.reaches, -(far * p.most) / (p.reach * p.reach * where(p.reaches, p.opacity, 1)));
    const Lanes d_squared = -(rate * p.limit) / (2.0f * drawn);
    if (p.along_rays) {
      for (int n = 0; n < 2; ++n) d_slope[n] += 2.0f * (p.slope[n] * p.blur * d_squared);
      d_blur = (p.slope[0] * p.slope[0] + p.slope[1] * p.slope[1]) * d_squared;
      return;
    }
    const Lanes d_second = 2.0f * (p.second * d_squared) / p.w;
    const Lanes d_first = (2.0f * (p.first * d_squared) - d_second * p.v) / p.u;
    d_slope[0] += d_first;
    d_slope[1] += d_second;
    d_u = -(d_first * p.first);
    d_v = -(d_second * p.first);
    d_w = -(d_second * p.second);
  }

  void axes(const Vector& d_axis) {
    const Mask thick = broadcast(0) < p.spread;
    const Lanes d_square = or_zero(thick, d_spread / where(thick, p.spread, 1));  // of half the square
    for (int n = 0; n < 3; ++n) {
      const Lanes along_normal = dot(p.e[n], d_normal), d_onto = p.precision[n] * along_normal;
      const Lanes deep = dot(p.near, p.e[n]) * p.scale[n], d_deep = d_square * deep;
      d_scale[n] = d_deep * deep - or_zero(p.flatter[n], 2.0f * (p.onto[n] * d_onto));
      d_near += (d_deep * p.scale[n]) * p.e[n];
      d_facing += d_onto * p.e[n];
      d_e[n] = (p.precision[n] * p.onto[n]) * d_normal + d_onto * p.facing + (d_deep * p.scale[n]) * p.near +
               or_zero(p.shortest[n], p.flip * d_axis);
    }
  }
};

// The chain rule forwards through `Plane`.
void push(const Plane& p, const PlaneRows<const float>& to, const PlaneResults<float>& out, size_t row, int count) {
  const Columns<9> places(to.places + 9 * row, 9, count);
  const Vector d_x = places.vector(0), d_y = places.vector(3), d_near = places.vector(6);
  const Vector d_along[3] = {cross(d_y, p.near) + cross(p.y, d_near), cross(d_near, p.x) + cross(p.near, d_x),
                             cross(d_x, p.y) + cross(p.x, d_y)};
  const Vector square = p.inverse_area * p.along[2];
  const Vector d_facing = (p.sign * p.inverse_area) * (d_along[2] - dot(square, d_along[2]) * square);

  const Columns<4> d(to.quats + 4 * row, 4, count);
  const Lanes w = p.quat[0], x = p.quat[1], y = p.quat[2], z = p.quat[3];
  const Vector turn = or_zero(p.turned, (2.0f * p.inverse_length) *
                                            Vector{d[1] * w - d[0] * x + d[3] * y - d[2] * z,
                                                   d[2] * w - d[0] * y + d[1] * z - d[3] * x,
                                                   d[3] * w - d[0] * z + d[2] * x - d[1] * y});
  const Columns<3> log_scales(to.log_scales + 3 * row, 3, count);
  Vector d_normal = zero_vector(), d_axis = zero_vector();
  Lanes d_half = broadcast(0);  // of half the squared spread
  for (int n = 0; n < 3; ++n) {
    const Lanes rate = or_zero(p.sized[n], log_scales[n]);
    const Vector d_e = cross(turn, p.e[n]);
    const Lanes d_onto = dot(d_e, p.facing) + dot(p.e[n], d_facing);
    const Lanes factor = p.precision[n] * (d_onto - or_zero(p.flatter[n], 2.0f * (rate * p.onto[n])));
    d_normal += factor * p.e[n] + (p.precision[n] * p.onto[n]) * d_e;
    const Lanes deep = dot(p.near, p.e[n]) * p.scale[n];
    d_half += deep * (p.scale[n] * (dot(d_near, p.e[n]) + dot(p.near, d_e)) + rate * deep);
    d_axis += or_zero(p.shortest[n], p.flip * d_e);
  }
  const Vector d_unit = p.inverse_normal * (d_normal - dot(p.unit, d_normal) * p.unit);
  const Lanes d_down = dot(d_normal, p.along[2]) + dot(p.normal, d_along[2]);
  Lanes d_slope[2];
  for (int n = 0; n < 2; ++n) {
    d_slope[n] = -((dot(d_normal, p.along[n]) + dot(p.normal, d_along[n]) + p.slope[n] * d_down) / p.down);
  }

  Lanes d_squared;  // of half the squared deviation over the drawn ellipse
  if (p.along_rays) {
    const Lanes d_blur = read_numbers(to.blurs + row, count);
    d_squared = (p.slope[0] * d_slope[0] + p.slope[1] * d_slope[1]) * p.blur +
                0.5f * ((p.slope[0] * p.slope[0] + p.slope[1] * p.slope[1]) * d_blur);
  } else {
    const Vector d_conic = read_vectors(to.sqrt_conics + 3 * row, count);
    const Lanes d_first = (d_slope[0] - p.first * d_conic.x) / p.u;
    const Lanes d_second = (d_slope[1] - d_conic.y * p.first - p.v * d_first - p.second * d_conic.z) / p.w;
    d_squared = p.first * d_first + p.second * d_second;
  }
  const Mask thick = broadcast(0) < p.spread;
  const Lanes d_spread = or_zero(thick, d_half / where(thick, p.spread, 1));
  const Lanes d_opacity = read_numbers(to.opacities + row, count), d_disparity = read_numbers(to.disparities + row, count);
  const Lanes d_reach = or_zero(p.reaches, d_opacity / (p.reach * where(p.reaches, p.opacity, 1)));
  const Lanes d_far = (FARTHEST * d_disparity - p.most * d_reach) / p.reach;
  const Lanes drawn = where(p.limited, p.drawn, 1);
  const Lanes d_most = where(p.by_spread, STEEPEST * d_spread, d_far);
  const Lanes d_limit = or_zero(p.limited, (d_most - p.limit * d_squared / drawn) / drawn);
  write_pairs(or_zero(p.shown, d_slope[0] * p.limit + p.slope[0] * d_limit),
              or_zero(p.shown, d_slope[1] * p.limit + p.slope[1] * d_limit), out.slopes + 2 * row, count);
  write_vectors(or_zero(p.shown, d_unit), out.normals + 3 * row, count);
  write_vectors(or_zero(p.shown, d_axis), out.axes + 3 * row, count);
}

// Calls body(job, first, count) for each group of sixteen rows of each view.
template <class Job, class Body>
void each_group(int views, Workers& workers, const std::function<Job(int)>& job_of, const Body& body) {
  if (views == 0) return;
  const int total = job_of(0).of.count, parts = (total + PART - 1) / PART;
  workers.each(views * parts, [&](int task) {
    const Job job = job_of(task / parts);
    const int begin = task % parts * PART, end = std::min(begin + PART, total);
    for (int first = begin; first < end; first += LANES) body(job, first, std::min(LANES, end - first));
  });
}

}  // namespace

void find_planes(int views, Workers& workers, const std::function<FoundPlanes(int)>& job_of) {
  each_group<FoundPlanes>(views, workers, job_of, [](const FoundPlanes& job, int first, int count) {
    const Plane p(job.of, first, count);
    const size_t row = first;
    write_pairs(p.limit * p.slope[0], p.limit * p.slope[1], job.results.slopes + 2 * row, count);
    write_vectors(p.unit, job.results.normals + 3 * row, count);
    write_vectors(p.axis, job.results.axes + 3 * row, count);
  });
}

void pull_back_planes(int views, Workers& workers, const std::function<PulledBackPlanes(int)>& job_of) {
  each_group<PulledBackPlanes>(views, workers, job_of, [](const PulledBackPlanes& job, int first, int count) {
    const Plane p(job.of, first, count);
    PlanePullBack(p, job.cotangents, first, count).write(job.gradients, first, count);
  });
}

void push_planes(int views, Workers& workers, const std::function<PushedPlanes(int)>& job_of) {
  each_group<PushedPlanes>(views, workers, job_of, [](const PushedPlanes& job, int first, int count) {
    push(Plane(job.of, first, count), job.directions, job.tangents, first, count);
  });
}

}  // namespace splatax
