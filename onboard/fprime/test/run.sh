#!/bin/sh
# Checks the model with fpp-check, generates the code of its component and types, and flies the
# component with it: 1,000 frames. The framework itself takes no part: test/framework.hpp has what
# the generated headers want of it. Called by `make fprime`.
set -eu
out=$(mkdir -p "$BUILD/fprime" && cd "$BUILD/fprime" && pwd)
here=$HERE/fprime
rm -rf "${out:?}"/*
mkdir "$out/ac"
fpp-check "$here/StarTracker.fpp" "$here/test/framework.fpp"
fpp-to-cpp -p "$here" -d "$out/ac" -i "$here/test/framework.fpp" "$here/StarTracker.fpp"
# Each header of the framework is that one.
for header in $(sed -nE 's/^#include "((Fw|Os|test)\/.*)"/\1/p' "$out"/ac/*.hpp) Os/File.hpp; do
  mkdir -p "$out/inc/$(dirname "$header")"
  echo '#include "framework.hpp"' >"$out/inc/$header"
done
cd "$out"
for source in "$HERE"/src/*.c "$HERE/tests/random_sky.c"; do
  $CC -std=c99 -O2 -I"$HERE/include" -c "$source"
done
flags="-std=c++17 -O1 -DFW_DIRECT_PORT_CALLS=1 -I$here -I$here/test -I$out/inc -I$out/ac
  -I$HERE/include -I$HERE/tests"
for source in "$out"/ac/*SerializableAc.cpp "$out"/ac/*ArrayAc.cpp "$out"/ac/*EnumAc.cpp; do
  $CXX $flags -c "$source"
done
for source in "$here/StarTracker.cpp" "$here/test/test_star_tracker.cpp"; do
  $CXX $flags -Wall -Wextra -Wshadow -Werror -Wno-unused-parameter -c "$source"
done
$CXX ./*.o -lm -o test_star_tracker
./test_star_tracker "$out"
