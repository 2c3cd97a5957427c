#!/bin/sh
# SPDX-License-Identifier: MIT
# Frames on this machine, on 32-bit ARM and on big-endian PowerPC under qemu: the same answers, star
# by star. Called by `make cross`. With IMAGES="LITTLE BIG" (an image in both byte orders) and
# FRAMES set it takes these instead of the made-up sky.
set -eu
mkdir -p "$BUILD"
frames=${FRAMES:-$BUILD/cross-frames.txt}
failed=0
$CC $FLAGS src/*.c tests/replay.c -lm -o "$BUILD/replay"
$CC $FLAGS src/*.c tests/frames.c tests/random_sky.c -lm -o "$BUILD/frames"
[ -n "${IMAGES:-}" ] || "$BUILD/frames" "$BUILD/cross" 200

# compare NAME QEMU METHOD HOST-IMAGE TARGET-IMAGE
compare() {
  for task in identify track; do
    "$BUILD/replay" "$4" "$frames" $task >"$BUILD/host.txt"
    "$2" "$BUILD/replay-$1" "$5" "$frames" $task >"$BUILD/$1.txt"
    if cmp -s "$BUILD/host.txt" "$BUILD/$1.txt"; then
      echo "cross: $1, $3, $task: $(wc -l <"$BUILD/$1.txt") frames, every answer the same," \
        "$(grep -c '^0 ' "$BUILD/$1.txt") identified"
    else
      echo "cross: $1, $3, $task: answers differ: diff $BUILD/host.txt $BUILD/$1.txt"
      failed=1
    fi
  done
}

# glibc for PowerPC uses four instructions of 2017 that older processors take for mffs, as they are
# meant to. The processors of qemu-ppc refuse them, so they become mffs here.
as_older_processors() {
  perl -0777 -pi -e 's/([\xfc-\xff])([\x01\x14-\x18\x21\x34-\x38\x41\x54-\x58\x61\x74-\x78\x81\x94-\x98\xa1\xb4-\xb8\xc1\xd4-\xd8\xe1\xf4-\xf8])[\x04\x0c\x14\x1c]\x8e/$1.chr(ord($2) & 0xe0)."\x04\x8e"/ges' "$1"
}

# build TARGET COMPILER PROGRAM SOURCE...
build() {
  program=$BUILD/$3-$1
  compiler=$2
  target_of=$1
  shift 3
  "$compiler" $FLAGS -static src/*.c "$@" -lm -o "$program"
  [ "$target_of" != powerpc ] || as_older_processors "$program"
}

for target in "arm $ARM qemu-arm little" "powerpc $POWERPC qemu-ppc big"; do
  set -- $target
  if ! command -v "$2-gcc" >/dev/null || ! command -v "$3" >/dev/null ||
    ! command -v perl >/dev/null; then
    echo "cross: skipped on $1, as $2-gcc, $3 or perl is missing"
    continue
  fi
  build "$1" "$2-gcc" replay tests/replay.c
  if [ -n "${IMAGES:-}" ]; then
    little=${IMAGES% *}
    big=${IMAGES#* }
    [ "$4" = little ] && image=$little || image=$big
    compare "$1" "$3" "$(basename "$little")" "$little" "$image"
    continue
  fi
  build "$1" "$2-gcc" frames tests/frames.c tests/random_sky.c
  "$3" "$BUILD/frames-$1" "$BUILD/cross-$1" 1
  for method in triangle pyramid; do
    compare "$1" "$3" $method "$BUILD/cross-$method.img" "$BUILD/cross-$1-$method.img"
  done
done
exit $failed
