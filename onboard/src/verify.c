/* Verification: whether an attitude explains a frame. Every proposal of every method comes here.
 * The same rules as the ground's starcat/matcher/verification.py.
 *
 * SPDX-License-Identifier: MIT
 */
#include "internal.h"

/* Take steps from what is left of the budget. Returns 0 if it is used up. */
int sc_spend(starcat_workspace *work, uint32_t steps) {
  if (steps >= work->steps_left) {
    work->steps_left = 0;
    return 0;
  }
  work->steps_left -= steps;
  return 1;
}

/* Whether a centroid may be a star, by their magnitudes. */
int sc_compatible(const sc_call *call, uint32_t centroid, uint32_t row) {
  const real observed = call->work->magnitude[centroid];
  const int16_t stored = call->image->magnitudes[row];
  if (!(call->mag_reach > R(0.0)) || (stored == INT16_MIN)) {
    return 1;
  }
  const real apart = observed - R(0.001) * (real)stored;
  /* Also true where the centroid's magnitude is not a number. */
  return !((apart > call->mag_reach) || (-apart > call->mag_reach));
}

/* Put the stars around the field on the detector; keep those within a margin of it. */
void sc_project(const sc_call *call, const real m[9], real margin_px) {
  starcat_workspace *w = call->work;
  const real x0 = call->camera.half_width, y0 = call->camera.half_height;
  const real most_x = x0 + margin_px, most_y = y0 + margin_px;
  uint32_t count = 0;
  for (uint32_t j = 0; j < w->n_near; j++) {
    real body[3], x, y;
    sc_turn(m, w->near_icrs[j], body);
    if (sc_pixel(&call->camera, body, &x, &y) != 0) {
      const real dx = x - x0, dy = y - y0;
      w->x_of[count] = x;
      w->y_of[count] = y;
      w->within[count] = (uint16_t)j;
      count += (uint32_t)((dx <= most_x) && (-dx <= most_x) && (dy <= most_y) && (-dy <= most_y));
    }
  }
  w->n_within = count;
}

/* Match centroids and stars that are the nearest to each other, within reach. Returns how many
 * do. */
static uint32_t match(const sc_call *call, real reach_px) {
  starcat_workspace *w = call->work;
  const real reach = reach_px * reach_px;
  const uint32_t n_within = w->n_within;
  uint32_t matched = 0;
  for (uint32_t k = 0; k < n_within; k++) {
    w->nearest[k] = UINT16_MAX;
  }
  for (uint32_t i = 0; i < w->count; i++) {
    const real x = w->x[i], y = w->y[i];
    real least = reach;
    int16_t best = -1;
    for (uint32_t k = 0; k < n_within; k++) {
      const real dx = x - w->x_of[k];
      if (dx * dx > reach) { /* nearly all: the rest is not even computed */
        continue;
      }
      const real dy = y - w->y_of[k];
      const real square = dx * dx + dy * dy;
      if ((square <= reach) && sc_compatible(call, i, w->near_row[w->within[k]])) {
        if ((best < 0) || (square < least)) {
          least = square;
          best = (int16_t)k;
        }
        if ((w->nearest[k] == UINT16_MAX) || (square < w->nearest_square[k])) {
          w->nearest_square[k] = square;
          w->nearest[k] = (uint16_t)i;
        }
      }
    }
    w->match[i] = best;
    w->match_square[i] = least;
  }
  for (uint32_t i = 0; i < w->count; i++) {
    if ((w->match[i] >= 0) && (w->nearest[w->match[i]] != i)) {
      w->match[i] = -1;
    }
    matched += (uint32_t)(w->match[i] >= 0);
  }
  return matched;
}

/* Remember the matches; returns whether they are those that were remembered. */
static int is_as_before(starcat_workspace *w) {
  int same = 1;
  for (uint32_t i = 0; i < w->count; i++) {
    const int16_t star = (int16_t)(w->match[i] >= 0 ? w->within[w->match[i]] : -1);
    same &= w->before[i] == star;
    w->before[i] = star;
  }
  return same;
}

/* Refine the attitude on all matches. */
static void refine(starcat_workspace *w, real m[9]) {
  uint16_t which[STARCAT_MAX_CENTROIDS];
  real body[STARCAT_MAX_CENTROIDS][3];
  uint32_t n = 0;
  for (uint32_t i = 0; i < w->count; i++) {
    if (w->match[i] >= 0) {
      which[n] = w->within[w->match[i]];
      body[n][0] = w->body[i][0];
      body[n][1] = w->body[i][1];
      body[n][2] = w->body[i][2];
      n++;
    }
  }
  sc_refine(m, &body[0][0], &w->near_icrs[0][0], which, n, 4);
}

/* Refine an attitude on all stars that match, first within wider reaches. Returns the number of
 * matches, 0 where the stars around the field are too many or the budget is used up. */
static uint32_t fit(const sc_call *call, real m[9], uint32_t n_wider) {
  static const real wider[2] = {R(4.0), R(2.0)};
  starcat_workspace *w = call->work;
  uint32_t matched = 0;
  w->n_near = sc_gather(call, m + 6, call->camera.cos_radius, call->camera.sin_radius,
                        STARCAT_MAX_STARS, w->near_row, w->near_icrs);
  if (w->n_near > STARCAT_MAX_STARS) {
    return 0;
  }
  for (uint32_t i = 0; i < w->count; i++) {
    w->before[i] = -2;
  }
  for (uint32_t n = 0; n < n_wider + SC_REFINEMENTS; n++) {
    const int is_final = n >= n_wider;
    const real reach_px = is_final ? call->reach_px : wider[n] * call->reach_px;
    sc_project(call, m, is_final ? call->reach_px : reach_px);
    matched = match(call, reach_px);
    if (!sc_spend(w, w->n_near + w->count * (w->n_within + 1u))) {
      return 0;
    }
    if ((matched < SC_MIN_STARS) || (is_as_before(w) && is_final)) {
      break;
    }
    refine(w, m);
  }
  return matched;
}

/* Judge the fit that is in the workspace. Returns the share of the frame that it explains, 1
 * where chance explains the agreement, as it is of no use there. */
static real judge(const sc_call *call, const real m[9], uint32_t matched, starcat_agreement *found) {
  starcat_workspace *w = call->work;
  real square_px = R(0.0), square_rad = R(0.0), share = R(1.0);
  for (uint32_t k = 0; k < 9u; k++) {
    found->matrix[k] = m[k];
  }
  found->n_matched = matched;
  found->log_chance = R(0.0);
  found->residual_rad = R(0.0);
  if (matched < SC_MIN_STARS) {
    return share;
  }
  for (uint32_t i = 0; i < w->count; i++) {
    found->star[i] = STARCAT_NO_STAR;
    if (w->match[i] >= 0) {
      const uint32_t j = w->within[w->match[i]];
      real body[3];
      sc_turn(m, w->near_icrs[j], body);
      square_rad += sc_chord_square(w->body[i], body);
      square_px += w->match_square[i];
      found->star[i] = (int32_t)w->near_row[j];
    }
  }
  found->residual_rad = STARCAT_SQRT(square_rad / (real)matched);
  found->log_chance = sc_log_chance(call, square_px, matched);
  if (found->log_chance < R(0.0)) {
    if (matched < w->n_within) {
      share = sc_share(call, m, found->residual_rad, matched);
    }
    if ((share < SC_MIN_SHARE) || sc_is_scaled(call, matched)) {
      found->log_chance = R(0.0);
    }
  }
  return share;
}

/* List the centroids without a star that are near the star of another one. */
static void find_rivals(const sc_call *call) {
  starcat_workspace *w = call->work;
  const real reach_px = SC_RIVAL_REACH * call->reach_px;
  w->n_rivals = 0;
  for (uint32_t i = 0; i < w->count; i++) {
    real least = reach_px * reach_px;
    uint32_t of = w->count;
    for (uint32_t k = 0; (k < w->count) && (w->match[i] < 0); k++) {
      if (w->match[k] >= 0) {
        const real dx = w->x[i] - w->x_of[w->match[k]], dy = w->y[i] - w->y_of[w->match[k]];
        const real square = dx * dx + dy * dy;
        if (square < least) {
          least = square;
          of = k;
        }
      }
    }
    if ((of < w->count) && sc_compatible(call, i, w->near_row[w->within[w->match[of]]])) {
      w->rival[w->n_rivals] = (uint16_t)i;
      w->rival_of[w->n_rivals] = (uint16_t)of;
      w->n_rivals++;
    }
  }
}

/* Give the star of a centroid to its rival, and fit the attitude to that. */
static void fit_rival(const sc_call *call, uint32_t rival, uint32_t centroid, real m[9]) {
  const starcat_workspace *w = call->work;
  real body[STARCAT_MAX_CENTROIDS][3], icrs[STARCAT_MAX_CENTROIDS][3];
  uint32_t n = 0;
  for (uint32_t k = 0; k < 9u; k++) {
    m[k] = w->found.matrix[k];
  }
  for (uint32_t i = 0; i < w->count; i++) {
    const uint32_t owner = i == rival ? centroid : i;
    if ((i != centroid) && (w->found.star[owner] >= 0)) {
      sc_star(call->image, (uint32_t)w->found.star[owner], icrs[n]);
      body[n][0] = w->body[i][0];
      body[n][1] = w->body[i][1];
      body[n][2] = w->body[i][2];
      n++;
    }
  }
  sc_refine(m, &body[0][0], &icrs[0][0], NULL, n, 4);
}

/* A false spot beside a star far from the others can turn the attitude so that it is the nearest
 * to the star itself. The star's own spot then has no star, and fits better: the first such rival is
 * taken. Returns the share of the frame that the agreement explains. */
static real try_rivals(const sc_call *call, real share) {
  starcat_workspace *w = call->work;
  find_rivals(call);
  for (uint32_t n = 0; n < w->n_rivals; n++) {
    real m[9];
    fit_rival(call, w->rival[n], w->rival_of[n], m);
    const real its_share = judge(call, m, fit(call, m, 0), &w->wider);
    if (w->wider.log_chance < w->found.log_chance) {
      w->found = w->wider;
      return its_share;
    }
  }
  return share;
}

/* Verify an attitude; keep it if it is the best so far. Returns 1 if the search can end: the
 * agreement is certain, or the budget is used up. */
int sc_try(sc_call *call, const real m[9]) {
  starcat_workspace *w = call->work;
  const starcat_agreement *found = &w->found;
  real attitude[9];
  for (uint32_t k = 0; k < 9u; k++) {
    attitude[k] = m[k];
  }
  w->n_tried++;
  real share = judge(call, attitude, fit(call, attitude, 0), &w->found);
  if (w->found.log_chance < R(0.0)) {
    share = try_rivals(call, share);
  }
  if ((w->found.n_matched >= SC_MIN_STARS) && (share < SC_SURE_SHARE)) {
    /* Not due to chance, although much of the frame is unexplained: one or two wrong stars at the
     * edge of a cluster may have spoilt an attitude that is nearly right. */
    for (uint32_t k = 0; k < 9u; k++) {
      attitude[k] = w->found.matrix[k];
    }
    (void)judge(call, attitude, fit(call, attitude, 2), &w->wider);
    if (w->wider.log_chance < w->found.log_chance) {
      found = &w->wider;
    }
  }
  if (found->log_chance < w->best.log_chance) {
    w->best = *found;
  }
  return (w->best.log_chance <= call->log_certain) || (w->steps_left == 0u);
}
