#!/bin/sh
# SPDX-License-Identifier: MIT
# Runs the app's unit tests, with stubs of cFE and of the library, and prints each line of the app
# that they do not execute; fails if there is one. Called by `make cfs-coverage`; see run.sh.
set -eu
out=$(mkdir -p "$BUILD/cfs" && cd "$BUILD/cfs" && pwd)
here=$HERE/integrations/cfs
[ -f "$out/cfs/cfe/CMakeLists.txt" ] || tar xf "$CFS" -C "$out"
cd "$out/cfs"
rm -rf starcat_unit_defs && cp -r sample_defs starcat_unit_defs
sed -e 's/APPLIST sample_app sample_lib/APPLIST starcat_app/' sample_defs/targets.cmake \
  >starcat_unit_defs/targets.cmake
ln -sfn "$here" apps/starcat_app
units="starcat_app starcat_app_cmds starcat_app_config starcat_app_dispatch starcat_app_frame
  starcat_app_image"
targets=
for unit in $units; do targets="$targets coverage-starcat_app-$unit-testrunner"; done
native=build-unit/native/default_cpu1
{ cmake -S cfe -B build-unit -DSIMULATION=native -DMISSIONCONFIG=starcat_unit \
    -DENABLE_UNIT_TESTS=ON -DCMAKE_BUILD_TYPE=debug -DCMAKE_INSTALL_PREFIX="$out/exe-unit" &&
  make -C build-unit mission-prebuild && make -C $native $targets; } >"$out/unit.log" 2>&1 ||
  { tail -30 "$out/unit.log" >&2; exit 1; }
cd $native/apps/starcat_app/unit-test
find . -name '*.gcda' -delete
failed=0
for unit in $units; do
  "./coverage-starcat_app-$unit-testrunner" >"$out/unit-$unit.log" 2>&1 || failed=1
  grep -E '^\[ FAIL\]|^\[ABORT\]|SUMMARY' "$out/unit-$unit.log" || true
done
lcov --quiet --rc lcov_branch_coverage=1 --capture --directory . --output-file "$out/all.info" \
  2>"$out/lcov.log" || { cat "$out/lcov.log" >&2; exit 1; }
lcov --quiet --rc lcov_branch_coverage=1 --extract "$out/all.info" '*/fsw/src/starcat_app*.c' \
  --output-file "$out/app.info"
awk -F: -v failed=$failed '
  /^SF:/ { file = $2; sub(/.*\//, "", file) }
  /^DA:/ { split($2, d, ","); lines++
           if (d[2] == 0) { open++; print file ":" d[1] ": this line is never executed" } }
  /^BRDA:/ { split($2, b, ","); branches++
             if (b[4] == "-" || b[4] == "0") { missed++
               print file ":" b[1] ": a branch is never taken" } }
  END { printf "cfs-coverage: %d of %d lines of the app (%.1f %%), %d of %d branches\n", lines - open,
          lines, 100 * (lines - open) / lines, branches - missed, branches
        exit (open > 0) || (lines == 0) || failed }' "$out/app.info"
