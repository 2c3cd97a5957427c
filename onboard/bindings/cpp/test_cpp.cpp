// The header for C++: a frame identified and tracked, lengths that differ, an image that is none.
//
// SPDX-License-Identifier: MIT
#include <array>
#include <cstdio>
#include <vector>

#include "starcat.hpp"

extern "C" {
#include "random_sky.h"
}

static int failures = 0;

static void check(bool holds, const char *what) {
  if (!holds) {
    (void)std::fprintf(stderr, "not so: %s\n", what);
    failures++;
  }
}
#define CHECK(condition) check(condition, #condition)

static std::uint64_t words[SKY_MOST_BYTES / 8u];

int main() {
  const sky_recipe recipe = {1, 2, SKY_STARS, 0.42, 8};
  const std::size_t size = sky_image(&recipe, reinterpret_cast<std::uint8_t *>(words));
  static starcat::image image(starcat::span<const std::uint64_t>(words, size / 8u));
  CHECK(bool(image));
  CHECK(image.name() == "sky-1.0.0");
  CHECK(image.star_ids().size() == SKY_STARS);
  std::uint32_t bad = 9;
  CHECK(image.scrub(0, 2, bad) == STARCAT_OK && bad == 0);

  static starcat::matcher matcher(image);
  matcher.options.noise_px = starcat::real(0.3);
  std::uint64_t state = 4;
  sky_frame truth;
  sky_look(image.get(), &matcher.camera, &state, 0.2, SKY_SPOTS, 0, &truth);
  const std::vector<starcat::real> x(truth.x, truth.x + truth.count),
      y(truth.y, truth.y + truth.count);
  std::array<starcat::real, 4> few{};
  const starcat::prior near = {{truth.q_body_from_icrs[0], truth.q_body_from_icrs[1],
                                truth.q_body_from_icrs[2], truth.q_body_from_icrs[3]},
                               starcat::real(0.01)};
  for (const bool is_tracked : {false, true}) {
    const starcat::frame frame = {x, y};
    CHECK((is_tracked ? matcher.track(frame, near) : matcher.identify(frame)) ==
          STARCAT_IDENTIFIED);
    CHECK(matcher.stars().size() == truth.count);
    for (std::size_t n = 0; n < matcher.stars().size(); n++) {
      CHECK(matcher.stars()[n] == truth.star[n]);
    }
    CHECK(matcher.result().n_matched == truth.count);
  }
  CHECK(matcher.identify({x, few}) == STARCAT_E_NULL);
  CHECK(matcher.identify({x, y, few}) == STARCAT_E_NULL);
  CHECK(matcher.stars().empty());
  CHECK(matcher.identify({few, few}) == STARCAT_TOO_FEW_STARS);
  const std::vector<starcat::real> many(STARCAT_MAX_CENTROIDS + 1);
  CHECK(matcher.identify({many, many}) == STARCAT_E_TOO_MANY_CENTROIDS);

  // The table of neighbours: too little memory, then enough; the same answer.
  static std::uint32_t first[SKY_STARS + 1];
  static starcat_workspace work;
  starcat_neighbours table = {starcat::real(0.475), 0, 0, first, nullptr};
  CHECK(image.list_neighbours(table, work) == STARCAT_E_CAPACITY);
  CHECK(image.get()->neighbours == nullptr && first[SKY_STARS] > SKY_STARS);
  std::vector<starcat_neighbour> neighbours(first[SKY_STARS]);
  table.capacity = first[SKY_STARS];
  table.neighbour = neighbours.data();
  CHECK(image.list_neighbours(table, work) == STARCAT_OK);
  CHECK(image.get()->neighbours == &table && table.n_stars == SKY_STARS);
  CHECK(matcher.identify({x, y}) == STARCAT_IDENTIFIED);
  CHECK(matcher.result().n_matched == truth.count);

  const starcat::image none(starcat::span<const std::uint64_t>(words + 1, size / 8u - 1u));
  static starcat::matcher idle(none);
  CHECK(none.status() == STARCAT_E_MAGIC && idle.identify({x, y}) == STARCAT_E_MAGIC);
  (void)std::printf("starcat.hpp: %d checks failed\n", failures);
  return failures == 0 ? 0 : 1;
}
