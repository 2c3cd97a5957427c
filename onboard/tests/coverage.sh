#!/bin/sh
# SPDX-License-Identifier: MIT
# Branch coverage of the library by its unit test, in double and in single precision together:
# prints each branch that is not taken, and fails if there is one. Called by `make coverage`.
set -eu
out=$(mkdir -p "$BUILD/coverage" && cd "$BUILD/coverage" && pwd)
here=$(pwd)
rm -rf "${out:?}"/*
traces=
for precision in double single; do
  single=
  [ $precision = double ] || single=-DSTARCAT_SINGLE
  mkdir "$out/$precision"
  cd "$out/$precision"
  for source in "$here"/src/*.c; do
    gcc $FLAGS -I"$here/include" $single -O0 --coverage -c "$source"
  done
  gcc $FLAGS -I"$here/include" -I"$here/src" $single -O0 "$here"/tests/unit.c \
    "$here"/tests/random_sky.c "$here"/tests/test_*.c ./*.o --coverage -lm -o unit
  ./unit
  # Perl warns of lcov itself.
  lcov --quiet --rc lcov_branch_coverage=1 --capture --directory . \
    --output-file ../$precision.info 2>lcov.log || { cat lcov.log >&2; exit 1; }
  traces="$traces --add-tracefile $precision.info"
  cd "$out"
done
lcov --quiet --rc lcov_branch_coverage=1 $traces --output-file both.info
lcov --quiet --rc lcov_branch_coverage=1 --extract both.info "$here/src/*" --output-file library.info
awk -F: '
  /^SF:/ { file = $2; sub(/.*\//, "", file) }
  /^BRDA:/ { split($2, b, ","); all++
             if (b[4] == "-" || b[4] == "0") { open++; print file ":" b[1] ": a branch is never taken" } }
  END { printf "coverage: %d of %d branches of the library are taken (%.2f %%)\n", all - open, all,
        100 * (all - open) / all; exit open > 0 }' library.info
