/* Makes the next image from the image in use and a patch, as flight software does.
 *
 *   patch IMAGE PATCH NEXT
 *
 * IMAGE and PATCH are files of `starcat export --to onboard --patch-from`; NEXT is written.
 *
 * SPDX-License-Identifier: MIT
 */
#include <stdio.h>
#include <stdlib.h>

#include "starcat_update.h"

#define CAPACITY (16u * 1048576u) /* bytes of a slot */

/* The two slots, and memory for a patch: static, as in flight software. */
static uint64_t places_of_images[2][CAPACITY / 8u], patch[CAPACITY / 8u];

static size_t read_file(const char *path, uint64_t *into) {
  FILE *file = fopen(path, "rb");
  size_t size = 0;
  if (file != NULL) {
    size = fread(into, 1, CAPACITY, file);
    (void)fclose(file);
  }
  return size;
}

/* Accept whatever image is in a slot, by the CRC that it states, 8 bytes before its end. Flight
 * software examines the image first: its signature, or the CRC that the ground has sent. */
static starcat_status accept(starcat_slots *slots, uint32_t slot) {
  const size_t size = slots->size[slot];
  return size < 8192u
             ? STARCAT_E_SHORT
             : starcat_accept_image(
                   slots, slot, *(const uint32_t *)(const void *)(slots->bytes[slot] + size - 8u));
}

int main(int argc, char **argv) {
  starcat_image image;
  starcat_slots slots = {0};
  if (argc != 4) {
    (void)fprintf(stderr, "patch IMAGE PATCH NEXT\n");
    return 2;
  }
  slots.bytes[0] = (uint8_t *)places_of_images[0];
  slots.bytes[1] = (uint8_t *)places_of_images[1];
  slots.capacity = CAPACITY;
  slots.size[0] = read_file(argv[1], places_of_images[0]);
  starcat_status status = accept(&slots, 0);
  if (status == STARCAT_OK) {
    status = starcat_start_image(&slots, &image);
  }
  if (status != STARCAT_OK) {
    (void)fprintf(stderr, "%s: cannot be used, status %d\n", argv[1], (int)status);
    return 1;
  }
  status = starcat_apply_patch(&slots, patch, read_file(argv[2], patch));
  if (status == STARCAT_OK) {
    status = accept(&slots, 1);
  }
  if (status == STARCAT_OK) {
    status = starcat_switch_image(&slots, &image);
  }
  if (status != STARCAT_OK) {
    (void)fprintf(stderr, "%s: cannot be applied, status %d\n", argv[2], (int)status);
    return 1;
  }
  FILE *next = fopen(argv[3], "wb");
  if ((next == NULL) || (fwrite(image.bytes, 1, image.total_bytes, next) != image.total_bytes) ||
      (fclose(next) != 0)) {
    (void)fprintf(stderr, "%s: cannot be written\n", argv[3]);
    return 1;
  }
  (void)printf("%.96s in place %u\n", image.name, (unsigned)slots.active);
  return 0;
}
