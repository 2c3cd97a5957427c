/* SPDX-License-Identifier: MIT */
#include "random_sky.h"

#include <math.h>
#include <stdlib.h>
#include <string.h>

#define SCALE 2147483647.0
#define BLOCK 4096u
#define WIDTH_PX 512u
#define FOCAL_LENGTH_PX 703.35 /* 40 degrees across */
#define BANDS 6u
#define SECTORS 12u
#define MOST_FEATURES 40000u
#define QUANTUM_RAD 4e-5

typedef struct {
  uint32_t stars[3];
  double value, radius, longest;
} feature;

typedef struct {
  int32_t u[3];
  int16_t mag;
  int64_t id;
  uint32_t cell;
} star;

static star stars[SKY_MOST_STARS];
static feature features[MOST_FEATURES];

double sky_uniform(uint64_t *state) {
  uint64_t z = (*state += 0x9e3779b97f4a7c15u);
  z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
  z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
  return (double)((z ^ (z >> 31)) >> 11) / 9007199254740992.0;
}

double sky_normal(uint64_t *state) {
  const double radius = sqrt(-2.0 * log(1.0 - sky_uniform(state)));
  return radius * cos(6.283185307179586 * sky_uniform(state));
}

void sky_rotation(uint64_t *state, double m[9], double q[4]) {
  double square = 0.0;
  for (int n = 0; n < 4; n++) {
    q[n] = sky_normal(state);
    square += q[n] * q[n];
  }
  const double scale = (q[3] < 0.0 ? -1.0 : 1.0) / sqrt(square);
  for (int n = 0; n < 4; n++) {
    q[n] *= scale;
  }
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) {
      /* (w^2 - v^2) I + 2 v v' - 2 w [v x] */
      const int k = i == j ? 0 : 3 - i - j;
      const double sign = (j - i + 3) % 3 == 1 ? 1.0 : -1.0;
      const double turned = i == j ? 2.0 * q[3] * q[3] - 1.0 : sign * 2.0 * q[3] * q[k];
      m[3 * i + j] = 2.0 * q[i] * q[j] + turned;
    }
  }
}

static double separation(uint32_t a, uint32_t b) {
  double less = 0.0, more = 0.0;
  for (int n = 0; n < 3; n++) {
    const double p = stars[a].u[n] / SCALE, q = stars[b].u[n] / SCALE;
    less += (p - q) * (p - q);
    more += (p + q) * (p + q);
  }
  return 2.0 * atan2(sqrt(less), sqrt(more));
}

static uint32_t cell_of(const int32_t u[3]) {
  const double x = u[0] / SCALE, y = u[1] / SCALE, z = u[2] / SCALE;
  const double t = y / (fabs(x) + fabs(y));
  double p = t;
  if ((x < 0.0) || ((x <= 0.0) && (y > 0.0))) {
    p = 2.0 - t;
  } else if (y < 0.0) {
    p = 4.0 + t;
  }
  const uint32_t band = (uint32_t)((z + 1.0) / 2.0 * BANDS), sector = (uint32_t)(p / 4.0 * SECTORS);
  return (band < BANDS ? band : BANDS - 1u) * SECTORS + (sector < SECTORS ? sector : SECTORS - 1u);
}

static int by_cell(const void *a, const void *b) {
  const star *p = a, *q = b;
  if (p->cell != q->cell) {
    return p->cell < q->cell ? -1 : 1;
  }
  return p->id < q->id ? -1 : 1;
}

static int by_value(const void *a, const void *b) {
  const feature *p = a, *q = b;
  return p->value < q->value ? -1 : (p->value > q->value);
}

static void make_stars(const sky_recipe *recipe) {
  uint64_t state = recipe->seed;
  for (uint32_t n = 0; n < recipe->n_stars; n++) {
    double v[3], square = 0.0;
    for (int k = 0; k < 3; k++) {
      v[k] = sky_normal(&state);
      square += v[k] * v[k];
    }
    for (int k = 0; k < 3; k++) {
      stars[n].u[k] = (int32_t)rint(v[k] / sqrt(square) * SCALE);
    }
    stars[n].id = (int64_t)n + 1;
    stars[n].mag = (int16_t)(n % 50u == 49u ? -32768 : (int)(1000u + 4500u * n / recipe->n_stars));
    stars[n].cell = cell_of(stars[n].u);
  }
  qsort(stars, recipe->n_stars, sizeof stars[0], by_cell);
}

static void add_triangle(const sky_recipe *recipe, uint32_t i, uint32_t j, uint32_t k,
                         uint32_t *count) {
  const double a = separation(j, k), b = separation(i, k), c = separation(i, j);
  const double s = 0.5 * (a + b + c);
  feature *f = features + *count;
  f->longest = fmax(a, fmax(b, c));
  if ((f->longest <= recipe->longest_rad) && (*count < MOST_FEATURES)) {
    f->stars[0] = i;
    f->stars[1] = j;
    f->stars[2] = k;
    f->value = sqrt(fmax(s * (s - a) * (s - b) * (s - c), 0.0));
    f->radius = a * b * c / fmax(4.0 * f->value, 1e-30);
    (*count)++;
  }
}

static uint32_t make_features(const sky_recipe *recipe) {
  const uint32_t n_stars = recipe->n_stars;
  uint32_t count = 0;
  for (uint32_t i = 0; i < n_stars; i++) {
    for (uint32_t j = i + 1u; j < n_stars; j++) {
      const double apart = separation(i, j);
      if (apart > recipe->longest_rad) {
        continue;
      }
      if (recipe->method == 2u) {
        const feature pair = {{i, j, 0}, apart, 0.0, apart};
        features[count] = pair;
        count += count < MOST_FEATURES - 1u;
      }
      for (uint32_t k = j + 1u; (recipe->method == 1u) && (k < n_stars); k++) {
        add_triangle(recipe, i, j, k, &count);
      }
    }
  }
  qsort(features, count, sizeof features[0], by_value);
  return count;
}

static void put32(uint8_t *bytes, size_t at, uint32_t value) { memcpy(bytes + at, &value, 4); }
static void put64(uint8_t *bytes, size_t at, double value) { memcpy(bytes + at, &value, 8); }

static uint32_t get32(const uint8_t *bytes, size_t at) {
  uint32_t value;
  memcpy(&value, bytes + at, 4);
  return value;
}

static void put_index(uint8_t *bytes, size_t n, uint32_t index_bytes, uint32_t value) {
  const uint16_t narrow = (uint16_t)value;
  if (index_bytes == 2u) {
    memcpy(bytes + 2u * n, &narrow, 2);
  } else {
    memcpy(bytes + 4u * n, &value, 4);
  }
}

/* Enter a section into the table and return where the next one may begin. */
static size_t enter(uint8_t *bytes, uint32_t kind, size_t at, uint32_t count, uint32_t element) {
  const uint32_t n = get32(bytes, 60);
  put32(bytes, 256u + 16u * n, kind);
  put32(bytes, 260u + 16u * n, (uint32_t)at);
  put32(bytes, 264u + 16u * n, count * element);
  put32(bytes, 268u + 16u * n, element);
  put32(bytes, 60, n + 1u);
  return (at + (size_t)count * element + 63u) & ~(size_t)63u;
}

static uint32_t crc_of(const uint8_t *bytes, size_t count) {
  static uint32_t table[256];
  uint32_t crc = 0xffffffffu;
  for (uint32_t n = 0; (n < 256u) && (table[255] == 0u); n++) {
    uint32_t entry = n;
    for (int bit = 0; bit < 8; bit++) {
      entry = (entry >> 1) ^ ((entry & 1u) != 0u ? 0xedb88320u : 0u);
    }
    table[n] = entry;
  }
  for (size_t n = 0; n < count; n++) {
    crc = (crc >> 8) ^ table[(crc ^ bytes[n]) & 255u];
  }
  return ~crc;
}

void sky_seal(uint8_t *bytes) {
  const uint32_t total = get32(bytes, 20), data = get32(bytes, 24);
  memset(bytes + data, 0, total - data);
  for (uint32_t n = 0; n < data / BLOCK; n++) {
    const size_t check = data + (size_t)(n / 1022u) * BLOCK;
    put32(bytes, check + 4u * (n % 1022u), crc_of(bytes + (size_t)n * BLOCK, BLOCK));
  }
  for (size_t check = data; check < total; check += BLOCK) {
    put32(bytes, check + 4088u, crc_of(bytes, data));
    put32(bytes, check + 4092u, crc_of(bytes + check, 4092));
  }
}

static void put_header(const sky_recipe *recipe, uint32_t count, uint8_t *bytes) {
  const uint16_t major = 1;
  memcpy(bytes, "STARCAT", 8);
  put32(bytes, 8, 0x01020304u);
  memcpy(bytes + 12, &major, 2);
  put32(bytes, 16, 512);
  put32(bytes, 28, recipe->method);
  put32(bytes, 32, recipe->n_stars);
  put32(bytes, 36, count);
  put32(bytes, 40, count / 4u + 2u);
  put32(bytes, 44, recipe->index_bytes);
  put32(bytes, 48, BANDS);
  put32(bytes, 52, SECTORS);
  put32(bytes, 56, recipe->n_stars / 8u);
  put32(bytes, 64, WIDTH_PX);
  put32(bytes, 68, WIDTH_PX);
  put64(bytes, 72, FOCAL_LENGTH_PX);
  put64(bytes, 80, 2026.0);
  put64(bytes, 104, recipe->method == 1u ? QUANTUM_RAD : 0.0);
  put32(bytes, 120, BLOCK);
  memset(bytes + 128, 0xa5, 32);
  memcpy(bytes + 160, "sky-1.0.0", 9);
}

static size_t put_stars(const sky_recipe *recipe, uint8_t *bytes) {
  const uint32_t n_stars = recipe->n_stars;
  size_t at = 512, next = enter(bytes, 1, at, n_stars, 12);
  uint32_t cell = 0;
  for (uint32_t n = 0; n < n_stars; n++) {
    memcpy(bytes + at + 12u * n, stars[n].u, 12);
  }
  at = next;
  next = enter(bytes, 2, at, n_stars, 2);
  for (uint32_t n = 0; n < n_stars; n++) {
    memcpy(bytes + at + 2u * n, &stars[n].mag, 2);
  }
  at = next;
  next = enter(bytes, 3, at, n_stars, 8);
  for (uint32_t n = 0; n < n_stars; n++) {
    memcpy(bytes + at + 8u * n, &stars[n].id, 8);
  }
  at = next;
  next = enter(bytes, 4, at, BANDS * SECTORS + 1u, 4);
  for (uint32_t n = 0; n <= n_stars; n++) {
    for (; cell <= (n < n_stars ? stars[n].cell : BANDS * SECTORS); cell++) {
      put32(bytes, at + 4u * cell, n);
    }
  }
  return next;
}

static size_t put_features(const sky_recipe *recipe, uint32_t count, size_t at, uint8_t *bytes) {
  const uint32_t n_kvector = count / 4u + 2u, width = recipe->method == 1u ? 3u : 2u;
  const double intercept = features[0].value - 1e-6;
  const double slope = (features[count - 1u].value + 1e-6 - intercept) / (double)(n_kvector - 1u);
  double longest = 0.0;
  size_t next = enter(bytes, 5, at, n_kvector, 4);
  put64(bytes, 88, intercept);
  put64(bytes, 96, slope);
  for (uint32_t k = 0, n = 0; k < n_kvector; k++) {
    while ((n < count) && (features[n].value <= intercept + slope * (double)k)) {
      n++;
    }
    put32(bytes, at + 4u * k, n);
  }
  at = next;
  next = enter(bytes, recipe->method == 1u ? 6u : 8u, at, count, width * recipe->index_bytes);
  for (uint32_t n = 0; n < count; n++) {
    longest = fmax(longest, features[n].longest);
    for (uint32_t k = 0; k < width; k++) {
      put_index(bytes + at, (size_t)n * width + k, recipe->index_bytes, features[n].stars[k]);
    }
  }
  put64(bytes, 112, longest);
  if (recipe->method == 1u) {
    at = next;
    next = enter(bytes, 7, at, count, 2);
    for (uint32_t n = 0; n < count; n++) {
      put_index(bytes + at, n, 2, (uint32_t)fmin(rint(features[n].radius / QUANTUM_RAD), 65535.0));
    }
  }
  return next;
}

size_t sky_image(const sky_recipe *recipe, uint8_t *bytes) {
  memset(bytes, 0, SKY_MOST_BYTES);
  make_stars(recipe);
  const uint32_t count = make_features(recipe);
  put_header(recipe, count, bytes);
  const size_t end = put_features(recipe, count, put_stars(recipe, bytes), bytes);
  const uint32_t data = (uint32_t)((end + BLOCK - 1u) / BLOCK * BLOCK);
  put32(bytes, 20, data + BLOCK);
  put32(bytes, 24, data);
  sky_seal(bytes);
  return data + BLOCK;
}

/* Put a star on the detector. Returns 0 if it is not there. */
static int project(const starcat_image *image, const starcat_camera *camera, uint32_t row,
                   const double m[9], double *x, double *y) {
  double body[3];
  for (int i = 0; i < 3; i++) {
    body[i] = 0.0;
    for (int j = 0; j < 3; j++) {
      body[i] += m[3 * i + j] * (image->directions[3u * row + (uint32_t)j] / SCALE);
    }
  }
  const double u = body[0] / body[2], v = body[1] / body[2], s = u * u + v * v;
  const double k1 = (double)camera->k1, k2 = (double)camera->k2, k3 = (double)camera->k3;
  const double p1 = (double)camera->p1, p2 = (double)camera->p2;
  const double f = (double)camera->focal_length_px;
  const double factor = 1.0 + s * (k1 + s * (k2 + s * k3)) + 2.0 * (p2 * u + p1 * v);
  *x = (u * factor + s * p2) * f + (double)camera->x0_px;
  *y = (v * factor + s * p1) * f + (double)camera->y0_px;
  return (body[2] > 0.5) && (*x > 0.0) && (*x < (double)camera->width_px) && (*y > 0.0) &&
         (*y < (double)camera->height_px);
}

void sky_look(const starcat_image *image, const starcat_camera *camera, uint64_t *state,
              double noise_px, uint32_t n_spots, uint32_t n_false, sky_frame *frame) {
  double q[4];
  sky_rotation(state, frame->matrix, q);
  for (int n = 0; n < 4; n++) {
    frame->q_body_from_icrs[n] = (starcat_real)q[n];
  }
  frame->count = 0;
  for (uint32_t row = 0; (row < image->n_stars) && (frame->count < n_spots - n_false); row++) {
    double x = 0.0, y = 0.0;
    if (project(image, camera, row, frame->matrix, &x, &y)) {
      const uint32_t n = frame->count++;
      frame->x[n] = (starcat_real)(x + noise_px * sky_normal(state));
      frame->y[n] = (starcat_real)(y + noise_px * sky_normal(state));
      const int16_t stored = image->magnitudes[row];
      frame->magnitudes[n] = (starcat_real)(0.001 * (stored == INT16_MIN ? 7000 : stored));
      frame->star[n] = (int32_t)row;
    }
  }
  for (uint32_t n = 0; n < n_false; n++) {
    frame->x[frame->count] = (starcat_real)(sky_uniform(state) * (double)camera->width_px);
    frame->y[frame->count] = (starcat_real)(sky_uniform(state) * (double)camera->height_px);
    frame->magnitudes[frame->count] = (starcat_real)(5.5 + 0.1 * n);
    frame->star[frame->count++] = -1;
  }
}
