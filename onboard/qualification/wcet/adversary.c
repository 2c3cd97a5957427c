/* SPDX-License-Identifier: MIT */
#include "adversary.h"

#include <math.h>
#include <string.h>

enum {
  SEED = 0,
  LENS = 4,
  FOCAL,
  TOLERANCE,
  NOISE,
  NOISE_MAG,
  FOV,
  CHANCE,
  STEPS,
  MAGNITUDES,
  COUNT,
  KIND,
  TRACK,
  PRIOR,
  SPACING,
  ORDER,
  FALSE_SPOTS
};
#define N_KINDS 9u
#define DEFAULT_STEPS 255u /* a gene of ordinary frames alone, as it takes long */

void adversary_draw(uint64_t *state, int is_ordinary, uint8_t genes[N_GENES]) {
  for (uint32_t n = 0; n < N_GENES; n++) {
    genes[n] = (uint8_t)(256.0 * sky_uniform(state));
  }
  genes[STEPS] = (uint8_t)(genes[STEPS] % 8u);
  if (is_ordinary) {
    genes[LENS] = 1;
    genes[FOCAL] = 0;
    genes[TOLERANCE] = 107; /* 2 px */
    genes[FOV] = 0;
    genes[CHANCE] = 0;
    genes[STEPS] = DEFAULT_STEPS;
    genes[KIND] = 0;
    genes[PRIOR] = 2;
    genes[ORDER] = 0;
    genes[FALSE_SPOTS] = (uint8_t)(genes[FALSE_SPOTS] % 64u);
  }
}

void adversary_mutate(uint64_t *state, uint8_t genes[N_GENES]) {
  const uint32_t changes = 1u + (uint32_t)(3.0 * sky_uniform(state));
  for (uint32_t n = 0; n < changes; n++) {
    const uint32_t which = (uint32_t)((double)N_GENES * sky_uniform(state));
    const double step = sky_uniform(state) < 0.5 ? 256.0 : 6.0;
    genes[which] = (uint8_t)((double)genes[which] + 256.0 + step * (sky_uniform(state) - 0.5));
  }
  genes[STEPS] = (uint8_t)(genes[STEPS] % 8u);
}

/* The camera and the options. */
static void set_up(const starcat_image *image, const uint8_t *g, uint64_t *state, adversary *made) {
  static const double chances[4] = {-20.723265836946411, -300.0, -1.0, -1e9};
  static const double fov_errors[8] = {0.0, 0.0, 0.0, 0.0, 0.001, 0.02, 0.1, 0.5};
  static const double noises_mag[4] = {0.0, 0.1, 1.0, 100.0};
  starcat_camera *c = &made->camera;
  starcat_options *o = &made->options;
  (void)starcat_get_camera(image, c);
  (void)starcat_set_default_options(o);
  if (g[LENS] % 4u == 0u) {
    c->k1 = (starcat_real)(0.4 * sky_uniform(state) - 0.3);
    c->k2 = (starcat_real)(0.1 * sky_uniform(state) - 0.05);
    c->k3 = (starcat_real)(0.02 * sky_uniform(state) - 0.01);
    c->p1 = (starcat_real)(0.02 * sky_uniform(state) - 0.01);
    c->p2 = (starcat_real)(0.02 * sky_uniform(state) - 0.01);
    c->fold_radius = g[LENS] % 8u == 0u ? (starcat_real)0.9 : (starcat_real)0.0;
  }
  if (g[FOCAL] % 4u == 3u) {
    c->focal_length_px *= (starcat_real)exp2(g[FOCAL] / 32.0 - 2.0);
  }
  const double tolerance_px = 0.05 * exp2(g[TOLERANCE] / 20.0);
  o->tolerance_px = (starcat_real)tolerance_px;
  o->noise_px = (starcat_real)(g[NOISE] % 3u == 0u ? tolerance_px / 3.0 : 0.0);
  o->noise_mag = (starcat_real)noises_mag[g[NOISE_MAG] % 4u];
  o->fov_error = (starcat_real)fov_errors[g[FOV] % 8u];
  o->log_chance = (starcat_real)chances[g[CHANCE] % 4u];
  if (g[STEPS] != DEFAULT_STEPS) {
    o->max_steps = 250u << (g[STEPS] % 8u);
  }
  made->is_tracked = g[TRACK] % 4u == 0u;
  made->uncertainty_rad = (starcat_real)(0.0025 * exp2(g[PRIOR] % 8u));
  made->has_magnitudes = g[MAGNITUDES] % 4u != 0u;
  made->has_sigma = (g[MAGNITUDES] & 4u) != 0u;
}

/* Spots of a kind that no sky has. */
static void draw_spots(const uint8_t *g, const starcat_camera *c, uint64_t *state, sky_frame *sky) {
  const double width = (double)c->width_px, height = (double)c->height_px;
  const double spacing = width * (1.0 + g[SPACING]) / 2048.0;
  const uint32_t columns = 2u + g[SPACING] % 9u;
  double x = 0.5 * width, y = 0.5 * height;
  for (uint32_t n = 0; n < sky->count; n++) {
    const double angle = 2.399963 * n;
    switch (g[KIND] % N_KINDS) {
      case 3: /* anywhere */
        x = width * sky_uniform(state);
        y = height * sky_uniform(state);
        break;
      case 4: /* a lattice */
        x = 0.5 * width + spacing * ((double)(n % columns) - 0.5 * columns);
        y = 0.5 * height + spacing * ((double)(n / columns) - 0.5 * (sky->count / columns));
        break;
      case 5: /* a spiral */
        x = 0.5 * width + spacing * sqrt(n + 0.5) * cos(angle);
        y = 0.5 * height + spacing * sqrt(n + 0.5) * sin(angle);
        break;
      case 6: /* one pattern, repeated */
        if (n < columns) {
          x = 0.2 * width * sky_uniform(state);
          y = 0.2 * height * sky_uniform(state);
        } else {
          x = (double)sky->x[n - columns] + spacing;
          y = (double)sky->y[n - columns] + 0.37 * spacing;
        }
        break;
      default: /* a ring, whose sides are alike */
        x = width * (0.5 + 0.49 * cos(6.283185307179586 * n / sky->count));
        y = height * (0.5 + 0.49 * sin(6.283185307179586 * n / sky->count));
        break;
    }
    sky->x[n] = (starcat_real)x;
    sky->y[n] = (starcat_real)y;
  }
}

/* Change what the sky shows: other scale, or each star with a second spot beside it. */
static void spoil(const uint8_t *g, const adversary *made, uint64_t *state, sky_frame *sky) {
  const double x0 = 0.5 * (double)made->camera.width_px, y0 = 0.5 * (double)made->camera.height_px;
  const double reach_px = (double)made->options.tolerance_px;
  const uint32_t real_ones = sky->count;
  for (uint32_t n = 0; n < real_ones; n++) {
    if (g[KIND] % N_KINDS == 1u) {
      const double scale = 1.0 + (g[SPACING] - 128.0) / 1280.0;
      sky->x[n] = (starcat_real)(x0 + scale * ((double)sky->x[n] - x0));
      sky->y[n] = (starcat_real)(y0 + scale * ((double)sky->y[n] - y0));
    } else if ((g[KIND] % N_KINDS == 2u) && (sky->count < STARCAT_MAX_CENTROIDS)) {
      const uint32_t k = sky->count++;
      const double apart = reach_px * g[SPACING] / 64.0;
      sky->x[k] = (starcat_real)((double)sky->x[n] + apart * (2.0 * sky_uniform(state) - 1.0));
      sky->y[k] = (starcat_real)((double)sky->y[n] + apart * (2.0 * sky_uniform(state) - 1.0));
      sky->magnitudes[k] = sky->magnitudes[n];
    }
  }
}

/* The farthest from the centre first, which takes the longest to put in order. */
static void turn_round(const starcat_camera *c, sky_frame *sky) {
  for (uint32_t n = 1; n < sky->count; n++) {
    for (uint32_t k = n; k > 0u; k--) {
      const starcat_real x = sky->x[k], y = sky->y[k], left = sky->x[k - 1u], up = sky->y[k - 1u];
      const starcat_real own = (x - c->x0_px) * (x - c->x0_px) + (y - c->y0_px) * (y - c->y0_px);
      const starcat_real other =
          (left - c->x0_px) * (left - c->x0_px) + (up - c->y0_px) * (up - c->y0_px);
      if (own <= other) {
        break;
      }
      sky->x[k] = left;
      sky->y[k] = up;
      sky->x[k - 1u] = x;
      sky->y[k - 1u] = y;
    }
  }
}

void adversary_make(const starcat_image *image, const uint8_t genes[N_GENES], adversary *made) {
  const uint8_t *g = genes;
  sky_frame *sky = &made->sky;
  uint64_t state = 0;
  memcpy(&state, g + SEED, 4);
  set_up(image, g, &state, made);
  const uint32_t count = 4u + g[COUNT] % (STARCAT_MAX_CENTROIDS - 3u);
  if (g[KIND] % N_KINDS < 3u) {
    const uint32_t n_false = count * g[FALSE_SPOTS] / 320u;
    sky_look(image, &made->camera, &state, (double)made->options.tolerance_px / 6.0, count, n_false,
             sky);
    spoil(g, made, &state, sky);
  } else {
    double q[4];
    sky_rotation(&state, sky->matrix, q);
    sky->count = count;
    draw_spots(g, &made->camera, &state, sky);
    for (uint32_t n = 0; n < 4u; n++) {
      sky->q_body_from_icrs[n] = (starcat_real)q[n];
    }
    for (uint32_t n = 0; n < count; n++) {
      sky->magnitudes[n] = (starcat_real)(6.0 - 5.0 * n / count);
    }
  }
  if (g[ORDER] % 2u == 1u) {
    turn_round(&made->camera, sky);
  }
  for (uint32_t n = 0; n < sky->count; n++) {
    made->sigma_px[n] = (starcat_real)(0.05 + sky_uniform(&state));
    if ((g[MAGNITUDES] % 4u == 2u) && (sky_uniform(&state) < 0.3)) {
      sky->magnitudes[n] = (starcat_real)NAN;
    }
  }
}

starcat_status adversary_call(const starcat_image *image, const adversary *made,
                              starcat_workspace *work, starcat_result *result) {
  const sky_frame *sky = &made->sky;
  const starcat_frame frame = {sky->count, sky->x, sky->y,
                               made->has_magnitudes ? sky->magnitudes : NULL,
                               made->has_sigma ? made->sigma_px : NULL};
  return made->is_tracked
             ? starcat_track_frame(image, &made->camera, &made->options, &frame,
                                   sky->q_body_from_icrs, made->uncertainty_rad, work, result)
             : starcat_identify_frame(image, &made->camera, &made->options, &frame, work, result);
}
