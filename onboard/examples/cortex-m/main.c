/* The library on a Cortex-M4F or a Cortex-M7: the image stays in flash, memory is static, numbers are
 * single precision. Prints the memory map, the answers to the frames of frames.h with the instructions
 * and the steps that they took, the deepest stack, and the floating-point exceptions since the start.
 * Semihosting prints; a board would have a UART, and count cycles with DWT->CYCCNT.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>

#include "clock.h"
#include "frames.h"
#include "starcat.h"

#define PAINT 0x5ca7ca75u
#define PRIOR_RAD ((starcat_real)0.00872664625997164788) /* half a degree, as in replay.c */
#define FPSCR_INVALID_DIVISION_OVERFLOW 0x7u

extern const uint64_t image_begin[], image_end[]; /* image.S */
extern uint32_t stack_begin[], stack_end[];       /* flash.ld */

static starcat_workspace work;
static starcat_result result;
static starcat_image image;

static void print_place(const char *what, const void *at, size_t bytes) {
  (void)printf("%-24s 0x%08lx %7lu bytes\n", what, (unsigned long)(uintptr_t)at,
               (unsigned long)bytes);
}

/* Paint the memory below this function's own frame; the painted words are counted afterwards. */
static void paint_stack(void) {
  const uint32_t *const here = __builtin_frame_address(0);
  for (volatile uint32_t *word = stack_begin; word + 16 < here; word++) {
    *word = PAINT;
  }
}

static size_t stack_used(void) {
  const uint32_t *word = stack_begin;
  while (*word == PAINT) {
    word++;
  }
  return (size_t)((const char *)stack_end - (const char *)word);
}

static uint32_t exceptions(void) {
  uint32_t fpscr;
  __asm volatile("vmrs %0, fpscr" : "=r"(fpscr));
  return fpscr & FPSCR_INVALID_DIVISION_OVERFLOW;
}

int main(void) {
  starcat_camera camera;
  starcat_options options;
  size_t deepest = 0;
  uint32_t identified = 0;
  const size_t size = (size_t)((const char *)image_end - (const char *)image_begin);
  print_place("image, in flash", image_begin, size);
  print_place("workspace", &work, sizeof work);
  print_place("result", &result, sizeof result);
  print_place("opened image", &image, sizeof image);
  print_place("room for the stack", stack_begin, (size_t)(stack_end - stack_begin) * 4u);

  starcat_status status = starcat_open_image(&image, image_begin, size, 0);
  if (status != STARCAT_OK) {
    (void)printf("the image is not opened: %d\n", (int)status);
    return 2;
  }
  (void)starcat_get_camera(&image, &camera);
  (void)starcat_set_default_options(&options);
  options.noise_px = (starcat_real)NOISE_PX; /* 0: not stated */
  options.noise_mag = (starcat_real)NOISE_MAG;
  clock_start();
  for (uint32_t n = 0; n < N_FRAMES; n++) {
    const uint32_t first = FIRST[n], count = FIRST[n + 1u] - first;
    const starcat_frame frame = {count, X_PX + first, Y_PX + first, MAGNITUDES + first, NULL};
    paint_stack();
    const uint64_t began = clock_now();
    status = IS_TRACKED ? starcat_track_frame(&image, &camera, &options, &frame, Q_PRIOR + 4u * n,
                                              PRIOR_RAD, &work, &result)
                        : starcat_identify_frame(&image, &camera, &options, &frame, &work, &result);
    const uint64_t took = clock_now() - began;
    const size_t used = stack_used();
    deepest = used > deepest ? used : deepest;
    identified += (uint32_t)(status == STARCAT_IDENTIFIED);
    (void)printf("frame %lu: %d", (unsigned long)n, (int)status);
    for (uint32_t i = 0; i < count; i++) {
      (void)printf(" %ld", (long)result.star[i]);
    }
    (void)printf("\ntook %lu %lu\n", (unsigned long)took, (unsigned long)result.steps);
  }
  (void)printf("identified %lu of %lu frames, deepest stack %lu bytes, exceptions %lu\n",
               (unsigned long)identified, (unsigned long)N_FRAMES, (unsigned long)deepest,
               (unsigned long)exceptions());
  return exceptions() == 0u ? 0 : 1;
}
