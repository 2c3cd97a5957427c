"""Options of commands for frames that are expected somewhere: a prior attitude, a sequence."""

from __future__ import annotations

from typing import Annotated

import typer

from starcat.errors import ConfigError

PriorAttitude = Annotated[
    str | None,
    typer.Option(
        "--prior-q", metavar="X,Y,Z,W", help="Expected attitude: only stars near it are compared."
    ),
]
PriorErrorDeg = Annotated[
    float | None, typer.Option(help="Largest error of --prior-q, an angle; at most 20.")
]
Track = Annotated[
    bool, typer.Option("--track", help="The frames are a sequence: each is sought near the last.")
]


def chosen_prior(
    text: str | None, error_deg: float | None, *, track: bool
) -> tuple[list[float], float] | None:
    """Return the attitude that ``--prior-q`` and ``--prior-error-deg`` say."""
    if text is None and error_deg is None:
        return None
    if text is None or error_deg is None:
        raise ConfigError("--prior-q and --prior-error-deg go together; give both, or neither")
    if track:
        raise ConfigError("--track finds the priors itself; leave out --prior-q, or --track")
    try:
        x, y, z, w = (float(part) for part in text.split(","))
    except ValueError as error:
        raise ConfigError(
            f"--prior-q {text!r} is not X,Y,Z,W, four numbers such as 0.1,-0.2,0.3,0.9"
        ) from error
    return [x, y, z, w], error_deg
