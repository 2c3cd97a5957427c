/* Declarations that the files of the library share.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_INTERNAL_H
#define STARCAT_INTERNAL_H

#include "starcat_session.h"
#include "vectors.h"

#if defined(__FAST_MATH__) || (defined(__FINITE_MATH_ONLY__) && (__FINITE_MATH_ONLY__ > 0))
#error "compile starcat without -ffast-math: centroids that are not numbers would not be found"
#endif

/* Image format, docs/onboard-format.md. */
#define STARCAT_MAGIC "STARCAT"
#define STARCAT_FORMAT_MAJOR 1u
#define STARCAT_BYTE_ORDER 0x01020304u
#define STARCAT_BYTE_ORDER_SWAPPED 0x04030201u
#define STARCAT_HEADER_BYTES 512u
#define STARCAT_BLOCK_BYTES 4096u
#define STARCAT_CRCS_OF_BLOCK 1022u
#define STARCAT_WHOLE_AT 4088u /* offsets in a check block: CRC of all data, own CRC */
#define STARCAT_OWN_AT 4092u
#define STARCAT_TRIANGLE 1u
#define STARCAT_PYRAMID 2u
#define STARCAT_RADIUS_OVERFLOW 65535u
#define STARCAT_UNIT R(4.656612875245796924105750827168e-10) /* 1 / 2147483647 */

/* The same limits as in the ground's matcher, starcat/matcher/. */
#define STARCAT_MIN_STARS 4u
#define STARCAT_REACH R(1.5)         /* largest distance of a match, in tolerances */
#define STARCAT_FOCAL_MARGIN R(0.02) /* added to the field's radius if the focal length is fitted */
#define STARCAT_CURVATURE (R(2.0) / R(3.0))
#define STARCAT_REFINEMENTS 4u
#define STARCAT_STEPS_FROM_AFAR 16u /* of Newton's method, from a rough or damaged attitude */
#define STARCAT_LOG_CERTAIN R(-20.723265836946411156) /* of 1e-9 */
#define STARCAT_LOG_LIKELY \
  R(-6.907755278982137)               /* logarithm of 1e-3: the attitude is likely, not certain */
#define STARCAT_SIDE_TOLERANCE R(1.5) /* largest error of a side, in tolerances */
#define STARCAT_WIDER_RANGE R(2.0)    /* a scale outside of its range is searched this far */
#define STARCAT_UNKNOWNS (3u + STARCAT_SHAPE_TERMS) /* of a fit: three angles, and a shape */
#define STARCAT_LOG_ALL_ATTITUDES \
  R(4.3689013133786361) /* logarithm of 8 pi^2, the volume of all rotations */
#define STARCAT_SIGMAS_OF_TOLERANCE R(3.0)
#define STARCAT_NOTABLE_DEVIATIONS R(3.0) /* of chi-square, beyond which chance does not count */
#define STARCAT_MAG_DEVIATIONS R(3.5)
#define STARCAT_INCOMPATIBLE 4u /* whole deviations of magnitudes that differ by more */
#define STARCAT_MIN_SIDE_PX R(10.0)
#define STARCAT_COS_MIN_ANGLE R(0.96592582628906828675)   /* 15 degrees */
#define STARCAT_COS_LEAST_ANGLE R(0.99756405025982424761) /* 4 degrees */
#define STARCAT_FEW_CENTROIDS 12u
#define STARCAT_LEAST_COSINE R(0.01) /* cosine of the largest angle from the axis in a frame */
#define STARCAT_LEAST_PX R(1e-6)     /* smallest tolerance or noise */
#define STARCAT_LARGEST_PX R(1e6)
#define STARCAT_UNKNOWN_MAGNITUDE R(3e38)
/* Smallest weight of a centroid, relative to the largest, that rounding does not swamp; smallest
 * side of a triangle whose corners differ after rounding; size below which a determinant is due to
 * rounding; smallest normal number; smallest part of a row that the rows before do not explain. */
#ifdef STARCAT_SINGLE
#define STARCAT_LEAST_WEIGHT R(1e-4)
#define STARCAT_LEAST_SIDE R(1e-6)
#define STARCAT_LEAST_DETERMINANT R(1e-12)
#define STARCAT_LEAST_NUMBER R(1e-37)
#define STARCAT_LEAST_PIVOT R(1e-6)
#define STARCAT_LEAST_SQUARE R(1e-12)
#else
#define STARCAT_LEAST_WEIGHT R(1e-8)
#define STARCAT_LEAST_SIDE R(1e-15)
#define STARCAT_LEAST_DETERMINANT R(1e-60)
#define STARCAT_LEAST_NUMBER R(1e-300)
#define STARCAT_LEAST_PIVOT R(1e-13)
#define STARCAT_LEAST_SQUARE R(1e-30)
#endif
#define STARCAT_SPREAD_CENTROIDS 400u /* first centroids, which form triangles with neighbours */
#define STARCAT_MOST_TRIANGLES 5000u  /* looked up in one search */

/* The camera in the form that a call uses. */
typedef struct {
  starcat_camera given;
  real half_width, half_height; /* half of the detector, pixels */
  real cos_radius, sin_radius;  /* largest angle from the axis to a corner */
  real log_area, log_focal;     /* log of detector area in square pixels, of focal length */
  real corner[4][3];
  real corner_square; /* square of the distance of a corner from the middle, square pixels */
  real mean_scale;    /* that the radial term of a shape has over the detector, by least squares */
  int distorted;
} starcat_optics;

/* Counters of a call. They are not in the workspace, where a flipped bit could lead an index out of
 * it. starcat_limit_place bounds every index from the workspace when it is used. */
typedef struct {
  uint32_t given; /* centroids of the frame */
  uint32_t count; /* usable centroids */
  uint32_t has_magnitudes;
  uint32_t is_crowded;       /* whether separations of pairs are not listed */
  uint32_t n_near, n_within; /* stars around the field; stars within reach of it */
  uint32_t steps_left, n_tried;
  uint32_t n_looked_up; /* triangles; a search that continues skips them */
  /* A triangle that is looked up counts three, a pyramid nine, and a candidate that is tried counts
   * one for each centroid. */
  uint32_t effort, most_effort;
} starcat_counters;

/* One call. If the focal length is fitted, the camera and the directions of the centroids change
 * with each attitude that is tried; everything else stays the same during the call. */
typedef struct {
  const starcat_image *image; /* most used members come first: shorter code */
  starcat_workspace *work;
  starcat_counters *own; /* the counters below */
  real (*body)[3];
  const real *x, *y; /* places of the centroids: as given, or with a shape undone */
  real margin_px;    /* how far beyond the detector places with a shape undone can lie */
  starcat_counters counters;
  real focal, focal_px; /* focal length over the given one; the given one, pixels */
  real fov_error;       /* largest relative error of the focal length; 0: it is known */
  real log_scales, bend;
  real half_range[STARCAT_SHAPE_TERMS]; /* largest terms of a shape, of both signs */
  real tolerance_px, tolerance_rad, reach_px;
  real noise_px;       /* standard deviation of a centroid on each axis; 0: not stated */
  real columns_per_px; /* columns of the detector that list its centroids */
  real noise_mag;      /* standard deviation of magnitudes; 0: not stated, or no magnitudes */
  real log_limit;      /* largest accepted chance */
  real log_certain;
  const real *sigma_px; /* noise of the frame's centroids; null: not stated */
  const real *near;     /* prior attitude; null: the whole sky is searched */
  real log_attitudes;   /* logarithm of the volume of the attitudes that are searched */
  real near_square;     /* square of the largest distance of an answer's matrix from the prior's */
  starcat_optics camera;
} starcat_call;

/* Normal equations of an attitude and the terms of a shape; only the lower triangle is used. */
typedef struct {
  real gram[STARCAT_UNKNOWNS][STARCAT_UNKNOWNS];
  real right[STARCAT_UNKNOWNS];
} starcat_normal;

/* A step of a fit, by how much it lowers the squared residuals, and the covariance of the angles
 * for noise of one pixel. */
typedef struct {
  real change[STARCAT_UNKNOWNS];
  real gain;
  real covariance[3][3];
  real factor[STARCAT_UNKNOWNS][STARCAT_UNKNOWNS]; /* Cholesky's, of the normal equations */
  uint32_t free;                                   /* number of terms */
} starcat_step;

/* Limit an index to an array of `count` elements: one beyond the end (a flipped bit) becomes 0. */
static inline uint32_t starcat_limit_place(uint32_t place, uint32_t count) {
  return place < count ? place : 0u;
}

/* Index among the near stars of a star within reach. */
static inline uint32_t starcat_find_near(const starcat_workspace *w, uint32_t star) {
  return starcat_limit_place(w->within[star], STARCAT_MAX_STARS);
}

/* Index among the stars within reach of the star matched to a centroid. */
static inline uint32_t starcat_find_match(const starcat_workspace *w, uint32_t centroid) {
  return starcat_limit_place((uint32_t)w->match[centroid], STARCAT_MAX_STARS);
}

/* Number of terms of the shape of an agreement. */
static inline uint32_t starcat_count_terms(const starcat_agreement *found) {
  return starcat_limit_place(found->free, STARCAT_SHAPE_TERMS + 1u);
}

/* The column of the detector that contains x_px; the first or the last column outside of it. */
static inline uint32_t starcat_find_column(const starcat_call *call, real x_px) {
  const real scaled = x_px * call->columns_per_px;
  if (!(scaled > R(0.0))) {
    return 0;
  }
  return scaled < (real)STARCAT_COLUMNS ? (uint32_t)scaled : STARCAT_COLUMNS - 1u;
}

/* The direction of a star. */
static inline void starcat_read_star(const starcat_image *image, uint32_t row, real icrs[3]) {
  const int32_t *direction = image->directions + 3u * (size_t)row;
  icrs[0] = STARCAT_UNIT * (real)direction[0];
  icrs[1] = STARCAT_UNIT * (real)direction[1];
  icrs[2] = STARCAT_UNIT * (real)direction[2];
}

/* The rows of the stars of a feature. */
static inline void starcat_read_rows(const starcat_image *image, uint32_t feature, uint32_t width,
                                     uint32_t rows[3]) {
  const size_t at = (size_t)feature * width;
  if (image->index_bytes == 2u) {
    const uint16_t *indices = image->features;
    for (uint32_t n = 0; n < width; n++) {
      rows[n] = indices[at + n];
    }
  } else {
    const uint32_t *indices = image->features;
    for (uint32_t n = 0; n < width; n++) {
      rows[n] = indices[at + n];
    }
  }
}

/* image.c */
uint32_t starcat_update_crc(uint32_t crc, const uint8_t *bytes, size_t count);
int starcat_is_check_block_sound(const uint8_t *check_block);
int starcat_is_block_sound(const uint8_t *image, uint32_t data_bytes, uint32_t block);

/* numbers.c */
int starcat_is_finite(const real *number);
int starcat_are_finite(const real *numbers, uint32_t count);
real starcat_log_factorial(uint32_t n);
real starcat_exponential(real x);

/* budget.c */
int starcat_spend_steps(const starcat_call *call, uint32_t steps);
int starcat_spend_effort(const starcat_call *call, uint32_t before, uint32_t after);

/* attitude.c */
int starcat_fit_triad(const real b1[3], const real b2[3], const real a1[3], const real a2[3],
                      real m[9]);
int starcat_solve_symmetric(const real m[6], const real v[3], real x[3], real inverse[6]);
void starcat_turn_matrix(real m[9], const real w[3]);
void starcat_refine_attitude(real m[9], const real *body, const real *icrs, const uint16_t *which,
                             const real *weight, uint32_t count, uint32_t most);
void starcat_make_quaternion(const real m[9], real q[4]);
void starcat_make_matrix(const real q[4], real m[9]);

/* camera.c */
starcat_status starcat_prepare_camera(const starcat_camera *given, starcat_optics *camera);
void starcat_allow_scales(starcat_call *call, real fov_error);
int starcat_find_direction(const starcat_optics *camera, real x_px, real y_px, real body[3]);
int starcat_find_pixel(const starcat_optics *camera, const real body[3], real *x_px, real *y_px);
void starcat_find_turns(const starcat_optics *camera, const real body[3], real turn[2][3]);
void starcat_list_columns(starcat_call *call);

/* sky.c */
uint32_t starcat_gather_stars(const starcat_call *call, const real centre[3], real cos_r,
                              real sin_r, uint32_t most, uint32_t *rows, real (*icrs)[3]);

/* ways.c */
uint32_t starcat_find_deviation(const starcat_call *call, uint32_t centroid, uint32_t row);
int starcat_is_compatible(const starcat_call *call, uint32_t centroid, uint32_t row);
void starcat_count_ways(const starcat_call *call, uint32_t most);

/* chance.c */
real starcat_log_chance(const starcat_call *call, real square_px, uint32_t n_matched, uint32_t free,
                        const real terms[STARCAT_SHAPE_TERMS]);
void starcat_share_ways(const starcat_call *call, uint32_t most);
real starcat_log_ball(uint32_t dimensions, real square_px, real rate);
uint32_t starcat_find_least_matches(const starcat_call *call, uint32_t stars, real sigma_px);

/* shape.c */
void starcat_set_ranges(starcat_call *call, real camera_error);
int starcat_is_within_ranges(const starcat_call *call, const real terms[STARCAT_SHAPE_TERMS]);
int starcat_set_focal(starcat_call *call, real focal);
int starcat_use_shape(starcat_call *call, const real terms[STARCAT_SHAPE_TERMS]);
real starcat_log_growth(const starcat_call *call, const real terms[STARCAT_SHAPE_TERMS]);
void starcat_add_normal(const starcat_call *call, uint32_t centroid, real dx, real dy, real weight,
                        uint32_t free, starcat_normal *n);
void starcat_sum_normal(const starcat_call *call, uint32_t free, starcat_normal *n);
int starcat_factorise(real a[STARCAT_UNKNOWNS][STARCAT_UNKNOWNS], uint32_t count);
int starcat_solve_normal(const starcat_call *call, const starcat_normal *n,
                         const real terms[STARCAT_SHAPE_TERMS], uint32_t free, real sigma_px,
                         starcat_step *step);
int starcat_take_step(starcat_call *call, const starcat_step *step, uint32_t free, real m[9],
                      real terms[STARCAT_SHAPE_TERMS]);
real starcat_corner_error(const starcat_call *call, const starcat_step *step);
real starcat_find_influence(const starcat_call *call, uint32_t centroid, real dx, real dy,
                            real weight, starcat_step *step);

/* verify.c */
uint32_t starcat_count_fewer(const starcat_call *call);
int starcat_try_shape(starcat_call *call, real m[9], const uint32_t triple[3], const real *icrs,
                      real terms[STARCAT_SHAPE_TERMS]);
int starcat_try_attitude(starcat_call *call, const real m[9], real focal);
void starcat_project_stars(const starcat_call *call, const real m[9], real margin_px);

/* identify.c */
real starcat_widen_turn(const starcat_call *call, real turn_rad);

/* frame.c */
starcat_status starcat_check_options(const starcat_options *o);
starcat_status starcat_begin_call(starcat_call *call, const starcat_image *image,
                                  const starcat_camera *camera, const starcat_options *options,
                                  const starcat_frame *frame, starcat_workspace *work,
                                  starcat_result *result);

/* answer.c */
real starcat_find_noise(const starcat_call *call, uint32_t centroid);
real starcat_assume_noise(const starcat_call *call);
real starcat_find_sigma(const starcat_call *call, uint32_t centroid);
starcat_status starcat_end_call(starcat_call *call, const starcat_options *options,
                                starcat_result *result);

/* triangles.c, pyramids.c */
typedef int (*starcat_look_up)(starcat_call *call, const uint32_t triple[3], const real sides[3]);
real starcat_measure_side(const starcat_call *call, uint32_t i, uint32_t j);
void starcat_search_triangles(starcat_call *call, starcat_look_up look_up);
void starcat_search_shaped(starcat_call *call, uint32_t most);
void starcat_find_rows(const starcat_image *image, real low, real high, uint32_t *start,
                       uint32_t *stop);
int starcat_look_up_triangle(starcat_call *call, const uint32_t triple[3], const real sides[3]);
int starcat_look_up_pyramid(starcat_call *call, const uint32_t triple[3], const real sides[3]);

/* composite.c */
int starcat_join_frame(const starcat_image *image, const starcat_camera *camera,
                       const starcat_options *options, const starcat_frame *frame,
                       starcat_workspace *work, real turn_rad, starcat_composite *c, real *x_px,
                       real *y_px, uint32_t *steps);

/* votes.c */
#define STARCAT_MAX_VOTERS 32u /* centroids around a reference */
uint32_t starcat_count_references(const starcat_call *call);
void starcat_search_votes(starcat_call *call, uint32_t references);

#endif
