// Centroids of a frame as a star camera in a low orbit would measure them.
//
// Stars of a list, with aberration, blended where they are closer than the width of a spot; a limit
// that falls with smear and with the glare of the Moon and the sunlit Earth; discs that hide stars and
// break up into false centroids; stars that are missed; false ones anywhere. Pixels are counted from
// the outer corner of the top-left one; camera axes are x right, y down, z along the boresight.
//
// SPDX-License-Identifier: MIT
#ifndef STARCAT_BASILISK_FRAME_H
#define STARCAT_BASILISK_FRAME_H

#include <Eigen/Dense>
#include <cstdint>
#include <random>
#include <vector>

namespace star_camera {

using Vector = Eigen::Vector3d;
using Matrix = Eigen::Matrix3d;

// Numbers that depend on the seed alone, not on the compiler's library.
class Random {
 public:
  explicit Random(std::uint64_t seed) : engine_(seed) {}
  double uniform();                 // 0 to 1
  double normal();                  // mean 0, standard deviation 1
  int poisson(double mean);

 private:
  std::mt19937_64 engine_;
};

struct Star {
  Vector direction;                 // where the catalog has it, ICRS
  double mag;
  std::int64_t id;
};

struct Centroid {
  double x_px, y_px, mag, sigma_px;
  std::int64_t id, blended_id;      // of the star and of one blended with it; 0: none
};

struct Lens {
  double width_px, height_px, focal_length_px;

  bool contains(double x_px, double y_px) const;
  Vector direction(double x_px, double y_px) const;
  // False for what is behind the camera.
  bool project(const Vector &direction, double &x_px, double &y_px) const;
  double corner_rad() const;
};

// What the camera measures, and how well.
struct Optics {
  double exposure_s = 0.1;
  double limit_mag = 6.5;           // of a camera at rest and a dark sky: signal is 5 times the noise
  double noise_mag = 0.1;
  double floor_px = 0.06;           // error of the brightest centroids
  double spot_px = 1.2;             // standard deviation of a spot
  double blend_px = 3.0;            // stars closer than this are one spot
  double missed_share = 0.03;
  double false_mean = 1.5;          // false centroids of a frame: hot pixels, protons
  int most_centroids = 40;          // the brightest of them
};

// What there is to see, in ICRS axes. Positions are from the camera, metres.
struct Scene {
  Matrix camera_from_icrs;
  Vector rate_rad_s;                // of the camera, in its axes
  Vector beta;                      // velocity in that of light
  Vector sun_m, moon_m, earth_m;
};

struct Frame {
  std::vector<Centroid> centroids;
  double streak_px = 0.0;           // in the middle
  bool moon_seen = false, earth_seen = false;
};

// Where an observer of a velocity sees a direction; with the opposite velocity, back again.
Vector aberrated(const Vector &direction, const Vector &beta);

Frame expose(const std::vector<Star> &sky, const Lens &lens, const Optics &optics,
             const Scene &scene, Random &random);

}  // namespace star_camera

#endif
