#!/bin/sh
# SPDX-License-Identifier: MIT
# Compiles the example for a Cortex-M4F and a Cortex-M7, runs it in qemu, and compares the stars of
# every frame with those that the host finds. Called by `make microcontroller`; IMAGE and FRAMES take
# others than the made-up sky, as replay.c reads them, NOISE="PX MAG" states their noise, and
# MODE=track tracks from their priors.
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
noise=${NOISE:-0 0}
mode=${MODE:-identify}
[ "$mode" = track ] && is_tracked=1 || is_tracked=0
awk -f $here/frames.awk "$frames" >"$out/frames.h"

# A line of replay is: status matched tried steps star...
"$out/replay" "$image" "$frames" "$mode" 1 $noise 4000000 |
  awk '{ printf "frame %d: %s", NR - 1, $1; for (k = 5; k <= NF; k++) printf " %s", $k; print "" }' \
    >"$out/host.txt"

bytes_of() { arm-none-eabi-size "$@" | awk 'NR > 1 { sum += $1 + $2 + $3 } END { print sum }'; }

# run_on NAME MACHINE FLAGS: compiles and runs it on one processor
run_on() {
  name=$1 machine=$2 processor="$3 -mthumb -mfloat-abi=hard -Os -ffunction-sections -fdata-sections"
  echo "$name, $machine of qemu, single precision, -Os"
  rm -rf "${out:?}/$name"
  mkdir -p "$out/$name"
  for source in src/*.c; do
    arm-none-eabi-gcc $STRICT $processor $single -Wdouble-promotion -Iinclude -c "$source" \
      -o "$out/$name/$(basename "$source" .c).o"
  done
  arm-none-eabi-gcc $processor $single -std=gnu99 -Wall -Wextra -Werror -Iinclude -I"$out" \
    -Iqualification/wcet -DIMAGE="\"$image\"" -DNOISE_PX="${noise% *}" -DNOISE_MAG="${noise#* }" \
    -DIS_TRACKED=$is_tracked \
    $here/main.c $here/start.c $here/image.S "$out/$name"/*.o -T $here/flash.ld -nostartfiles \
    --specs=nano.specs --specs=rdimon.specs -lm \
    -Wl,--gc-sections,--print-memory-usage,-Map="$out/$name/map.txt" -o "$out/$name/tracker.elf"
  core=$(ls "$out/$name"/*.o | grep -v -e /update.o -e /session.o -e /composite.o)
  echo "code and constants of the library: $(bytes_of $core) bytes," \
    "with images in flight and sessions: $(bytes_of "$out/$name"/*.o) bytes"
  timeout 120 qemu-system-arm -machine "$machine" -nographic -semihosting -icount shift=0 \
    -kernel "$out/$name/tracker.elf" >"$out/$name/said.txt" 2>&1 </dev/null ||
    { cat "$out/$name/said.txt"; echo "microcontroller: it ended badly on $name"; exit 1; }
  grep -v -e '^frame ' -e '^took ' "$out/$name/said.txt"
  grep '^took ' "$out/$name/said.txt" | tr -d '\r' | sort -n -k2 | awk '
    { took[NR] = $2; sum += $2; steps += $3 }
    END { printf "instructions of a frame: median %d, largest %d; %.1f in a step\n",
            took[int((NR + 1) / 2)], took[NR], sum / steps }'
  grep '^frame ' "$out/$name/said.txt" | tr -d '\r' | cmp - "$out/host.txt" ||
    { echo "microcontroller: answers differ from the host's: $out/$name/said.txt, $out/host.txt"; exit 1; }
  echo "microcontroller: $name, $(wc -l <"$out/host.txt") frames, every star that of the host"
}

run_on cortex-m4 mps2-an386 "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16"
run_on cortex-m7 mps2-an500 "-mcpu=cortex-m7 -mfpu=fpv5-d16"
