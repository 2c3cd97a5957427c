/* Working memory of a call. Included by starcat.h; public only so that its size is known.
 *
 * SPDX-License-Identifier: MIT
 */
#ifndef STARCAT_WORKSPACE_H
#define STARCAT_WORKSPACE_H

/* Centroids used for triangles: the first ones in the order of the frame. */
#define STARCAT_MOST_CENTROIDS 32
#define STARCAT_MOST_PAIRS (STARCAT_MOST_CENTROIDS * (STARCAT_MOST_CENTROIDS - 1) / 2)

/* Nearest centroids with which each centroid forms triangles in a crowded frame. */
#define STARCAT_NEIGHBOURS 20

/* Columns of the detector, an index for finding the centroids near a star. */
#define STARCAT_COLUMNS 64u

/* Words of 32 marks. The row of a star selects its mark. */
#define STARCAT_MARKS 256u

/* Stars whose votes are counted together, and the bins of their votes. */
#define STARCAT_GROUP 64u
#define STARCAT_BINS 64u

/* An attitude and the star of each centroid of a frame under it. */
typedef struct {
  starcat_real matrix[9];
  starcat_real focal; /* focal length divided by the given focal length */
  starcat_real residual_rad;
  starcat_real log_chance; /* 0 if withheld */
  starcat_real log_bound;  /* same value, also if withheld */
  starcat_real share;      /* fraction of the centroids, or of the stars if fewer, that match */
  starcat_real square_px;  /* sum of the squared residuals */
  starcat_real terms[STARCAT_SHAPE_TERMS]; /* shape of the frame */
  uint32_t free;                           /* number of terms that were fitted */
  uint32_t n_matched;
  uint32_t withheld;                   /* a reason, 0: not withheld */
  int32_t star[STARCAT_MAX_CENTROIDS]; /* row in the image, -1: none */
} starcat_agreement;

struct starcat_workspace {
  /* The usable centroids in their own order: brightest first, or nearest to the centre first. */
  uint32_t row[STARCAT_MAX_CENTROIDS];
  starcat_real x[STARCAT_MAX_CENTROIDS];
  starcat_real y[STARCAT_MAX_CENTROIDS];
  starcat_real magnitude[STARCAT_MAX_CENTROIDS]; /* a large number if unknown */
  starcat_real square[STARCAT_MAX_CENTROIDS];    /* squared distance from the centre */
  starcat_real at_x[STARCAT_MAX_CENTROIDS];      /* with a shape undone */
  starcat_real at_y[STARCAT_MAX_CENTROIDS];
  starcat_real body[STARCAT_MAX_CENTROIDS][3];
  starcat_real scaled[STARCAT_MAX_CENTROIDS][3]; /* with the focal length fitted with an attitude */

  /* The centroids by columns of the detector: the centroids of column n begin at column[n]. */
  uint16_t column[STARCAT_COLUMNS + 1u];
  uint16_t in_column[STARCAT_MAX_CENTROIDS];

  /* Separations of pairs of centroids k > i, at k (k - 1) / 2 + i. */
  starcat_real separation_rad[STARCAT_MOST_PAIRS];
  uint16_t heap[STARCAT_MOST_PAIRS];

  /* The nearest centroids of each one in a crowded frame, for which pairs have no separations. */
  uint16_t neighbour[STARCAT_MAX_CENTROIDS][STARCAT_NEIGHBOURS];

  /* Stars that can be corners of a triangle of centroids: either of the first two, and each. */
  uint32_t either[STARCAT_MARKS];
  uint32_t corner[2][STARCAT_MARKS];
  uint32_t third[STARCAT_MARKS];

  /* The stars around the field of an attitude: rows in the image and ICRS directions. */
  uint32_t near_row[STARCAT_MAX_STARS];
  starcat_real near_icrs[STARCAT_MAX_STARS][3];

  /* The near stars on the detector or within reach of it: indices into the near stars, positions on
   * the detector, and the nearest centroid of each. */
  uint16_t within[STARCAT_MAX_STARS];
  starcat_real x_of[STARCAT_MAX_STARS];
  starcat_real y_of[STARCAT_MAX_STARS];
  uint16_t nearest[STARCAT_MAX_STARS];
  starcat_real nearest_square[STARCAT_MAX_STARS];

  /* Star of each centroid, -1: none. An index into `within`; `before`: near star one step ago. */
  int16_t match[STARCAT_MAX_CENTROIDS];
  int16_t before[STARCAT_MAX_CENTROIDS];
  starcat_real match_square[STARCAT_MAX_CENTROIDS];

  /* Logarithms of the ways to assign n centroids to stars; sums of the weights of such ways. */
  starcat_real log_ways[STARCAT_MAX_CENTROIDS + 1];
  starcat_real sums[2][STARCAT_MAX_CENTROIDS + 1];

  /* Votes for each star of a group, by bins of the rotation of the frame. */
  uint8_t votes[STARCAT_GROUP][STARCAT_BINS];

  starcat_agreement found;
  starcat_agreement wider;
  starcat_agreement start;
  starcat_agreement best;

  /* The identified centroids of the answer, their directions in both frames, and their weights. */
  uint16_t seen[STARCAT_MAX_CENTROIDS];
  starcat_real seen_body[STARCAT_MAX_CENTROIDS][3];
  starcat_real seen_icrs[STARCAT_MAX_CENTROIDS][3];
  starcat_real weight[STARCAT_MAX_CENTROIDS];
};

#endif
