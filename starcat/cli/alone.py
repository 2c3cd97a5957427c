"""The command ``starcat`` if only numpy, h5py and cffi are installed: it can only identify.

This is the command of ``starcat-matcher``, and of an installation with missing libraries.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.cli.messages import print_messages
from starcat.errors import StarcatError, advice_in_words
from starcat.version import __version__, missing_packages

if TYPE_CHECKING:
    from starcat.matcher.result import MatchResult

FOV_ERROR = 0.05
"""The default of ``starcat identify``, for methods that find the scale themselves."""

USAGE = 2


def run_alone(arguments: Sequence[str], missing: ModuleNotFoundError) -> int:
    """Run ``identify``, or print that another command is missing; return the exit code."""
    print_messages()
    command = next((word for word in arguments if not word.startswith("-")), "")
    if command not in ("", "identify"):
        return _refused(missing_packages(f"starcat {command}", missing), USAGE)
    try:
        options = _parser().parse_args(list(arguments) or ["--help"])
        _identify(options.database, options.frames, options.fov_error, as_lines=options.json)
    except StarcatError as error:
        return _refused(error.message(_option_of), error.exit_code)
    except ModuleNotFoundError as error:
        return _refused(missing_packages("starcat identify", error), USAGE)
    except BrokenPipeError:  # the reader of the output is gone
        return 1
    return 0


def _refused(text: str, code: int) -> int:
    sys.stderr.write(f"starcat: error: {text}\n")
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "starcat",
        description="Identifies stars. All other commands are in starcat-guide-stars, which also "
        "reads pictures and supports cameras other than the database's.",
    )
    parser.add_argument("--version", action="version", version=f"starcat {__version__} (matcher)")
    identify = parser.add_subparsers(metavar="identify").add_parser(
        "identify", description="Identify the stars of frames and find the camera's attitude."
    )
    identify.add_argument("database", help="the folder <name>-<version>, or an onboard image")
    identify.add_argument("frames", nargs="+", type=Path, help="centroids: CSV or JSON")
    identify.add_argument(
        "--fov-error", type=float, metavar="0.05", help="allowed error of the focal length"
    )
    identify.add_argument("--json", action="store_true", help="one line of JSON per frame")
    return parser


def _identify(
    database: str, files: Sequence[Path], fov_error: float | None, *, as_lines: bool
) -> None:
    from starcat.matcher.centroids import read_centroid_files
    from starcat.matcher.matcher import Matcher
    from starcat.matcher.settings import SCALE_FREE

    matcher = Matcher.open(database, None)
    default = FOV_ERROR if matcher.settings.method in SCALE_FREE else 0.0
    error = default if fov_error is None else fov_error
    for frame in (frame for path in files for frame in read_centroid_files(path)):
        result = matcher.identify(frame, fov_error=error)
        if as_lines:
            sys.stdout.write(json.dumps(_content(frame.name, result)) + "\n")
        else:
            sys.stdout.write(_text_of_result(frame.name, result))
    sys.stdout.flush()


def _content(name: str, result: MatchResult) -> dict[str, Any]:
    """Return an answer with the keys of ``starcat identify --json``."""
    content: dict[str, Any] = {
        "frame": name,
        "status": result.status,
        "n_matched": result.n_matched,
    }
    if result.refusal is not None:
        why = result.refusal
        refusal: dict[str, Any] = {"reason": why.reason, "message": why.message, "hint": why.hint}
        refusal["advice"] = list(why.advice)
        if why.candidate is not None:
            refusal["candidate"] = result.to_dict()["refusal"]["candidate"]
        return content | {"refusal": refusal}
    stars = result.stars
    numbers = ("x_px", "y_px", "mag", "ra_deg", "dec_deg", "dx_px", "dy_px")
    columns = {key: getattr(stars, key).tolist() for key in numbers}
    columns |= {"star": list(stars.star), "star_id": [str(number) for number in stars.star_id]}
    return content | {
        "boresight_ra_deg": result.boresight_ra_deg,
        "boresight_dec_deg": result.boresight_dec_deg,
        "roll_deg": result.roll_deg,
        "q_body_from_icrs": result.q_body_from_icrs.tolist(),
        "residual_arcsec": result.residual_arcsec,
        "false_match_probability": result.false_match_probability,
        "stars": [
            dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)
        ],
    }


def _option_of(parameter: str, value: str, item: str) -> str | None:
    """Return the option for a parameter, None for those of the whole ``starcat identify``."""
    return "--fov-error" if parameter == "fov_error" else None


def _text_of_result(name: str, result: MatchResult) -> str:
    lines = [f"{name}: {repr(result)[1:-1].removeprefix('MatchResult ')}"]
    if result.refusal is not None:
        hint = advice_in_words(result.refusal.advice, _option_of)
        lines.append(f"  {result.refusal.message}; hint: {hint}")
        if result.refusal.candidate is not None:
            lines.append(f"  candidate: {repr(result.refusal.candidate)[1:-1]}")
    if result.ok:
        stars = result.stars
        quaternion = ", ".join(f"{value:+.7f}" for value in result.q_body_from_icrs)
        lines.append(f"  q_body_from_icrs {quaternion}")
        lines += [
            f"  {x:9.2f} {y:9.2f}  {mag:6.2f}  {ra:10.5f} {dec:+10.5f}  {star}"
            for x, y, mag, ra, dec, star in zip(
                stars.x_px, stars.y_px, stars.mag, stars.ra_deg, stars.dec_deg, stars.star,
                strict=True,
            )
        ]  # fmt: skip
    return "\n".join([*lines, *(f"  remark: {remark}" for remark in result.remarks)]) + "\n"
