#!/bin/sh
# SPDX-License-Identifier: MIT
# Builds the app with cFS and runs it: the test app plays 1,000 frames over the software bus, and
# check_run compares all that was said with the truth and the library. Called by `make cfs`.
#   CFS    archive of cFS; BUILD: folder to build in; HERE: onboard/; PYTHON: for the ICD
set -eu
out=$(mkdir -p "$BUILD/cfs" && cd "$BUILD/cfs" && pwd)
here=$HERE/integrations/cfs
if [ ! -f "$out/cfs/cfe/CMakeLists.txt" ]; then
  tar xf "$CFS" -C "$out"
fi
cd "$out/cfs"

# A mission of the app and of the test app, each where it lies.
rm -rf starcat_defs && cp -r sample_defs starcat_defs
cat >starcat_defs/targets.cmake <<'END'
SET(MISSION_NAME "Starcat")
SET(SPACECRAFT_ID 0x42)
list(APPEND MISSION_GLOBAL_APPLIST starcat_app starcat_test)
SET(MISSION_CPUNAMES cpu1)
SET(cpu1_PROCESSORID 1)
SET(cpu1_APPLIST)
SET(cpu1_SYSTEM i686-linux-gnu)
END
ln -sfn "$here" apps/starcat_app
ln -sfn "$here/test/starcat_test" apps/starcat_test

# `starcat_app` is compiled anew each time, so that its warnings are seen.
rm -rf build/native/default_cpu1/apps/starcat_app
cmake -S cfe -B build -DSIMULATION=native -DMISSIONCONFIG=starcat -DENABLE_UNIT_TESTS=OFF \
  -DCMAKE_BUILD_TYPE=release -DCMAKE_INSTALL_PREFIX="$out/exe" >"$out/build.log" 2>&1 &&
  make -C build mission-install >>"$out/build.log" 2>&1 || { tail -30 "$out/build.log" >&2; exit 1; }
warnings=$(grep -c 'warning:' "$out/build.log" || true)

# Frames, images and what is to be started.
cf=$out/exe/cpu1/cf
host="$FLAGS -I$HERE/include -I$HERE/tests -Ibuild/inc -Ibuild/native/default_cpu1/inc \
  -Istarcat_defs/inc -Iosal/src/os/inc -Icfe/modules/core_api/fsw/inc -I$here/test/starcat_test/fsw/src"
for program in make_run check_run; do
  $CC $host "$here/test/$program.c" "$HERE/tests/random_sky.c" "$HERE"/src/*.c -lm -o "$out/$program"
done
"$out/make_run" "$cf"
cat >"$cf/cfe_es_startup.scr" <<'END'
CFE_APP, starcat_app, STARCAT_APP_Main, STARCAT_APP, 50, 32768, 0x0, 0;
CFE_APP, starcat_test, STARCAT_TEST_Main, STARCAT_TEST, 60, 32768, 0x0, 0;
!
END

# The queues of cFS are deeper than what Linux allows by default.
depth=/proc/sys/fs/mqueue/msg_max
before=$(cat $depth)
if [ "$before" -lt 64 ]; then
  if ! (echo 64 >$depth) 2>/dev/null; then
    echo "cfs: skipped, as $depth is $before, and only root can make it 64"
    exit 0
  fi
  trap 'echo "$before" >$depth' EXIT
fi
cd "$out/exe/cpu1"
ended=0
timeout -k 5 "${CFS_SECONDS:-240}" ./core-cpu1 >"$out/run.log" 2>&1 || ended=$?
grep 'starcat_test' "$out/run.log" || { tail -20 "$out/run.log" >&2; exit 1; }
echo "cfs: what the app said, against the truth and the library"
checked=0
"$out/check_run" "$cf" || checked=$?
echo "  warnings of the build         $(printf %6d "$warnings")"
echo "  exit code of core-cpu1        $(printf %6d "$ended")"
icd=0
if command -v "$PYTHON" >/dev/null; then
  (cd "$out/cfs" && CC="$CC" INCLUDES="$host" "$PYTHON" "$here/test/icd.py" --check "$here/starcat.xml" \
    --recording "$cf/run.ccsds" --build "$out") || icd=$?
fi
[ "$ended" = 0 ] && [ "$checked" = 0 ] && [ "$warnings" = 0 ] && [ "$icd" = 0 ] &&
  grep -q 'starcat_test: [0-9]* checks, 0 failed' "$out/run.log" && echo "cfs: all is right"
