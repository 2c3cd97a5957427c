#!/bin/sh
# SPDX-License-Identifier: MIT
# No file of the library calls back into one that needs it, and no header includes itself by others:
# symbols that nm shows, and #include lines, in an order that tsort finds. Called by `make cycles`;
# prints each loop, and fails if there is one.
set -eu
out=$BUILD/cycles
mkdir -p "$out"
rm -rf "${out:?}"/*
for source in src/*.c; do
  $CC $FLAGS -O0 -c "$source" -o "$out/$(basename "$source" .c).o"
done
(cd "$out" && nm -A ./*.o) | sed 's|^\./||; s|\.o:|.c:|' | awk '
  { file = $1; sub(/:.*/, "", file); kind = $(NF - 1); name = $NF }
  kind == "U" { n++; caller[n] = file; called[n] = name }
  kind ~ /^[TDRB]$/ { home[name] = file }
  END { for (k = 1; k <= n; k++) if (called[k] in home) print caller[k], home[called[k]] }' |
  sort -u >"$out/calls"
for file in src/*.[ch] include/*.h; do
  sed -n 's/^#include "\([a-z_]*\.h\)".*/\1/p' "$file" | sed "s|^|$(basename "$file") |"
done | grep -v '^starcat_workspace.h starcat.h$' >"$out/includes"
cat "$out/calls" "$out/includes" >"$out/needs"
if ! tsort "$out/needs" >"$out/order" 2>"$out/loops" || [ -s "$out/loops" ]; then
  cat "$out/loops"
  echo "cycles: files of the library need each other in a circle"
  exit 1
fi
echo "cycles: $(wc -l <"$out/calls") calls between files and $(wc -l <"$out/includes") includes," \
  "none leads back"
