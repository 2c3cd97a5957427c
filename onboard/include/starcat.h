/* starcat onboard: identifies the stars of a frame with an image of a guide-star database.
 *
 * C99, freestanding: no heap, no files, no global state, no recursion. All memory is the caller's.
 * Directions are ICRS or camera unit vectors (camera frame: x right, y down, z along the
 * boresight). Pixels start at the outer corner of the top-left pixel.
 *
 * Every attitude is a matrix A or its quaternion q_body_from_icrs = [x, y, z, w]: scalar last, of
 * length 1, w >= 0. Both convert the ICRS components of a direction into its components in the
 * camera: v_camera = A v_icrs. With v = [x, y, z], the identity I, and [v x] the matrix of the
 * cross product,
 *
 *     A = (w^2 - v.v) I + 2 v v^T - 2 w [v x]
 *
 *         | 1 - 2 (y y + z z)   2 (x y + z w)       2 (x z - y w)     |
 *       = | 2 (x y - z w)       1 - 2 (x x + z z)   2 (y z + x w)     |
 *         | 2 (x z + y w)       2 (y z - x w)       1 - 2 (x x + y y) |
 *
 * This is the attitude quaternion of Wertz (1978), Shuster (1993), Markley and Crassidis (2014).
 * Libraries that rotate a vector by q v q* (Hamilton's convention: scipy, Eigen, ROS) describe the
 * same attitude by the conjugate [-x, -y, -z, w]. In scipy v_camera is
 * Rotation.from_quat(q).inv().apply(v_icrs), or Rotation.from_quat([-x, -y, -z, w]).apply(v_icrs).
 *
 * Numbers to test a conversion: Sirius at right ascension 101.287155, declination -16.716116, in a
 * camera of 1280 x 960 px with focal_length_px 3200, x0_px 640, y0_px 480, without distortion,
 * whose boresight is at right ascension 100, declination -15, with a roll of 30 (all in degrees):
 *
 *     q_body_from_icrs   -0.781300520   0.137764362   0.208208671   0.572048623
 *     v_icrs             -0.187455223   0.939217529  -0.287629922
 *     v_camera           -0.003626651   0.036746347   0.999318044
 *     pixel                 628.38680     597.66855
 *
 * The pixel is at x0_px + focal_length_px v_camera[0] / v_camera[2] and
 * y0_px + focal_length_px v_camera[1] / v_camera[2].
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_H
#define STARCAT_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define STARCAT_VERSION "0.2.0"
#define STARCAT_VERSION_MAJOR 0
#define STARCAT_VERSION_MINOR 2
#define STARCAT_VERSION_PATCH 0
#define STARCAT_VERSION_NUMBER \
  (10000 * STARCAT_VERSION_MAJOR + 100 * STARCAT_VERSION_MINOR + STARCAT_VERSION_PATCH)

/* Largest number of centroids that a frame can have, in plain digits. */
#ifndef STARCAT_MAX_CENTROIDS
#define STARCAT_MAX_CENTROIDS 64
#endif
#if (STARCAT_MAX_CENTROIDS < 4) || (STARCAT_MAX_CENTROIDS > 32767)
#error "STARCAT_MAX_CENTROIDS has to be from 4 (an answer has four stars) to 32767"
#endif

/* Largest number of stars in or near a frame; images that can exceed it are not opened. */
#ifndef STARCAT_MAX_STARS
#define STARCAT_MAX_STARS 192
#endif
#if (STARCAT_MAX_STARS < 4) || (STARCAT_MAX_STARS > 32767)
#error "STARCAT_MAX_STARS has to be from 4 (an answer has four stars) to 32767"
#endif

/* Single precision by -DSTARCAT_SINGLE, double by default. */
#ifdef STARCAT_SINGLE
#define STARCAT_REAL float
#else
#define STARCAT_REAL double
#endif
typedef STARCAT_REAL starcat_real;

/* Sizes of structures depend on these three settings, which are part of the symbols: code compiled
 * with other settings than the library does not link (..._64_192_double is undefined). */
#define STARCAT_JOINED(name, centroids, stars, real) name##_##centroids##_##stars##_##real
#define STARCAT_JOIN(name, centroids, stars, real) STARCAT_JOINED(name, centroids, stars, real)
#define STARCAT_SYMBOL(name) \
  STARCAT_JOIN(name, STARCAT_MAX_CENTROIDS, STARCAT_MAX_STARS, STARCAT_REAL)
#define starcat_get_camera STARCAT_SYMBOL(starcat_get_camera)
#define starcat_set_default_options STARCAT_SYMBOL(starcat_set_default_options)
#define starcat_list_neighbours STARCAT_SYMBOL(starcat_list_neighbours)
#define starcat_open_image STARCAT_SYMBOL(starcat_open_image)
#define starcat_identify_frame STARCAT_SYMBOL(starcat_identify_frame)
#define starcat_track_frame STARCAT_SYMBOL(starcat_track_frame)
#define starcat_fit_attitude STARCAT_SYMBOL(starcat_fit_attitude)

/* Status of a call. Values below 0 are errors of the caller or of the image. */
typedef enum {
  STARCAT_OK = 0,            /* done */
  STARCAT_IDENTIFIED = 0,    /* same value, for a frame: it has an answer */
  STARCAT_NO_MATCH = 1,      /* no attitude explains the frame beyond chance */
  STARCAT_TOO_FEW_STARS = 2, /* fewer than four usable centroids, or two directions */
  STARCAT_INCOMPLETE = 3,    /* more data or more work is needed */
  STARCAT_E_NULL = -1,       /* a pointer is null */
  STARCAT_E_SHORT = -2,      /* fewer bytes than the image states */
  STARCAT_E_MAGIC = -3,      /* not an image of starcat */
  STARCAT_E_VERSION = -4,    /* a format version that this library does not read */
  STARCAT_E_BYTE_ORDER = -5, /* written for the other byte order */
  STARCAT_E_ALIGNMENT = -6,  /* the image does not begin at a multiple of 8 */
  STARCAT_E_LAYOUT = -7,     /* sizes or sections that contradict each other */
  STARCAT_E_CRC = -8,        /* a damaged block; starcat_scrub_image returns its number */
  STARCAT_E_CAPACITY = -9,   /* more stars in a field than STARCAT_MAX_STARS */
  STARCAT_E_TOO_MANY_CENTROIDS = -10,
  STARCAT_E_NOT_FINITE = -11, /* an option, the prior or a direction is not finite */
  STARCAT_E_CAMERA = -12,     /* an impossible camera */
  STARCAT_E_OPTIONS = -13,    /* an option out of range */
  STARCAT_E_BUDGET = -14      /* the steps are used up before an answer was found */
} starcat_status;

/* Why a frame has no answer. */
typedef enum {
  STARCAT_REASON_NONE = 0,
  STARCAT_REASON_TOO_FEW_STARS = 1,
  STARCAT_REASON_NO_CANDIDATE = 2, /* no pattern of the frame is in the image */
  STARCAT_REASON_CHANCE = 3,       /* no attitude fits better than chance */
  STARCAT_REASON_SHARE = 4,        /* the best agreement does not determine the whole frame */
  STARCAT_REASON_SCALE = 5,        /* the scale or the shape of the frame is out of range */
  STARCAT_REASON_STEPS = 6         /* the steps were used up */
} starcat_reason;

/* Values of starcat_result.star for centroids without a star; rows of stars are 0 or more. */
#define STARCAT_NO_STAR (-1)
#define STARCAT_DROPPED_NOT_FINITE (-2)
#define STARCAT_DROPPED_OUT_OF_FRAME (-3)
#define STARCAT_DROPPED_DUPLICATE (-4)

/* Flags of starcat_open_image. */
#define STARCAT_SKIP_CRC 1u

/* A neighbour of a star: place in its list, position angle and magnitude in small units. */
typedef struct {
  uint16_t place;
  uint8_t turn, magnitude;
} starcat_neighbour;

/* The neighbours of every star, in memory of the application; see starcat_list_neighbours. */
typedef struct {
  starcat_real radius_rad;      /* largest separation */
  uint32_t capacity, n_stars;   /* elements of `neighbour`; stars of the image */
  uint32_t *first;              /* n_stars + 1 elements: where the lists begin */
  starcat_neighbour *neighbour; /* `capacity` elements */
} starcat_neighbours;

/* An image, used in place. Filled by starcat_open_image; its pointers point into the image. */
typedef struct {
  const uint8_t *bytes;
  uint32_t total_bytes, data_bytes, method, n_stars, n_features, n_kvector, index_bytes;
  uint32_t grid_bands, grid_sectors;
  starcat_real kvector_intercept, kvector_slope, radius_quantum_rad, longest_rad;
  starcat_real width_px, height_px, focal_length_px, epoch_jyear;
  const int32_t *directions;
  const int16_t *magnitudes;
  const int64_t *star_ids;
  const uint32_t *grid;
  const uint32_t *kvector;
  const void *features;                 /* triangles or pairs: rows of uint16_t or uint32_t */
  const uint16_t *radii;                /* null for the method pyramid */
  const char *name;                     /* up to 96 bytes, filled with zeros */
  const uint8_t *manifest_sha256;       /* 32 bytes */
  const starcat_neighbours *neighbours; /* set by the application; null: frames are not solved by
                                         * votes */
} starcat_image;

/* A camera with square pixels; Brown's distortion as in OpenCV. The corners of the frame are at
 * most 89.4 degrees from the boresight. */
typedef struct {
  starcat_real width_px, height_px; /* 1 to 1e6 */
  starcat_real focal_length_px;     /* 0.01 to 1e9 */
  starcat_real x0_px, y0_px;        /* principal point */
  starcat_real k1, k2, k3, p1, p2;  /* 0: none */
  starcat_real fold_radius;         /* largest x/z at which the distortion is valid; 0: any */
} starcat_camera;

typedef struct {
  starcat_real tolerance_px; /* largest error of a centroid, as a radius: 1e-6 to 1e6 */
  starcat_real noise_px;     /* standard deviation on each axis; 0: not stated.
                                            If stated, 1e-6 to 1e6; tolerance_px is 3 times this */
  starcat_real noise_mag;    /* standard deviation of magnitudes, up to 1e6; 0: not
                                            stated */
  starcat_real log_chance;   /* natural logarithm of the largest accepted probability
                                            that chance agrees as well; above 1e-9 it does not
                                            change the search */
  starcat_real fov_error;    /* largest relative error of the focal length, up to 0.5;
                                            if not 0, it is fitted with the attitude (method
                                            triangle only); 0: it is known */
  starcat_real camera_error; /* largest error of a calibrated camera at the corners, as a share
                                            of the half diagonal, 1e-6 to 0.1: it narrows the
                                            shapes that a frame can have; 0: not stated */
  uint32_t max_steps;        /* bound on the work; see starcat_result.steps */
} starcat_options;

/* The centroids of a frame: arrays of `count` elements. `magnitudes` and `sigma_px` can be null;
 * unknown magnitudes and noises are NaN or infinite. `sigma_px` holds standard deviations on each
 * axis, 1e-6 to 1e6 px: weights of the attitude fit, used instead of noise_px in the covariance and
 * the chi-square. */
typedef struct {
  uint32_t count;
  const starcat_real *x_px;
  const starcat_real *y_px;
  const starcat_real *magnitudes;
  const starcat_real *sigma_px;
} starcat_frame;

/* Terms of the shape of a frame. */
#define STARCAT_SHAPE_TERMS 6u

/* The answer to a frame. If a frame is not identified but `log_chance` is below 0, attitude, errors,
 * focal length and shape are those of the candidate, the best attitude of the search. No centroid
 * has a star then. If `reason` is STARCAT_REASON_CHANCE, the candidate is the answer that a
 * `log_chance` of the options as high as this one would accept. */
typedef struct {
  starcat_real q_body_from_icrs[4]; /* x, y, z, w; see the head of this file */
  starcat_real matrix[9];           /* the same attitude, A by rows: camera = A * icrs */
  starcat_real residual_rad;        /* root mean square of the matched centroids */
  starcat_real log_chance;          /* natural logarithm of the bound; 0: there is no attitude */
  uint32_t n_matched;
  uint32_t steps;                  /* steps taken */
  uint32_t n_tried;                /* attitudes verified */
  starcat_real focal_length_px;    /* as given, or as fitted */
  uint32_t reason;                 /* a starcat_reason: why there is no answer */
  uint32_t n_usable;               /* usable centroids */
  uint32_t best_n_matched;         /* if not identified: matches of the best agreement, */
  starcat_real best_log_chance;    /* its bound */
  starcat_real best_share;         /* and the share of the frame that it explains */
  starcat_real covariance_rad2[9]; /* small rotations about the camera's x, y and z, with the
                                            stated noise, else with the residuals' scatter, widened
                                            so that three standard errors cover as much (Student's
                                            t); zeros without an attitude, or if its stars determine
                                            none */
  starcat_real reduced_chi_square; /* squared residuals over the stated noise, per degree of
                                            freedom; above 2: noise too small; 0: not stated */
  starcat_real shape[STARCAT_SHAPE_TERMS]; /* how the frame differs from the camera: 0 (the scale is
                                            in focal_length_px), radial, stretch, shear, tilt in x
                                            and y; see docs/algorithms.md */
  uint32_t n_shape;                    /* number of first terms that were fitted; 0: the frame has
                                            the shape of the camera */
  int32_t star[STARCAT_MAX_CENTROIDS]; /* row in the image, or one of the negative numbers */
} starcat_result;

/* Working memory of a call. Its contents need not be set and must not be used. */
typedef struct starcat_workspace starcat_workspace;

/* The library's version as it was compiled: STARCAT_VERSION, STARCAT_VERSION_NUMBER. */
const char *starcat_version(void);
uint32_t starcat_version_number(void);

/* Fill in the camera that the image was built for, or the default options of the ground. */
starcat_status starcat_get_camera(const starcat_image *image, starcat_camera *camera);
starcat_status starcat_set_default_options(starcat_options *options);

/* Open the image of `size` bytes at `bytes`. It is used in place: nothing is copied. */
starcat_status starcat_open_image(starcat_image *image, const void *bytes, size_t size,
                                  uint32_t flags);

/* Check blocks `first` to `first + count` of an image, or every block if count is 0. On
 * STARCAT_E_CRC `bad_block` is the first damaged block. */
starcat_status starcat_scrub_image(const void *bytes, size_t size, uint32_t first, uint32_t count,
                                   uint32_t *bad_block);

/* List in `table` the neighbours of every star of an image within `radius_rad`, about half of the
 * diagonal of the field: 1e-4 to 1.57. The application sets all fields of `table` except `n_stars`.
 * If `capacity` is too small the result is STARCAT_E_CAPACITY, and first[n_stars] is the necessary
 * number of neighbours, or 0 if a star has more than STARCAT_MAX_STARS neighbours, or the image has
 * fewer than 32 stars, which need no votes. `neighbour` can be null if `capacity` is 0. To solve
 * frames by votes that triangles do not solve, set `neighbours` of the image to the table. */
starcat_status starcat_list_neighbours(const starcat_image *image, starcat_workspace *work,
                                       starcat_neighbours *table);

/* Identify the stars of a frame without any prior knowledge. STARCAT_INCOMPLETE: the frame needs the
 * neighbours, and the table of the image has none (`neighbour` is null): list them, call again. */
starcat_status starcat_identify_frame(const starcat_image *image, const starcat_camera *camera,
                                      const starcat_options *options, const starcat_frame *frame,
                                      starcat_workspace *work, starcat_result *result);

/* Identify the stars of a frame near a prior attitude, which is wrong by at most `uncertainty_rad`
 * and has the convention of `q_body_from_icrs`. Only attitudes within this error are answers, and
 * the bound is that of chance agreeing with any of them, so that fewer stars are enough. It holds
 * for a wrong prior, but not for a prior that was made of the same centroids. If more than
 * STARCAT_MAX_STARS stars can be in or near the frame, the result is STARCAT_E_CAPACITY: state a
 * smaller uncertainty. */
starcat_status starcat_track_frame(const starcat_image *image, const starcat_camera *camera,
                                   const starcat_options *options, const starcat_frame *frame,
                                   const starcat_real q_prior[4], starcat_real uncertainty_rad,
                                   starcat_workspace *work, starcat_result *result);

/* Find the attitude A that best fits pairs of unit vectors, body = A icrs. One row per vector;
 * `body` has camera components. A component beyond 2 is an error. */
starcat_status starcat_fit_attitude(const starcat_real (*body)[3], const starcat_real (*icrs)[3],
                                    uint32_t count, starcat_real q_body_from_icrs[4]);

#include "starcat_workspace.h"

#ifdef __cplusplus
}
#endif
#endif
