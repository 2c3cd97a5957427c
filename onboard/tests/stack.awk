# SPDX-License-Identifier: MIT
# The deepest stack of the library's functions, from what gcc writes with -fcallgraph-info=su. Fails
# above 8192 bytes, and on recursion. Functions of libm count as nothing. The one call through a
# pointer is that of a method's look-up.
/^node:/ {
  match($0, /title: "[^"]*"/); name = plain(substr($0, RSTART + 8, RLENGTH - 9))
  if (match($0, /[0-9]+ bytes/)) own[name] = substr($0, RSTART, RLENGTH) + 0
}
/^edge:/ {
  match($0, /sourcename: "[^"]*"/); from = plain(substr($0, RSTART + 13, RLENGTH - 14))
  match($0, /targetname: "[^"]*"/); to = plain(substr($0, RSTART + 13, RLENGTH - 14))
  if (to == "__indirect_call") { calls[from] = calls[from] " starcat_look_up_triangle starcat_look_up_pyramid" }
  else { calls[from] = calls[from] " " to }
}
function plain(name) { sub(/_[0-9]+_[0-9]+_(double|float)$/, "", name); return name }
function deepest(name,    n, i, list, most, below) {
  if (name in done) return done[name]
  if (name in busy) { print "size: recursion at " name; failed = 1; return 0 }
  busy[name] = 1
  n = split(calls[name], list, " ")
  for (i = 1; i <= n; i++) {
    below = deepest(list[i])
    if (below > most) { most = below; next_of[name] = list[i] }
  }
  delete busy[name]
  return done[name] = own[name] + most
}
END {
  n = split("starcat_identify_frame starcat_track_frame starcat_open_image starcat_scrub_image starcat_fit_attitude starcat_answer_frame", entry, " ")
  for (i = 1; i <= n; i++) {
    bytes = deepest(entry[i])
    if (!(entry[i] in own) || bytes > 8192) failed = 1
    path = ""
    for (name = entry[i]; name != ""; name = next_of[name]) path = path " > " name
    printf "size: stack of %s: %d bytes (at most 8192):%s\n", entry[i], bytes, substr(path, 3)
  }
  exit failed
}
