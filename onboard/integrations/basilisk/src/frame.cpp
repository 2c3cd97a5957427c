// SPDX-License-Identifier: MIT
#include "frame.h"

#include <algorithm>
#include <cmath>

namespace star_camera {
namespace {

constexpr double kPi = 3.14159265358979323846;
constexpr double kDegree = kPi / 180.0;
constexpr double kMoonRadius_m = 1737.4e3;
constexpr double kEarthRadius_m = 6378.137e3 + 25e3;  // air below 25 km hides stars too
constexpr double kFaintestBlend_mag = 1.0;            // beyond the limit, for light that is added
constexpr int kTries = 40;                            // to find a place on a disc

// A body that hides stars, shines on the lens and is taken for stars.
struct Body {
  Vector middle;  // direction, ICRS
  double radius_rad;
  double glare_mag, glare_rad;  // loss of limit at its edge, and the angle by which it falls to 1/e
  double lit;                   // 1: its edge at the field is in the Sun, 0: in the dark
  double false_lit, false_dark;  // false centroids that it makes
  double false_rad;              // how far beyond its edge
  double brightest_mag;          // of these, below the limit

  double above(const Vector &direction) const {
    return std::acos(std::clamp(middle.dot(direction), -1.0, 1.0)) - radius_rad;
  }
  double loss_mag(const Vector &direction) const {
    return lit * glare_mag * std::exp(-std::max(above(direction), 0.0) / glare_rad);
  }
};

// How much of the Earth's edge nearest to a direction is in the Sun.
double lit_edge(const Scene &scene, const Vector &towards) {
  const Vector down = scene.earth_m.normalized();
  const Vector aside = towards - towards.dot(down) * down;
  const double radius = std::asin(std::min(kEarthRadius_m / scene.earth_m.norm(), 1.0));
  if (aside.norm() < 1e-9) {
    return 1.0;
  }
  // Where the line of sight touches the sphere, its normal is across the line.
  const Vector edge_up = -std::sin(radius) * down + std::cos(radius) * aside.normalized();
  return std::clamp(0.5 + 5.0 * edge_up.dot(scene.sun_m.normalized()), 0.0, 1.0);
}

Body moon_of(const Scene &scene) {
  Body moon{};
  moon.middle = scene.moon_m.normalized();
  moon.radius_rad = std::asin(kMoonRadius_m / scene.moon_m.norm());
  moon.glare_mag = 4.0;
  moon.glare_rad = 1.5 * kDegree;
  moon.lit = 1.0;
  moon.false_lit = 3.0;
  moon.false_rad = 0.1 * kDegree;
  moon.brightest_mag = 5.0;
  return moon;
}

Body earth_of(const Scene &scene) {
  Body earth{};
  earth.middle = scene.earth_m.normalized();
  earth.radius_rad = std::asin(std::min(kEarthRadius_m / scene.earth_m.norm(), 1.0));
  earth.glare_mag = 6.0;
  earth.glare_rad = 6.0 * kDegree;
  earth.lit = lit_edge(scene, scene.camera_from_icrs.row(2));
  earth.false_lit = 12.0;
  earth.false_dark = 1.0;
  earth.false_rad = 0.3 * kDegree;
  earth.brightest_mag = 4.0;
  return earth;
}

Centroid measured(const Optics &optics, double x, double y, double mag, double limit_mag,
                  double streak_px, Random &random) {
  const double measured_mag = mag + optics.noise_mag * random.normal();
  const double noise = 0.2 * std::pow(10.0, 0.4 * (measured_mag - limit_mag));  // in the signal
  const double width = std::hypot(optics.spot_px, streak_px / std::sqrt(12.0));
  const double sigma = std::hypot(optics.floor_px, noise * width);
  return {x + sigma * random.normal(), y + sigma * random.normal(), measured_mag, sigma, 0, 0};
}

// Path of a direction on the detector while the shutter is open.
double streak(const Lens &lens, const Optics &optics, const Vector &rate, const Vector &u) {
  const Vector moved = u.cross(rate);
  return lens.focal_length_px * optics.exposure_s *
         std::hypot(moved.x() - moved.z() * u.x() / u.z(), moved.y() - moved.z() * u.y() / u.z()) /
         u.z();
}

// Stars that may be seen, brightest first, those within a spot of a brighter one added to it.
std::vector<Centroid> spots_of(const std::vector<Star> &sky, const Lens &lens, const Optics &optics,
                               const Scene &scene, const std::vector<Body> &bodies) {
  std::vector<Centroid> near;
  const Vector axis = scene.camera_from_icrs.row(2);
  const double edge = std::cos(lens.corner_rad() + 0.2 * kDegree);
  for (const Star &star : sky) {
    if (star.mag > optics.limit_mag + kFaintestBlend_mag || axis.dot(star.direction) < edge) {
      continue;
    }
    const Vector seen = aberrated(star.direction, scene.beta);
    Centroid at{0.0, 0.0, star.mag, 0.0, star.id, 0};
    const bool hidden = std::any_of(bodies.begin(), bodies.end(),
                                    [&](const Body &body) { return body.above(seen) < 0.0; });
    if (!hidden && lens.project(scene.camera_from_icrs * seen, at.x_px, at.y_px)) {
      near.push_back(at);
    }
  }
  std::sort(near.begin(), near.end(), [](const Centroid &a, const Centroid &b) {
    return a.mag != b.mag ? a.mag < b.mag : a.id < b.id;
  });
  std::vector<Centroid> spots;
  for (const Centroid &star : near) {
    auto spot = std::find_if(spots.begin(), spots.end(), [&](const Centroid &brighter) {
      return std::hypot(star.x_px - brighter.x_px, star.y_px - brighter.y_px) < optics.blend_px;
    });
    if (spot == spots.end()) {
      spots.push_back(star);
      continue;
    }
    const double own = std::pow(10.0, -0.4 * star.mag),
                 light = own + std::pow(10.0, -0.4 * spot->mag);
    spot->x_px += (star.x_px - spot->x_px) * own / light;
    spot->y_px += (star.y_px - spot->y_px) * own / light;
    spot->mag = -2.5 * std::log10(light);
    spot->blended_id = spot->blended_id == 0 ? star.id : spot->blended_id;
  }
  return spots;
}

bool is_seen(const Body &body, const Lens &lens, const Scene &scene) {
  for (int row = 0; row <= 16; row++) {
    for (int column = 0; column <= 16; column++) {
      const Vector u = lens.direction(lens.width_px * column / 16.0, lens.height_px * row / 16.0);
      if (body.above(scene.camera_from_icrs.transpose() * u) < 0.0) {
        return true;
      }
    }
  }
  double x, y;
  return lens.project(scene.camera_from_icrs * body.middle, x, y) && lens.contains(x, y);
}

// Pieces of a disc and of the glare at its edge that look like stars.
void add_pieces(const Body &body, const Lens &lens, const Optics &optics, const Scene &scene,
                Random &random, std::vector<Centroid> &centroids) {
  const int count = random.poisson(body.lit * body.false_lit + (1.0 - body.lit) * body.false_dark);
  // The Moon is smaller than what random places hit: they are drawn near its middle.
  double x = 0.5 * lens.width_px, y = 0.5 * lens.height_px;
  double reach = 0.5 * std::max(lens.width_px, lens.height_px);
  if (body.radius_rad < 2.0 * kDegree) {
    lens.project(scene.camera_from_icrs * body.middle, x, y);
    reach = (body.radius_rad + body.false_rad) * lens.focal_length_px;
  }
  for (int piece = 0, tries = 0; piece < count && tries < kTries * count; tries++) {
    const double at_x = x + reach * (2.0 * random.uniform() - 1.0);
    const double at_y = y + reach * (2.0 * random.uniform() - 1.0);
    const Vector u = scene.camera_from_icrs.transpose() * lens.direction(at_x, at_y);
    if (lens.contains(at_x, at_y) && body.above(u) < body.false_rad) {
      const double mag = optics.limit_mag - body.brightest_mag * random.uniform();
      centroids.push_back(measured(optics, at_x, at_y, mag, optics.limit_mag, 0.0, random));
      piece++;
    }
  }
}

}  // namespace

double Random::uniform() { return static_cast<double>(engine_() >> 11) * 0x1p-53; }

double Random::normal() {
  const double radius = std::sqrt(-2.0 * std::log(1.0 - uniform()));
  return radius * std::cos(2.0 * kPi * uniform());
}

int Random::poisson(double mean) {
  int count = 0;
  for (double left = std::exp(-mean), product = uniform(); product > left; product *= uniform()) {
    count++;
  }
  return count;
}

bool Lens::contains(double x_px, double y_px) const {
  return x_px >= 0.0 && x_px < width_px && y_px >= 0.0 && y_px < height_px;
}

Vector Lens::direction(double x_px, double y_px) const {
  return Vector(x_px - 0.5 * width_px, y_px - 0.5 * height_px, focal_length_px).normalized();
}

bool Lens::project(const Vector &direction, double &x_px, double &y_px) const {
  if (direction.z() <= 0.0) {
    return false;
  }
  x_px = 0.5 * width_px + focal_length_px * direction.x() / direction.z();
  y_px = 0.5 * height_px + focal_length_px * direction.y() / direction.z();
  return true;
}

double Lens::corner_rad() const {
  return std::atan(0.5 * std::hypot(width_px, height_px) / focal_length_px);
}

Vector aberrated(const Vector &direction, const Vector &beta) {
  const double slow = std::sqrt(1.0 - beta.squaredNorm()), along = beta.dot(direction);
  return (slow * direction + (1.0 + along / (1.0 + slow)) * beta).normalized();
}

Frame expose(const std::vector<Star> &sky, const Lens &lens, const Optics &optics,
             const Scene &scene, Random &random) {
  Frame frame;
  const std::vector<Body> bodies = {moon_of(scene), earth_of(scene)};
  frame.moon_seen = is_seen(bodies[0], lens, scene);
  frame.earth_seen = is_seen(bodies[1], lens, scene);
  frame.streak_px = streak(lens, optics, scene.rate_rad_s, Vector::UnitZ());
  std::vector<Centroid> &found = frame.centroids;
  for (const Centroid &spot : spots_of(sky, lens, optics, scene, bodies)) {
    const Vector u = lens.direction(spot.x_px, spot.y_px);
    const double path_px = streak(lens, optics, scene.rate_rad_s, u);
    double limit_mag = optics.limit_mag - 2.5 * std::log10(1.0 + path_px / (3.0 * optics.spot_px));
    for (const Body &body : bodies) {
      limit_mag -= body.loss_mag(scene.camera_from_icrs.transpose() * u);
    }
    Centroid star = measured(optics, spot.x_px, spot.y_px, spot.mag, limit_mag, path_px, random);
    star.id = spot.id;
    star.blended_id = spot.blended_id;
    const bool missed = random.uniform() < optics.missed_share;
    if (!missed && star.mag <= limit_mag && lens.contains(star.x_px, star.y_px)) {
      found.push_back(star);
    }
  }
  for (int left = random.poisson(optics.false_mean); left > 0; left--) {
    const double x = lens.width_px * random.uniform(), y = lens.height_px * random.uniform();
    const double mag = optics.limit_mag - 3.0 * random.uniform();
    found.push_back(measured(optics, x, y, mag, optics.limit_mag, 0.0, random));
  }
  const bool seen[] = {frame.moon_seen, frame.earth_seen};
  for (std::size_t n = 0; n < bodies.size(); n++) {
    if (seen[n]) {
      add_pieces(bodies[n], lens, optics, scene, random, found);
    }
  }
  std::stable_sort(found.begin(), found.end(),
                   [](const Centroid &a, const Centroid &b) { return a.mag < b.mag; });
  found.resize(std::min<std::size_t>(found.size(), optics.most_centroids));
  return frame;
}

}  // namespace star_camera
