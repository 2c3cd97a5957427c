/* Checks the recording of the test app against the truth, and against the library called directly:
 * every number of every attitude has to be the same, and housekeeping has to count it.
 *
 *   check_run FOLDER
 *
 * SPDX-License-Identifier: MIT
 */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "starcat.h"
#include "starcat_app_msgids.h"
#include "starcat_app_msgdefs.h"
#include "starcat_test_values.h"

#define COMMAND_HEADER 8u
#define TELEMETRY_HEADER 16u
#define MOST_BYTES (1u << 24)
#define RIGHT_DEG 0.25
#define MOST_WAITING 8u
#define MOST_SIGMAS_SQUARE 50.0 /* chi-square of three degrees of freedom: 1e-10 */

typedef STARCAT_APP_FrameTlm_Payload_t frame_in;
typedef STARCAT_APP_AttitudeTlm_Payload_t attitude_out;
typedef STARCAT_APP_HkTlm_Payload_t housekeeping;

static uint64_t bytes_of[2][1u << 17];
static starcat_image images[2];
static double truth[TEST_FRAMES][9];
static starcat_workspace work;
static starcat_result result;
static starcat_camera commanded;

static frame_in last_frame;
static frame_in waiting[MOST_WAITING]; /* frames without an attitude so far, in order */
static unsigned n_waiting, most_waiting;
static housekeeping hk; /* the last one that came */
static double prior[4];
static int has_prior;
static double prior_s;

static unsigned answers, right, wrong, unanswered, extras, packets, hks, differences;
static unsigned seen, identified, tracked, not_identified[6], without_image, errors;
static double worst_deg, worst_sigmas;

static void differ(const char *what, unsigned long sequence) {
  differences++;
  (void)fprintf(stderr, "check_run: packet %u, frame %lu: %s differs\n", packets, sequence, what);
}

static size_t read_whole(const char *folder, const char *name, void *into, size_t most) {
  char path[1024];
  (void)snprintf(path, sizeof path, "%s/%s", folder, name);
  FILE *file = fopen(path, "rb");
  if (file == NULL) {
    perror(path);
    exit(2);
  }
  const size_t size = fread(into, 1, most, file);
  (void)fclose(file);
  return size;
}

/* Compare with the truth: the angle, and the turn in its covariance. */
static void compare_with_truth(const attitude_out *out) {
  const double *q = out->Quaternion, *m = truth[out->Sequence];
  const double x = q[0], y = q[1], z = q[2], w = q[3];
  const double found[9] = {
      1 - 2 * (y * y + z * z), 2 * (x * y + w * z),     2 * (x * z - w * y),
      2 * (x * y - w * z),     1 - 2 * (x * x + z * z), 2 * (y * z + w * x),
      2 * (x * z + w * y),     2 * (y * z - w * x),     1 - 2 * (x * x + y * y)};
  double turned[9], square = 0.0;
  for (int i = 0; i < 3; i++) {
    for (int j = 0; j < 3; j++) { /* found times the truth's transpose: nearly 1 */
      turned[3 * i + j] = 0.0;
      for (int k = 0; k < 3; k++) {
        turned[3 * i + j] += found[3 * i + k] * m[3 * j + k];
      }
    }
  }
  const double e[3] = {0.5 * (turned[5] - turned[7]), 0.5 * (turned[6] - turned[2]),
                       0.5 * (turned[1] - turned[3])};
  const double trace = turned[0] + turned[4] + turned[8];
  const double deg =
      atan2(sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2]), 0.5 * (trace - 1.0)) * 57.29577951308232;
  const double *c = out->Covariance_rad2;
  /* The inverse of a symmetric matrix, by its minors. */
  const double a = c[3] * c[5] - c[4] * c[4], b = c[2] * c[4] - c[1] * c[5],
               d = c[1] * c[4] - c[2] * c[3];
  const double determinant = c[0] * a + c[1] * b + c[2] * d;
  square = (a * e[0] * e[0] + (c[0] * c[5] - c[2] * c[2]) * e[1] * e[1] +
            (c[0] * c[3] - c[1] * c[1]) * e[2] * e[2] +
            2.0 * (b * e[0] * e[1] + d * e[0] * e[2] + (c[1] * c[2] - c[0] * c[4]) * e[1] * e[2])) /
           determinant;
  worst_deg = deg > worst_deg ? deg : worst_deg;
  worst_sigmas = square > worst_sigmas ? square : worst_sigmas;
  if (deg > RIGHT_DEG) {
    wrong++;
    (void)fprintf(stderr, "check_run: frame %lu is %.3f deg off\n", (unsigned long)out->Sequence,
                  deg);
  } else {
    right++;
  }
}

/* Settings of the app, from the last housekeeping. */
static void settings(starcat_camera *camera, starcat_options *options, double *prior_rad,
                     double *age_s) {
  const int is_test_table = hk.CameraSource != STARCAT_APP_CAMERA_OF_IMAGE;
  (void)starcat_get_camera(&images[0], camera); /* also the camera of the table */
  if (hk.CameraSource == STARCAT_APP_CAMERA_OF_COMMAND) {
    *camera = commanded;
  }
  (void)starcat_set_default_options(options);
  options->log_chance = -20.723265836946411;
  options->noise_px = is_test_table ? TEST_NOISE_PX : 0.0;
  options->max_steps = hk.MaxSteps;
  *prior_rad = is_test_table ? TEST_PRIOR_RAD : FIRST_PRIOR_RAD;
  *age_s = 0.001 * (is_test_table ? TEST_AGE_MS : FIRST_AGE_MS);
}

/* The last frame by the library itself. */
static starcat_status call_directly(uint8_t *mode, uint32_t *steps, double now_s) {
  const starcat_image *image = strcmp(hk.ImageName, TEST_IMAGE_B) == 0 ? &images[1] : &images[0];
  static double numbers[4][STARCAT_MAX_CENTROIDS];
  starcat_camera camera;
  starcat_options options;
  double prior_rad = 0.0, age_s = 0.0;
  settings(&camera, &options, &prior_rad, &age_s);
  for (int n = 0; n < STARCAT_MAX_CENTROIDS; n++) {
    numbers[0][n] = (double)last_frame.X_px[n];
    numbers[1][n] = (double)last_frame.Y_px[n];
    numbers[2][n] = (double)last_frame.Magnitude[n];
    numbers[3][n] = (double)last_frame.Sigma_px[n];
  }
  const starcat_frame frame = {last_frame.Count, numbers[0], numbers[1],
                               (last_frame.Flags & 1) != 0 ? numbers[2] : NULL,
                               (last_frame.Flags & 2) != 0 ? numbers[3] : NULL};
  *steps = 0;
  if (hk.ImageName[0] == '\0') {
    *mode = STARCAT_APP_MODE_NONE;
    result.n_matched = 0;
    result.n_usable = 0;
    result.reason = STARCAT_REASON_NONE;
    return STARCAT_E_CRC;
  }
  if ((hk.Tracking == 1) && has_prior && (fabs(now_s - prior_s) < age_s - 1e-6)) {
    const starcat_status status =
        starcat_track_frame(image, &camera, &options, &frame, prior, prior_rad, &work, &result);
    *mode = STARCAT_APP_MODE_TRACK;
    *steps = result.steps;
    if (status == STARCAT_IDENTIFIED) {
      return status;
    }
  }
  *mode = STARCAT_APP_MODE_IDENTIFY;
  const starcat_status status =
      starcat_identify_frame(image, &camera, &options, &frame, &work, &result);
  *steps += result.steps;
  return status;
}

static void compare_numbers(const attitude_out *out) {
  static const int kept[6] = {0, 1, 2, 4, 5, 8};
  int is_same = (out->LogChance == result.log_chance) &&
                (out->Residual_rad == result.residual_rad) &&
                (out->ReducedChiSquare == result.reduced_chi_square);
  for (int n = 0; n < 4; n++) {
    is_same &= out->Quaternion[n] == result.q_body_from_icrs[n];
  }
  for (int n = 0; n < 6; n++) {
    is_same &= out->Covariance_rad2[n] == result.covariance_rad2[kept[n]];
  }
  if (!is_same) {
    differ("attitude", out->Sequence);
  }
}

static void count(starcat_status status, uint8_t mode) {
  seen++;
  if (mode == STARCAT_APP_MODE_NONE) {
    without_image++;
  } else if (status == STARCAT_IDENTIFIED) {
    identified += mode == STARCAT_APP_MODE_IDENTIFY;
    tracked += mode == STARCAT_APP_MODE_TRACK;
  } else if ((status > 0) || (status == STARCAT_E_BUDGET)) {
    not_identified[result.reason - 1u]++;
  } else {
    errors++;
  }
}

static void take_attitude(const uint8_t *payload) {
  attitude_out out;
  uint8_t mode = 0;
  uint32_t steps = 0;
  memcpy(&out, payload, sizeof out);
  if ((n_waiting == 0u) || (out.Sequence != waiting[0].Sequence)) {
    differ("sequence", out.Sequence);
    return;
  }
  last_frame = waiting[0];
  n_waiting--;
  memmove(waiting, waiting + 1, n_waiting * sizeof waiting[0]);
  const double now_s = (double)last_frame.Seconds + (double)last_frame.Subseconds / 4294967296.0;
  const starcat_status status = call_directly(&mode, &steps, now_s);
  count(status, mode);
  if ((out.Status != (int16)status) || (out.Mode != mode) || (out.Steps != steps) ||
      (out.Reason != result.reason) || (out.Matched != result.n_matched) ||
      (out.Usable != result.n_usable) || (out.Seconds != last_frame.Seconds) ||
      (out.Subseconds != last_frame.Subseconds)) {
    differ("answer", out.Sequence);
  }
  const int is_found = status == STARCAT_IDENTIFIED;
  if (is_found) { /* else the last attitude stays, until its age ends it */
    compare_numbers(&out);
    has_prior = 1;
    prior_s = now_s;
    memcpy(prior, result.q_body_from_icrs, sizeof prior);
  }
  if (out.Sequence >= TEST_FIRST_EXTRA) {
    extras++;
    wrong += is_found != 0;
    return;
  }
  answers++;
  if (is_found) {
    compare_with_truth(&out);
  } else {
    unanswered++;
  }
}

static void take_hk(const uint8_t *payload) {
  const housekeeping before = hk;
  memcpy(&hk, payload, sizeof hk);
  hks++;
  if ((hk.FramesIn != seen) || (hk.FramesIdentified != identified) ||
      (hk.FramesTracked != tracked) || (hk.FrameErrors != errors) ||
      (hk.FramesWithoutImage != without_image) ||
      (memcmp(hk.FramesNotIdentified, not_identified, sizeof not_identified) != 0)) {
    differ("housekeeping", hk.FramesIn);
  }
  /* Changes after which the app discards its prior. */
  if ((before.Tracking != hk.Tracking) || ((before.CameraSource != hk.CameraSource) &&
                                           (hk.CameraSource == STARCAT_APP_CAMERA_OF_TABLE))) {
    has_prior = 0;
  }
}

static void take_command(unsigned code, const uint8_t *payload) {
  STARCAT_APP_SetCamera_Payload_t given;
  if (code == STARCAT_APP_RESET_COUNTERS_CC) {
    seen = identified = tracked = errors = 0;
    memset(not_identified, 0, sizeof not_identified);
  } else if (code == STARCAT_APP_SET_CAMERA_CC) {
    memcpy(&given, payload, sizeof given);
    (void)starcat_get_camera(&images[0], &commanded);
    commanded.focal_length_px = given.Camera.FocalLength_px;
  }
}

static void take(unsigned id, size_t size, const uint8_t *packet) {
  packets++;
  switch (id) {
    case STARCAT_APP_FRAME_TLM_MID:
      if ((size == TELEMETRY_HEADER + sizeof last_frame) && (n_waiting < MOST_WAITING)) {
        memcpy(&waiting[n_waiting], packet + TELEMETRY_HEADER, sizeof last_frame);
        n_waiting++;
        most_waiting = n_waiting > most_waiting ? n_waiting : most_waiting;
      } else {
        seen++;
        errors++;
      }
      break;
    case STARCAT_APP_ATTITUDE_TLM_MID:
      take_attitude(packet + TELEMETRY_HEADER);
      break;
    case STARCAT_APP_HK_TLM_MID:
      take_hk(packet + TELEMETRY_HEADER);
      break;
    case STARCAT_APP_CMD_MID:
      take_command(packet[6], packet + COMMAND_HEADER);
      break;
    default:
      break;
  }
}

int main(int argc, char **argv) {
  static uint8_t recording[MOST_BYTES];
  static const char *const names[2] = {"starcat.img", "b.img"};
  if (argc != 2) {
    (void)fprintf(stderr, "check_run FOLDER\n");
    return 2;
  }
  for (int n = 0; n < 2; n++) {
    const size_t size = read_whole(argv[1], names[n], bytes_of[n], sizeof bytes_of[n]);
    if (starcat_open_image(&images[n], bytes_of[n], size, 0) != STARCAT_OK) {
      return 2;
    }
  }
  (void)read_whole(argv[1], "truth.bin", truth, sizeof truth);
  const size_t size = read_whole(argv[1], "run.ccsds", recording, sizeof recording);
  for (size_t at = 0; at + 6u < size;) {
    const unsigned id = (unsigned)(recording[at] << 8 | recording[at + 1u]);
    const size_t bytes = (size_t)(recording[at + 4u] << 8 | recording[at + 5u]) + 7u;
    take(id, bytes, recording + at);
    at += bytes;
  }
  (void)printf("  frames                        %6u of %u\n", answers, (unsigned)TEST_FRAMES);
  (void)printf("  right, within %.2f deg        %6u (worst %.3f deg, %.1f sigmas squared)\n",
               RIGHT_DEG, right, worst_deg, worst_sigmas);
  (void)printf("  wrong                         %6u\n", wrong);
  (void)printf("  without an answer             %6u\n", unanswered);
  (void)printf("  identified, tracked           %6u, %u\n", identified, tracked);
  (void)printf("  frames made to have none      %6u\n", extras);
  (void)printf("  frames that waited at once    %6u\n", most_waiting);
  (void)printf("  housekeeping packets          %6u\n", hks);
  (void)printf("  packets                       %6u\n", packets);
  (void)printf("  differences to the library    %6u\n", differences);
  return (answers != TEST_FRAMES) || (right != TEST_FRAMES) || (wrong > 0u) || (differences > 0u) ||
         (worst_sigmas > MOST_SIGMAS_SQUARE) || (identified + tracked != right);
}
