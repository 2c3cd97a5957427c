#!/bin/sh
# SPDX-License-Identifier: MIT
# A program elsewhere finds the library: by CMake and by pkg-config, installed by CMake with other
# limits than the default ones, and by make. Called by `make test-install`.
set -eu
mkdir -p "$BUILD"
out=$(cd "$BUILD" && pwd)/install
rm -rf "$out"
mkdir -p "$out/app"
cat >"$out/app/main.c" <<'END'
#include <starcat.h>
#include <stdio.h>
int main(void) {
  starcat_options options;
  starcat_set_default_options(&options); /* links to no library of other limits */
  printf("%s %d %d %d\n", starcat_version(), (int)STARCAT_MAX_CENTROIDS, (int)STARCAT_MAX_STARS,
         (int)sizeof(starcat_real));
  return starcat_version_number() == STARCAT_VERSION_NUMBER ? 0 : 1;
}
END
cat >"$out/app/CMakeLists.txt" <<'END'
cmake_minimum_required(VERSION 3.16)
project(app C)
find_package(starcat 0.2 REQUIRED)
add_executable(app main.c)
target_link_libraries(app starcat::starcat)
END
quiet() { "$@" >"$out/log" 2>&1 || { cat "$out/log"; exit 1; }; }
# is WAY EXPECTED PROGRAM
is() {
  said=$("$3")
  [ "$said" = "$2" ] || { echo "test-install: $1: it says $said, not $2"; exit 1; }
  echo "test-install: $1: $said"
}

version=$(sed -n 's/^#define STARCAT_VERSION "\(.*\)"/\1/p' "$HERE/include/starcat.h")
quiet cmake -S "$HERE" -B "$out/lib" -DCMAKE_INSTALL_PREFIX="$out/cmake" -DCMAKE_C_COMPILER="$CC" \
  -DCMAKE_INSTALL_LIBDIR=lib -DSTARCAT_MAX_CENTROIDS=100 -DSTARCAT_MAX_STARS=400 -DSTARCAT_SINGLE=ON
quiet cmake --build "$out/lib" --target install
quiet cmake -S "$out/app" -B "$out/app/build" -DCMAKE_PREFIX_PATH="$out/cmake" -DCMAKE_C_COMPILER="$CC"
quiet cmake --build "$out/app/build"
is "find_package" "$version 100 400 4" "$out/app/build/app"

quiet "$MAKE" -C "$HERE" install BUILD="$out/make-build" PREFIX="$out/make"
for way in "cmake 100 400 4" "make 64 192 8"; do
  set -- $way
  flags=$(PKG_CONFIG_PATH=$out/$1/lib/pkgconfig pkg-config --cflags --libs starcat)
  $CC "$out/app/main.c" $flags -o "$out/app/$1"
  is "pkg-config after $1" "$version $2 $3 $4" "$out/app/$1"
done
