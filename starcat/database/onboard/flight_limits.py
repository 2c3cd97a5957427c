"""The limits that the onboard library is compiled with in flight, and what exceeds them.

The library on the ground is compiled with larger limits (``binding/build.py``), so it identifies
frames that the library in flight refuses.
"""

from __future__ import annotations

from collections.abc import Iterator

FLIGHT_CENTROIDS = 64
FLIGHT_STARS = 192
"""``STARCAT_MAX_CENTROIDS`` and ``STARCAT_MAX_STARS`` of ``starcat.h``, unless they are changed."""

FLIGHT_STEPS = 4_000_000
"""``max_steps`` of ``starcat_set_default_options``."""


def stars_in_flight(most_near: int) -> Iterator[str]:
    """Yield a sentence if the library in flight refuses an image with this density."""
    if most_near > FLIGHT_STARS:
        yield (
            f"a field may have {most_near} stars: compile the onboard library with "
            f"-DSTARCAT_MAX_STARS={most_near}, as it holds {FLIGHT_STARS} otherwise"
        )


def centroids_in_flight(count: int) -> Iterator[str]:
    """Yield a sentence if the library in flight refuses a frame with this many centroids."""
    if count > FLIGHT_CENTROIDS:
        yield (
            f"the onboard library refuses a frame with {count} centroids "
            f"(STARCAT_E_TOO_MANY_CENTROIDS): give it the brightest {FLIGHT_CENTROIDS}, or compile "
            f"it with -DSTARCAT_MAX_CENTROIDS={count}"
        )
