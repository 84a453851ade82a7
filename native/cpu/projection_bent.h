// Lenses that distort: coordinates of a point's direction, then a map of the plane near the identity, as in
// splatax/cameras/lenses/distortion.py. `Coordinates` are `Slopes` or `Angles`; a `Map` has
//
//   COEFFICIENTS             how many numbers it has
//   bent(c, k)               the place of coordinates on the image plane, by its numbers k
//   pull(c, k, w, d_k)       the gradient of w . bent(c, k), by c and, in d_k, by k
//
// Both are templates on the number: `pull` of the places of dual numbers gives the Jacobian, its gradient and
// its tangents, because the dual number (b, a) transposes (a, b).
#pragma once

#include "duals.h"
#include "projection_lens.h"

namespace splatax {

template <class T>
struct Plane {
  T x, y;
};
SPLATAX_INLINE Plane<Dual<1>> moving(const Plane<Lanes>& at, const Plane<Lanes>& along) {
  return {{at.x, {along.x}}, {at.y, {along.y}}};
}
SPLATAX_INLINE Lanes dot(const Plane<Lanes>& a, const Plane<Lanes>& b) { return multiply_add(a.x, b.x, a.y * b.y); }
SPLATAX_INLINE Plane<Lanes> axis(int i) { return {broadcast(i == 0), broadcast(i == 1)}; }

// Coordinates of points, by which Jacobians are taken at a place near them. Also cotangents and tangents of these.
struct Seen {
  Plane<Lanes> place, near;
  Vector rows[2];  // Jacobian of the coordinates, by the point
  Lanes depth;
};

// Coordinates of a perspective, (x, y) / z. Jacobians are taken at slopes clipped to the box that the image and its
// margin show.
class Slopes : public Seen {
 public:
  enum Field { FOLD, LOW_X, LOW_Y, HIGH_X, HIGH_Y, FIELDS };

  static SPLATAX_INLINE Mask sees(const Vector& point, const float* own) {
    const Lanes x = point.x / point.z, y = point.y / point.z;
    return in_front(point) & (multiply_add(x, x, y * y) < broadcast(own[FOLD] * own[FOLD]));
  }

  SPLATAX_INLINE Slopes(const Vector& point, const float* own)
      : inverse_z_(broadcast(1) / point.z),
        x_(point.x * inverse_z_, broadcast(own[LOW_X]), broadcast(own[HIGH_X])),
        y_(point.y * inverse_z_, broadcast(own[LOW_Y]), broadcast(own[HIGH_Y])) {
    place = {point.x * inverse_z_, point.y * inverse_z_};
    near = {x_.value, y_.value};
    depth = point.z;
    rows[0] = {inverse_z_, broadcast(0), -(inverse_z_ * near.x)};
    rows[1] = {broadcast(0), inverse_z_, -(inverse_z_ * near.y)};
  }

  template <class Camera>
  SPLATAX_INLINE Vector pull(const Seen& d, Camera& camera, int first) const {
    const Lanes d_inverse = d.rows[0].x + d.rows[1].y - near.x * d.rows[0].z - near.y * d.rows[1].z;
    const Lanes d_near_x = d.near.x - inverse_z_ * d.rows[0].z, d_near_y = d.near.y - inverse_z_ * d.rows[1].z;
    camera.add(first + LOW_X, or_zero(x_.below, d_near_x));
    camera.add(first + HIGH_X, or_zero(x_.above, d_near_x));
    camera.add(first + LOW_Y, or_zero(y_.below, d_near_y));
    camera.add(first + HIGH_Y, or_zero(y_.above, d_near_y));
    const Lanes d_x = d.place.x + inside(x_, d_near_x), d_y = d.place.y + inside(y_, d_near_y);
    return {d_x * inverse_z_, d_y * inverse_z_,
            d.depth - (d_x * place.x + d_y * place.y + d_inverse * inverse_z_) * inverse_z_};
  }

  SPLATAX_INLINE Seen push(const Vector& d_point, const float* d_own) const {
    const Lanes d_x = (d_point.x - place.x * d_point.z) * inverse_z_;
    const Lanes d_y = (d_point.y - place.y * d_point.z) * inverse_z_;
    const Lanes near_x = clip_tangent(x_, d_x, d_own[LOW_X], d_own[HIGH_X]);
    const Lanes near_y = clip_tangent(y_, d_y, d_own[LOW_Y], d_own[HIGH_Y]);
    const Lanes d_inverse = -(inverse_z_ * inverse_z_ * d_point.z);
    return {{d_x, d_y},
            {near_x, near_y},
            {{d_inverse, broadcast(0), -(d_inverse * near.x + inverse_z_ * near_x)},
             {broadcast(0), d_inverse, -(d_inverse * near.y + inverse_z_ * near_y)}},
            d_point.z};
  }

 private:
  static SPLATAX_INLINE Lanes inside(const Clipped& slope, Lanes d) {
    return where(slope.below, broadcast(0), where(slope.above, broadcast(0), d));
  }
  static SPLATAX_INLINE Lanes clip_tangent(const Clipped& slope, Lanes d_slope, float d_low, float d_high) {
    return where(slope.below, broadcast(d_low), where(slope.above, broadcast(d_high), d_slope));
  }

  Lanes inverse_z_;
  Clipped x_, y_;
};

template <class Coordinates, class Map>
class Bent {
  static constexpr int NUMBERS = Map::COEFFICIENTS, MAP = CAMERA_FIELDS, OWN = MAP + NUMBERS;

 public:
  static constexpr int FIELDS = OWN + Coordinates::FIELDS;

  static SPLATAX_INLINE Mask sees(const Vector& point, const float* camera) {
    return Coordinates::sees(point, camera + OWN);
  }

  SPLATAX_INLINE Bent(const Vector& point, const View& view) : at_(point, view.camera + OWN) {
    const float* camera = view.camera;
    focal_ = {broadcast(camera[FX]), broadcast(camera[FY])};
    centre_ = {broadcast(camera[CX]), broadcast(camera[CY])};
    for (int m = 0; m < NUMBERS; ++m) numbers_[m] = broadcast(camera[MAP + m]);
    image_ = Map::bent(at_.place, numbers_);
    Lanes unused[NUMBERS];
    for (int i = 0; i < 2; ++i) {
      slopes_[i] = Map::pull(at_.near, numbers_, axis(i), unused);
      rows_[i] = slopes_[i].x * at_.rows[0] + slopes_[i].y * at_.rows[1];
    }
    jacobian[0] = focal_.x * rows_[0];
    jacobian[1] = focal_.y * rows_[1];
  }

  Vector jacobian[2];
  SPLATAX_INLINE Lanes pixel_x() const { return multiply_add(focal_.x, image_.x, centre_.x); }
  SPLATAX_INLINE Lanes pixel_y() const { return multiply_add(focal_.y, image_.y, centre_.y); }
  SPLATAX_INLINE Lanes depth() const { return at_.depth; }

  template <class Camera>
  SPLATAX_INLINE Vector pull(const ImageOfPoint& d, Camera& camera) const {
    camera.add(CX, d.x);
    camera.add(CY, d.y);
    // A culled image may be infinite.
    camera.add(FX, multiply_add(d.x, or_zero(finite(image_.x), image_.x), dot(d.jacobian[0], rows_[0])));
    camera.add(FY, multiply_add(d.y, or_zero(finite(image_.y), image_.y), dot(d.jacobian[1], rows_[1])));
    Lanes d_numbers[NUMBERS];
    Seen d_at{Map::pull(at_.place, numbers_, {d.x * focal_.x, d.y * focal_.y}, d_numbers), {}, {}, d.depth};
    for (int m = 0; m < NUMBERS; ++m) camera.add(MAP + m, d_numbers[m]);
    const Vector d_rows[2] = {focal_.x * d.jacobian[0], focal_.y * d.jacobian[1]};
    d_at.near = {broadcast(0), broadcast(0)};
    for (int i = 0; i < 2; ++i) {
      d_at.rows[i] = (i == 0 ? slopes_[0].x : slopes_[0].y) * d_rows[0] + (i == 0 ? slopes_[1].x : slopes_[1].y) * d_rows[1];
      // What is summed is the derivative of bent_i along d(slopes_i).
      const Plane<Lanes> along{dot(d_rows[i], at_.rows[0]), dot(d_rows[i], at_.rows[1])};
      Dual<1> d_duals[NUMBERS];
      const Plane<Dual<1>> d_near = Map::pull(moving(at_.near, along), numbers_, axis(i), d_duals);
      d_at.near.x += d_near.x.d[0];
      d_at.near.y += d_near.y.d[0];
      for (int m = 0; m < NUMBERS; ++m) camera.add(MAP + m, d_duals[m].d[0]);
    }
    return at_.pull(d_at, camera, OWN);
  }

  SPLATAX_INLINE ImageOfPoint push(const Vector& d_point, const float* d_camera) const {
    const Seen d_at = at_.push(d_point, d_camera + OWN);
    Dual<1> numbers[NUMBERS], unused[NUMBERS];
    for (int m = 0; m < NUMBERS; ++m) numbers[m] = {numbers_[m], {broadcast(d_camera[MAP + m])}};
    const Plane<Dual<1>> image = Map::bent(moving(at_.place, d_at.place), numbers);
    const Plane<Dual<1>> near = moving(at_.near, d_at.near);
    Vector d_rows[2];
    for (int i = 0; i < 2; ++i) {
      const Plane<Dual<1>> slopes = Map::pull(near, numbers, axis(i), unused);
      d_rows[i] = slopes.x.d[0] * at_.rows[0] + slopes.y.d[0] * at_.rows[1] + slopes_[i].x * d_at.rows[0] +
                  slopes_[i].y * d_at.rows[1];
    }
    const Lanes d_fx = broadcast(d_camera[FX]), d_fy = broadcast(d_camera[FY]);
    return {multiply_add(d_fx, image_.x, multiply_add(focal_.x, image.x.d[0], broadcast(d_camera[CX]))),
            multiply_add(d_fy, image_.y, multiply_add(focal_.y, image.y.d[0], broadcast(d_camera[CY]))),
            {d_fx * rows_[0] + focal_.x * d_rows[0], d_fy * rows_[1] + focal_.y * d_rows[1]},
            d_at.depth};
  }

 private:
  Coordinates at_;
  Plane<Lanes> focal_, centre_, image_;
  Lanes numbers_[NUMBERS];
  Plane<Lanes> slopes_[2];  // rows of the Jacobian of the map
  Vector rows_[2];          // of the image plane by the point
};

}  // namespace splatax
