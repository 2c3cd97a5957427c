"""A sky in memory that most tests of the matcher share."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from starcat.matcher.database import MatcherDatabase


@pytest.fixture(scope="session")
def sky(
    sky_of: Callable[..., MatcherDatabase], random_directions: Callable[..., object]
) -> MatcherDatabase:
    """1,200 stars with pairs and triangles for a camera of 20 deg; nothing in it is changed."""
    return sky_of(random_directions(1200, 1))
