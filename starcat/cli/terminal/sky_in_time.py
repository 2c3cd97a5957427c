"""What ``starcat identify --time`` prints beside the answers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from starcat.cli.terminal.console import print_table
from starcat.sky.in_time import SkyInTime


def sky_as_dict(sky: SkyInTime | None) -> dict[str, Any] | None:
    """Return what a time adds to an answer, as JSON has it under the key ``in_time``."""
    if sky is None:
        return None
    return {**asdict(sky), "q_body_from_icrs": sky.q_body_from_icrs.tolist()}


def print_sky_in_time(names: Sequence[str], skies: Sequence[SkyInTime | None]) -> None:
    """Print true attitudes, exclusion angles and the bodies in the frames."""
    known = [(name, sky) for name, sky in zip(names, skies, strict=True) if sky is not None]
    if not known:
        return
    print_table(
        f"With aberration, at {known[0][1].time}",
        ("frame", "RA deg", "Dec deg", "roll deg", "corrected arcsec", "rms arcsec", "Sun deg",
         "Moon deg", "Earth limb deg"),
        [(name, *_angles(sky)) for name, sky in known],
        numbers=(1, 2, 3, 4, 5, 6, 7, 8),
    )  # fmt: skip
    bodies = [
        (
            name,
            body.name,
            f"{body.x_px:.1f}",
            f"{body.y_px:.1f}",
            f"{body.mag:.1f}",
            f"{body.from_boresight_deg:.2f}",
            "yes" if body.row is not None else "no",
        )
        for name, sky in known
        for body in sky.bodies
    ]
    if bodies:
        heads = ("frame", "body", "x px", "y px", "mag", "from boresight deg", "spot")
        print_table("Planets in the frame", heads, bodies, numbers=(2, 3, 4, 5))


def _angles(sky: SkyInTime) -> tuple[str, ...]:
    limb = sky.earth_limb_angle_deg
    return (
        f"{sky.boresight_ra_deg:.5f}",
        f"{sky.boresight_dec_deg:.5f}",
        f"{sky.roll_deg:.5f}",
        f"{sky.correction_arcsec:.2f}",
        f"{sky.residual_arcsec:.2f}",
        f"{sky.sun_angle_deg:.2f}",
        f"{sky.moon_angle_deg:.2f}",
        "" if limb is None else f"{limb:.2f}",
    )
