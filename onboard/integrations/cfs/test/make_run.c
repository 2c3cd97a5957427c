/* Writes what the test app plays, for a folder: images of two made-up skies, damaged ones, and frames.
 *
 *   make_run FOLDER
 *
 * The frames are payloads of the app's messages; truth.bin has the attitude of each, a matrix by rows.
 *
 * SPDX-License-Identifier: MIT
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "random_sky.h"
#include "starcat_app_msgdefs.h"
#include "starcat_test_values.h"

#define STARS 450u
#define LONGEST_RAD 0.42
#define NOISE_PX 0.3
#define MOST_SPOTS 16u
#define SLEW_RAD 0.003 /* a frame */
#define BLOCK 4096u
#define SCALE 2147483647.0

static uint64_t words[2][SKY_MOST_BYTES / 8u];
static size_t sizes[2];
static starcat_image images[2];
static starcat_camera camera;

static FILE *create(const char *folder, const char *name) {
  char path[1024];
  (void)snprintf(path, sizeof path, "%s/%s", folder, name);
  FILE *file = fopen(path, "wb");
  if (file == NULL) {
    perror(path);
    exit(2);
  }
  return file;
}

static void write_whole(const char *folder, const char *name, const void *bytes, size_t size) {
  FILE *file = create(folder, name);
  if ((fwrite(bytes, 1, size, file) != size) || (fclose(file) != 0)) {
    perror(name);
    exit(2);
  }
}

static uint8_t *put_number(uint8_t *at, uint32_t number) {
  while (number >= 0x80u) {
    *at++ = (uint8_t)(number | 0x80u);
    number >>= 7;
  }
  *at++ = (uint8_t)number;
  return at;
}

/* Write a step: the given bytes of the new image, or, without any, bytes of the old one. */
static uint8_t *put_step(uint8_t *at, const uint8_t *given, size_t count, uint32_t back) {
  at = put_number(at, (uint32_t)count * 8u + (given == NULL ? 1u : 0u));
  if (given == NULL) {
    return put_number(at, 2u * back);
  }
  memcpy(at, given, count);
  return at + count;
}

/* CRC-32, as in docs/onboard-format.md, of some more bytes. */
static uint32_t add_to_crc(uint32_t crc, const uint8_t *bytes, size_t count) {
  crc = ~crc;
  for (size_t n = 0; n < 8u * count; n++) {
    const uint32_t bit = (crc ^ ((uint32_t)bytes[n / 8u] >> (n % 8u))) & 1u;
    crc = (crc >> 1) ^ (bit != 0u ? 0xedb88320u : 0u);
  }
  return ~crc;
}

/* The patch that gives the first image another name: its first block, and the block of checks. */
static void make_patch(const char *folder) {
  static uint64_t renamed[SKY_MOST_BYTES / 8u];
  static uint8_t patch[4u * BLOCK];
  uint8_t *bytes = (uint8_t *)renamed;
  const size_t size = sizes[0], check = size - BLOCK;
  memcpy(renamed, words[0], size);
  memcpy(bytes + 160, TEST_PATCHED, strlen(TEST_PATCHED));
  sky_seal(bytes);
  const uint32_t header[8] = {0x01020304u, 2u, (uint32_t)size, 0u, (uint32_t)size, 0u, 0u, 0u};
  memcpy(patch, "STARPAT", 8);
  memcpy(patch + 8, header, sizeof header);
  memcpy(patch + 20, (uint8_t *)words[0] + size - 8u, 4);
  memcpy(patch + 28, bytes + size - 8u, 4);
  uint8_t *at = put_step(patch + 44, bytes, BLOCK, 0);
  at = put_step(at, NULL, check - BLOCK, BLOCK);
  at = put_step(at, bytes + check, BLOCK, 0);
  const uint32_t patch_bytes = (uint32_t)(at - patch);
  memcpy(patch + 36, &patch_bytes, 4);
  const uint32_t crc = add_to_crc(add_to_crc(0, patch, 40), patch + 44, patch_bytes - 44u);
  memcpy(patch + 40, &crc, 4);
  write_whole(folder, "a.patch", patch, patch_bytes);
}

static void make_images(const char *folder) {
  static const char *const names[2] = {TEST_IMAGE_A, TEST_IMAGE_B};
  static const char *const files[2] = {"starcat.img", "b.img"};
  static uint8_t copy[8u * BLOCK * 1024u];
  for (uint32_t n = 0; n < 2u; n++) {
    const sky_recipe recipe = {1, 2, STARS, LONGEST_RAD, 8u + n};
    uint8_t *bytes = (uint8_t *)words[n];
    sizes[n] = sky_image(&recipe, bytes);
    memset(bytes + 128, n == 0u ? 0xaa : 0xbb, 32);
    memset(bytes + 160, 0, 96);
    memcpy(bytes + 160, names[n], strlen(names[n]));
    sky_seal(bytes);
    if (starcat_open_image(&images[n], bytes, sizes[n], 0) != STARCAT_OK) {
      (void)fprintf(stderr, "make_run: no image\n");
      exit(1);
    }
    write_whole(folder, files[n], bytes, sizes[n]);
  }
  make_patch(folder);
  (void)starcat_get_camera(&images[0], &camera);
  memcpy(copy, words[0], sizes[0]);
  copy[5u * BLOCK + 17u] ^= 4u;
  write_whole(folder, "damaged.img", copy, sizes[0]);
  memcpy(copy, words[0], sizes[0]);
  copy[0] ^= 4u;
  write_whole(folder, "headless.img", copy, sizes[0]);
  write_whole(folder, "cut.img", words[0], sizes[0] - 2u * BLOCK);
  write_whole(folder, "odd.img", words[0], sizes[0] - 5u);
  write_whole(folder, "big.img", copy, sizeof copy);
}

/* What the camera sees of a sky from an attitude: stars, off by the noise, and false spots. */
static uint32_t look(uint32_t sky, const double m[9], uint32_t n_false, uint64_t *state,
                     STARCAT_APP_FrameTlm_Payload_t *frame) {
  uint32_t count = 0;
  for (uint32_t row = 0; (row < images[sky].n_stars) && (count < MOST_SPOTS - n_false); row++) {
    double body[3];
    for (uint32_t i = 0; i < 3u; i++) {
      body[i] = 0.0;
      for (uint32_t j = 0; j < 3u; j++) {
        body[i] += m[3u * i + j] * images[sky].directions[3u * row + j] / SCALE;
      }
    }
    const double focal = (double)camera.focal_length_px, most = (double)camera.width_px;
    const double x = body[0] / body[2] * focal + (double)camera.x0_px;
    const double y = body[1] / body[2] * focal + (double)camera.y0_px;
    if ((body[2] > 0.5) && (x > 1.0) && (x < most - 1.0) && (y > 1.0) && (y < most - 1.0)) {
      frame->X_px[count] = (float)(x + NOISE_PX * sky_normal(state));
      frame->Y_px[count] = (float)(y + NOISE_PX * sky_normal(state));
      frame->Magnitude[count] = (float)(0.001 * images[sky].magnitudes[row]);
      frame->Sigma_px[count] = (float)NOISE_PX;
      count++;
    }
  }
  for (uint32_t n = 0; n < n_false; n++) {
    frame->X_px[count] = (float)(sky_uniform(state) * (double)camera.width_px);
    frame->Y_px[count] = (float)(sky_uniform(state) * (double)camera.height_px);
    frame->Magnitude[count] = 5.0f + 0.1f * (float)n;
    frame->Sigma_px[count] = (float)NOISE_PX;
    count++;
  }
  return count;
}

/* Turn an attitude about the camera's y axis. */
static void turn(double m[9], double angle_rad) {
  const double c = cos(angle_rad), s = sin(angle_rad);
  for (uint32_t j = 0; j < 3u; j++) {
    const double x = m[j], z = m[6u + j];
    m[j] = c * x - s * z;
    m[6u + j] = s * x + c * z;
  }
}

static void make_frames(const char *folder, const char *name, uint32_t first, uint32_t n_frames,
                        uint32_t sky, int is_slew, FILE *truth) {
  FILE *file = create(folder, name);
  uint64_t state = 100u + first;
  double m[9], q[4];
  sky_rotation(&state, m, q);
  for (uint32_t n = 0; n < n_frames; n++) {
    STARCAT_APP_FrameTlm_Payload_t frame;
    do {
      if (is_slew) {
        turn(m, SLEW_RAD);
      } else {
        sky_rotation(&state, m, q);
      }
      memset(&frame, 0, sizeof frame);
      frame.Sequence = first + n;
      frame.Flags = (uint16)(n % 3u == 2u ? STARCAT_APP_HAS_MAGNITUDES | STARCAT_APP_HAS_SIGMAS
                                          : STARCAT_APP_HAS_MAGNITUDES);
      frame.Count = (uint16)look(sky, m, n % 3u, &state, &frame);
    } while (frame.Count < 8u + n % 3u); /* patches of the sky with hardly a star */
    if ((fwrite(&frame, sizeof frame, 1, file) != 1u) || (fwrite(m, sizeof m, 1, truth) != 1u)) {
      exit(2);
    }
  }
  (void)fclose(file);
}

int main(int argc, char **argv) {
  if (argc != 2) {
    (void)fprintf(stderr, "make_run FOLDER\n");
    return 2;
  }
  make_images(argv[1]);
  FILE *truth = create(argv[1], "truth.bin");
  make_frames(argv[1], "frames-a.bin", 0, TEST_FRAMES_A, 0, 0, truth);
  make_frames(argv[1], "frames-slew.bin", TEST_FIRST_SLEW, TEST_FRAMES_SLEW, 0, 1, truth);
  make_frames(argv[1], "frames-b.bin", TEST_FIRST_B, TEST_FRAMES_B, 1, 0, truth);
  (void)printf("make_run: images of %u bytes, %u frames\n", (unsigned)sizes[0],
               (unsigned)TEST_FRAMES);
  return fclose(truth) != 0;
}
