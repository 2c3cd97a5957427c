/* The parts of starcat.h and many.h that Python uses, for cffi. The compiler checks them.
 *
 * SPDX-License-Identifier: MIT
 */
typedef struct {
  uint16_t place;
  uint8_t turn, magnitude;
} starcat_neighbour;
typedef struct {
  double radius_rad;
  uint32_t capacity, n_stars;
  uint32_t *first;
  starcat_neighbour *neighbour;
} starcat_neighbours;
typedef struct {
  uint32_t total_bytes, data_bytes, method, n_stars, n_features, n_kvector, index_bytes;
  uint32_t grid_bands, grid_sectors;
  const starcat_neighbours *neighbours;
  ...;
} starcat_image;
typedef struct {
  double width_px, height_px, focal_length_px;
  double x0_px, y0_px;
  double k1, k2, k3, p1, p2;
  double fold_radius;
} starcat_camera;
typedef struct {
  double tolerance_px, noise_px, noise_mag, log_chance, fov_error, camera_error;
  uint32_t max_steps;
} starcat_options;
typedef struct {
  const starcat_image *image;
  const starcat_camera *camera;
  const starcat_options *options;
  const int32_t *rows;
} starcat_search;
typedef struct {
  int32_t status;
  int32_t reason;
  int32_t n_matched;
  int32_t n_usable;
  int64_t steps;
  double seconds;
  double chance;
  double share;
  double focal_length_px;
  double residual_arcsec;
  double reduced_chi_square;
  double q_body_from_icrs[4];
  double matrix[3][3];
  double covariance_arcsec2[3][3];
  double shape[6];
  int64_t n_shape;
} starcat_frame_answer;
typedef struct {
  starcat_frame_answer answer;
  int32_t stars[...];
  ...;
} starcat_memory;
#define STARCAT_OK ...
#define STARCAT_IDENTIFIED ...
#define STARCAT_MAX_CENTROIDS ...
#define STARCAT_MAX_STARS ...
#define STARCAT_OF_CANDIDATE ...
const char *starcat_version(void);
int starcat_open_image(starcat_image *image, const void *bytes, size_t size, uint32_t flags);
int starcat_list_all_neighbours(const starcat_image *image, starcat_neighbours *table);
int starcat_identify_one(const starcat_search *search, uint32_t count, const void *pairs_px,
                         const void *magnitudes, const void *sigma_px, const void *q_prior,
                         double uncertainty_rad, starcat_memory *memory);
void starcat_identify_many(const starcat_search *search, uint32_t first, uint32_t stop,
                           const int64_t *starts, const double *pairs_px, const double *magnitudes,
                           const double *sigma_px, starcat_frame_answer *answers, int32_t *stars,
                           void *star_ids, starcat_memory *memory);
