#!/bin/sh
# SPDX-License-Identifier: MIT
# Everything that a review wants, in one folder: called by `make evidence`. Each step is a target of
# the Makefile; what it prints is kept, and a step that fails does not stop the others.
set -u
out=$BUILD/evidence
rm -rf "${out:?}"
mkdir -p "$out"
step() { # NAME TITLE
  echo "evidence: $2"
  result=fail
  "$MAKE" --no-print-directory -s "$1" >"$out/$1.log" 2>&1 && result=pass
  grep -q "skipped, as" "$out/$1.log" && result=fail
  printf '%s\t%s\tmake %s\t%s\n' "$1" $result "$1" "$2" >>"$out/steps.txt"
}
step matrix "Requirements and tests"
step unit "Unit test"
step coverage "Branches"
step mcdc "MC/DC"
step proofs "Absence of run-time errors"
step upsets "Single-event upsets"
step misra "MISRA C:2012"
step cppcheck "cppcheck"
step misuse "Misuse"
step size "Code, stack, workspace"
step sbom "Bill of materials"
cp README.md "$out"
if [ -f ../docs/onboard-manual.md ]; then cp ../docs/onboard-manual.md "$out"; fi
echo
python3 qualification/evidence/index.py "$out"
status=$?
echo "evidence: $out/index.html"
exit $status
