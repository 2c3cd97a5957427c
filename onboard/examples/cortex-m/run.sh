#!/bin/sh
# SPDX-License-Identifier: MIT
# Compiles the example for a Cortex-M4F, runs it in qemu, and compares the stars of every frame with
# those that the host finds. Called by `make microcontroller`; IMAGE and FRAMES take others than the
# made-up sky, as replay.c reads them.
set -eu
out=$BUILD/cortex-m
here=examples/cortex-m
mkdir -p "$out"
single=-DSTARCAT_SINGLE
$CC $FLAGS $single src/*.c tests/frames.c tests/random_sky.c -lm -o "$out/frames"
$CC $FLAGS $single src/*.c tests/replay.c -lm -o "$out/replay"
"$out/frames" "$out/sky" 20
image=${IMAGE:-$out/sky-triangle.img}
frames=${FRAMES:-$out/sky-frames.txt}
awk -f $here/frames.awk "$frames" >"$out/frames.h"

m4f="-mcpu=cortex-m4 -mthumb -mfloat-abi=hard -mfpu=fpv4-sp-d16 -Os -ffunction-sections -fdata-sections"
for source in src/*.c; do
  arm-none-eabi-gcc $STRICT $m4f $single -Wdouble-promotion -Iinclude -c "$source" \
    -o "$out/$(basename "$source" .c).o"
done
arm-none-eabi-gcc $m4f $single -std=gnu99 -Wall -Wextra -Werror -Iinclude -I"$out" -DIMAGE="\"$image\"" \
  $here/main.c $here/start.c $here/image.S "$out"/*.o -T $here/flash.ld -nostartfiles \
  --specs=nano.specs --specs=rdimon.specs -lm -Wl,--gc-sections,--print-memory-usage,-Map="$out/map.txt" \
  -o "$out/tracker.elf"
echo "code and constants of the library: $(arm-none-eabi-size "$out"/*.o |
  awk 'NR > 1 { sum += $1 + $2 + $3 } END { print sum }') bytes"
timeout 120 qemu-system-arm -machine mps2-an386 -nographic -semihosting -kernel "$out/tracker.elf" \
  >"$out/said.txt" 2>&1 </dev/null || { cat "$out/said.txt"; echo "microcontroller: it ended badly"; exit 1; }
grep -v '^frame ' "$out/said.txt"

# A line of replay is: status matched tried steps star...
"$out/replay" "$image" "$frames" identify |
  awk '{ printf "frame %d: %s", NR - 1, $1; for (k = 5; k <= NF; k++) printf " %s", $k; print "" }' \
    >"$out/host.txt"
grep '^frame ' "$out/said.txt" | tr -d '\r' | cmp - "$out/host.txt" ||
  { echo "microcontroller: answers differ from the host's: $out/said.txt, $out/host.txt"; exit 1; }
echo "microcontroller: $(wc -l <"$out/host.txt") frames, every star that of the host"
