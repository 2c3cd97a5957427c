#!/bin/sh
# SPDX-License-Identifier: MIT
# Code of the whole library for a Cortex-M7, the deepest stack of each call, and the workspace.
# Called by `make size`; fails above the limits of requirement SC-304, which has them for all documents.
set -eu
limit=$(($(sed -n 's/.* at most \([0-9]*\) KiB of code .*/\1/p' qualification/evidence/requirements.toml) * 1024))
out=$BUILD/size
mkdir -p "$out"
rm -rf "${out:?}"/*
ARM_FLAGS="-Os -fno-math-errno -mcpu=cortex-m7 -mthumb -mfloat-abi=hard -mfpu=fpv5-d16"
for source in src/*.c; do
  $ARM-gcc $FLAGS $ARM_FLAGS -fcallgraph-info=su -c "$source" -o "$out/$(basename "$source" .c).o"
done
code_of() { $ARM-size "$@" | awk 'NR > 1 { sum += $1 + $2 + $3 } END { print sum }'; }
update=$(code_of "$out/update.o")
session=$(code_of "$out/session.o" "$out/composite.o")
code=$(code_of "$out"/*.o)
echo "size: code and constants of the library for a Cortex-M7, -Os: $code bytes (at most $limit)"
echo "size: of these, images in flight (update.c): $update bytes; sessions (session.c, composite.c): $session bytes"
echo "size: without both: $((code - update - session)) bytes"
sh amalgamate.sh "$out/one"
$ARM-gcc $FLAGS $ARM_FLAGS -c "$out/one/starcat.c" -o "$out/one.out"
echo "size: all in the two-file library: $(code_of "$out/one.out") bytes"
cat >"$out/sizes.c" <<'END'
#include "starcat_session.h"
char session[sizeof(starcat_session)];
char workspace[sizeof(starcat_workspace)];
char result[sizeof(starcat_result)];
char image[sizeof(starcat_image)];
END
$ARM-gcc -std=c99 $ARM_FLAGS -fno-common -Iinclude -c "$out/sizes.c" -o "$out/sizes.o"
$ARM-nm --print-size "$out/sizes.o" |
  while read -r _ bytes _ name; do echo "size: sizeof(starcat_$name): $((0x$bytes)) bytes"; done
cat "$out"/*.ci | awk -f tests/stack.awk
[ "$code" -le $limit ]
