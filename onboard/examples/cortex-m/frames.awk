# Frames as replay.c reads them, as arrays of C. SPDX-License-Identifier: MIT
BEGIN { n_frames = n_spots = 0 }
NF == 5 { for (k = 0; k < 4; k++) q[4 * n_frames + k] = $(k + 2); first[n_frames++] = n_spots; next }
NF == 3 { x[n_spots] = $1; y[n_spots] = $2; magnitude[n_spots] = $3; n_spots++ }
function list(type, name, of, count,    k) {
  printf "static const %s %s[%d] = {", type, name, count
  for (k = 0; k < count; k++) printf "%s%s", (k % 6 ? " " : "\n    "), of[k] ","
  print "\n};"
}
END {
  first[n_frames] = n_spots
  print "#include \"starcat.h\"\n#define N_FRAMES " n_frames "u"
  list("uint32_t", "FIRST", first, n_frames + 1)
  list("starcat_real", "Q_PRIOR", q, 4 * n_frames)
  list("starcat_real", "X_PX", x, n_spots)
  list("starcat_real", "Y_PX", y, n_spots)
  list("starcat_real", "MAGNITUDES", magnitude, n_spots)
}
