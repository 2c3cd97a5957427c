#!/bin/sh
# SPDX-License-Identifier: MIT
# Worst-case time: runs WCET_FRAMES calls on each simulated processor, a quarter of them with each of
# four images, and prints the table of what they took and of the bound. Called by `make wcet`.
# The start, the memory map and the image in flash of the Cortex-M7 are those of examples/cortex-m,
# whose Cortex-M4F has the same addresses in qemu; those of RISC-V are picolibc's.
set -eu
out=$BUILD/wcet
here=qualification/wcet
m4f=examples/cortex-m
mkdir -p "$out"
$CC $FLAGS -Itests $here/images.c tests/random_sky.c src/*.c -lm -o "$out/images"
"$out/images" "$out/sky"
each=$((WCET_FRAMES / 4))

# compile NAME COMPILER FLAGS: the library, by its own strict flags, and the rest
compile() {
  name=$1 compiler=$2 flags=$3
  mkdir -p "$out/$name"
  for source in src/*.c; do
    $compiler $STRICT $flags -Iinclude -c "$source" -o "$out/$name/$(basename "$source" .c).o"
  done
  for source in $here/main.c $here/ticks.c $here/adversary.c tests/random_sky.c; do
    $compiler $STRICT $flags -Iinclude -Itests -DFRAMES=$each -c "$source" \
      -o "$out/$name/$(basename "$source" .c).o"
  done
}

# simulate NAME QEMU...: runs the programs of the four images
simulate() {
  name=$1
  shift
  for k in 0 1 2 3; do
    nice -n 5 timeout 3000 "$@" -nographic -semihosting -icount shift=0 \
      -kernel "$out/$name-$k.elf" >"$out/$name-$k.txt" 2>&1 </dev/null ||
      { tail -3 "$out/$name-$k.txt"; echo "wcet: $name ended badly"; exit 1; }
  done
}

m7="-mcpu=cortex-m7 -mthumb -mfloat-abi=hard -mfpu=fpv5-d16"
rv64="-march=rv64gc -mabi=lp64d -mcmodel=medany --specs=picolibc.specs"
sections="-O2 -g -ffunction-sections -fdata-sections"
said=
for target in $WCET_TARGETS; do
  single=
  [ "${target%-single}" = "$target" ] || single=-DSTARCAT_SINGLE
  case $target in
  m7*)
    compile "$target" arm-none-eabi-gcc "$m7 $sections $single"
    sed 's/LENGTH = 128K/LENGTH = 2048K/' $m4f/flash.ld >"$out/flash.ld" # two slots in RAM
    for k in 0 1 2 3; do
      arm-none-eabi-gcc $m7 $sections -DIMAGE="\"$out/sky-$k.img\"" $m4f/start.c $m4f/image.S \
        "$out/$target"/*.o -T "$out/flash.ld" -nostartfiles --specs=rdimon.specs -lm -Wl,--gc-sections \
        -o "$out/$target-$k.elf"
    done
    simulate "$target" qemu-system-arm -machine mps2-an500
    tools=arm-none-eabi- title="Cortex-M7${single:+,_single_precision}"
    ;;
  rv64*)
    compile "$target" riscv64-unknown-elf-gcc "$rv64 $sections $single"
    for k in 0 1 2 3; do
      riscv64-unknown-elf-gcc $rv64 $sections --oslib=semihost --crt0=hosted \
        -DIMAGE="\"$out/sky-$k.img\"" $m4f/image.S "$out/$target"/*.o -lm -Wl,--gc-sections \
        -Wl,--defsym=__flash=0x80000000,--defsym=__flash_size=4M \
        -Wl,--defsym=__ram=0x80400000,--defsym=__ram_size=4M -o "$out/$target-$k.elf"
    done
    simulate "$target" qemu-system-riscv64 -machine virt -bios none
    tools=riscv64-unknown-elf- title="RISC-V_RV64GC${single:+,_single_precision}"
    ;;
  esac
  said="$said${said:+ / }$title $tools $out/$target-0.elf $out/$target-1.elf $out/$target-2.elf $out/$target-3.elf"
done
python3 -B $here/report.py $said
