#!/bin/sh
# Frames on this machine, on 32-bit ARM and on big-endian PowerPC under qemu: the same answers, star
# by star. Called by `make cross`. With IMAGES="LITTLE BIG" (an image in both byte orders) and
# FRAMES set it takes these instead of the made-up sky. NAME is set by the loop over processors.
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

for target in "arm $ARM qemu-arm little" "powerpc $POWERPC qemu-ppc big"; do
  set -- $target
  if ! command -v "$2-gcc" >/dev/null || ! command -v "$3" >/dev/null; then
    echo "cross: skipped on $1, as $2-gcc or $3 is missing"
    continue
  fi
  "$2-gcc" $FLAGS -static src/*.c tests/replay.c -lm -o "$BUILD/replay-$1"
  if [ -n "${IMAGES:-}" ]; then
    little=${IMAGES% *}
    big=${IMAGES#* }
    [ "$4" = little ] && image=$little || image=$big
    compare "$1" "$3" "$(basename "$little")" "$little" "$image"
    continue
  fi
  "$2-gcc" $FLAGS -static src/*.c tests/frames.c tests/random_sky.c -lm -o "$BUILD/frames-$1"
  "$3" "$BUILD/frames-$1" "$BUILD/cross-$1" 1
  for method in triangle pyramid; do
    compare "$1" "$3" $method "$BUILD/cross-$method.img" "$BUILD/cross-$1-$method.img"
  done
done
exit $failed
