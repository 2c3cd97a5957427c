#include <stdio.h>
#include "example.c"

static uint64_t words[1 << 17];

/* Counts the frames that the example identifies if each has more centroids than it may have. */
int main(int argc, char **argv) {
  FILE *file = fopen(argv[1], "rb");
  const size_t size = argc == 3 ? fread(words, 1, sizeof words, file) : 0;
  unsigned found = 0, n, k;
  double x, y, mag, q[4];
  starcat_real attitude[4];
  fclose(file);
  file = fopen(argv[2], "r");
  if (!open_catalog(words, size)) {
    return 2;
  }
  while (fscanf(file, "%u %lf %lf %lf %lf", &n, q, q + 1, q + 2, q + 3) == 5) {
    begin_frame();
    for (k = 0; k < 70; k++) {
      add_centroid((starcat_real)(13 * k + 7), (starcat_real)((389 * k) % 1024), 9);
    }
    while (n-- > 0 && fscanf(file, "%lf %lf %lf", &x, &y, &mag) == 3) {
      add_centroid((starcat_real)x, (starcat_real)y, (starcat_real)mag);
    }
    found += (unsigned)find_attitude(NULL, attitude);
  }
  printf("%u with %u centroids\n", found, (unsigned)count);
  return fclose(file);
}
