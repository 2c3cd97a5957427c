#!/bin/sh
# The library as two files, starcat.c and starcat.h: to drop into any build, with starcat_update.h for
# who receives images in flight and starcat_session.h for who lets a session do it. All but the functions of these headers is static.
#
#   sh amalgamate.sh FOLDER
#
# SPDX-License-Identifier: MIT
set -eu
to=${1:?sh amalgamate.sh FOLDER}
from=$(dirname "$0")
mkdir -p "$to"

# inlined FILE: the file, with the library's own headers in the place of their #include.
inlined() {
  awk -v folder="$from" '
    function copy(path, line, name) {
      while ((getline line < path) > 0) {
        if (match(line, /^#include "starcat(_workspace|_math)?\.h"|^#include "(vectors|internal)\.h"/)) {
          name = line; gsub(/^#include "|"$/, "", name)
          if (name == "starcat.h" || name in done) continue
          done[name] = 1
          copy(folder (name ~ /^starcat/ ? "/include/" : "/src/") name)
        } else if (path ~ /internal\.h$/ && line ~ /^(int|void|real|uint32_t|starcat_status) starcat_/) {
          print "STARCAT_INNER " line
        } else {
          print line
        }
      }
      close(path)
    }
    BEGIN { for (n = 1; n < ARGC; n++) copy(ARGV[n]) }' "$@"
}

inlined "$from/include/starcat.h" >"$to/starcat.h"
{
  cat <<'END'
/* starcat onboard in one file, made by amalgamate.sh of its sources. See starcat.h.
 *
 * SPDX-License-Identifier: MIT
 */
#include "starcat.h"

#ifndef STARCAT_INNER
#define STARCAT_INNER static
#endif

END
  inlined "$from"/src/*.c
} >"$to/starcat.c"
cp "$from/LICENSE" "$from/include/starcat_update.h" "$from/include/starcat_session.h" "$to"
