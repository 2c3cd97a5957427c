#!/bin/sh
# SPDX-License-Identifier: MIT
# What must not go unseen: a caller who was compiled otherwise than the library, limits that cannot
# work, arithmetic that knows no NaN, and names of others. Called by `make misuse`.
set -eu
out=$BUILD/misuse
mkdir -p "$out"
rm -rf "${out:?}"/*
cat >"$out/caller.c" <<'END'
#include "starcat.h"
static starcat_workspace work;
static starcat_result result;
int main(void) {
  starcat_image image;
  starcat_camera camera;
  starcat_options options;
  const starcat_frame frame = {0, 0, 0, 0, 0};
  static const starcat_real q[4] = {0, 0, 0, 1};
  (void)starcat_open_image(&image, 0, 0, 0);
  starcat_get_camera(&image, &camera);
  starcat_set_default_options(&options);
  (void)starcat_list_neighbours(&image, &work, 0);
  (void)starcat_track_frame(&image, &camera, &options, &frame, q, (starcat_real)0.01, &work, &result);
  return (int)starcat_identify_frame(&image, &camera, &options, &frame, &work, &result);
}
END
fail() { echo "misuse: $1"; exit 1; }
(cd "$out" && $CC $FLAGS -I"$HERE/include" -c "$HERE"/src/*.c)

# links FLAGS: a caller that was compiled with them links to the library.
links() { $CC $FLAGS $1 "$out/caller.c" "$out"/*.o -lm -o "$out/caller" 2>"$out/said"; }
links "" || { cat "$out/said"; fail "a caller that was compiled as the library does not link"; }
for wrong in "-DSTARCAT_SINGLE 64_192_float" "-DSTARCAT_MAX_CENTROIDS=128 128_192_double" \
  "-DSTARCAT_MAX_STARS=400 64_400_double"; do
  set -- $wrong
  ! links "$1" || fail "a caller with $1 links"
  for name in open_image get_camera set_default_options list_neighbours identify_frame track_frame; do
    grep -q "undefined.*starcat_${name}_$2" "$out/said" || fail "$1: starcat_${name}_$2 is not missed"
  done
done

# compiles FLAGS: the library compiles with them.
compiles() { $CC $FLAGS $1 -c src/ways.c -o "$out/one.out" 2>"$out/said"; }
compiles "-DSTARCAT_MAX_CENTROIDS=4 -DSTARCAT_MAX_STARS=32767" || fail "the widest limits do not compile"
for wrong in "-DSTARCAT_MAX_CENTROIDS=3 from.4" "-DSTARCAT_MAX_STARS=70000 from.4" \
  "-DSTARCAT_MAX_CENTROIDS=many from.4" "-ffast-math without.-ffast-math" \
  "-ffinite-math-only without.-ffast-math"; do
  set -- $wrong
  ! compiles "$1" || fail "the library compiles with $1"
  grep -q "error.*$2" "$out/said" || fail "$1: $(head -1 "$out/said")"
done

others=$(nm -g --defined-only "$out"/*.o | awk 'NF == 3 && $3 !~ /^_?starcat_/ { print $3 }')
[ -z "$others" ] || fail "symbols of other names: $others"
echo "misuse: 3 callers of other configurations do not link, 5 flags do not compile," \
  "$(nm -g --defined-only "$out"/*.o | grep -c starcat_) symbols begin with starcat_"
