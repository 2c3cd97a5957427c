"""The command ``starcat-astap``: N.I.N.A., Ekos, SharpCap and others call it in place of ASTAP.

It solves one picture and writes the files that those programs read: ``<base>.ini``, and if it is
solved ``<base>.wcs``, a FITS header. Options of ASTAP without a meaning here are ignored.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.cli.console import say
from starcat.errors import ProductError, StarcatError
from starcat.storage.atomic import write_file

if TYPE_CHECKING:
    from astropy.io.fits import Header

    from starcat.matcher.matcher import Matcher
    from starcat.pipeline.specs.build_spec import BuildSpec

SOLVED, NOT_SOLVED, TOO_FEW_STARS, NO_PICTURE, NO_DATABASE, BAD_DATABASE = 0, 1, 2, 16, 32, 33
"""Exit codes of ASTAP."""

_SCALE_ERROR = 0.1
"""Allowed relative error of the field of view that a program states."""
_TAKEN = (*("-r", "-ra", "-spd", "-z", "-s", "-t", "-m", "-check", "-speed", "-D"),)
_KEYS = (
    *("CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2", "CDELT1", "CDELT2"),
    *("CROTA1", "CROTA2", "CD1_1", "CD1_2", "CD2_1", "CD2_2"),
)


def astap_main() -> None:
    """Run the command."""
    sys.exit(run_astap(sys.argv[1:]))


def run_astap(arguments: Sequence[str]) -> int:
    """Solve a picture with ASTAP's options; return ASTAP's exit code."""
    astap_options, _ = _parser().parse_known_args(arguments)
    picture = Path(astap_options.f)
    base = Path(astap_options.o) if astap_options.o else picture.with_suffix("")
    command = " ".join(["starcat-astap", *arguments])
    code, facts, header = _solved(picture, astap_options)
    if header is not None:
        text = header.tostring(sep="" if astap_options.wcs else "\r\n", padding=astap_options.wcs)
        write_file(base.with_suffix(".wcs"), text.encode("ascii"))
    entries = {"PLTSOLVD": "F" if header is None else "T", **facts, "CMDLINE": command}
    text = "".join(f"{key}={value}\r\n" for key, value in entries.items())
    write_file(base.with_suffix(".ini"), text.encode())
    say(facts.get("ERROR") or f"solved: {base.with_suffix('.ini')}")
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser("starcat-astap", description=__doc__, allow_abbrev=False)
    parser.add_argument("-f", required=True, metavar="FILE", help="the picture")
    parser.add_argument(
        "-fov", type=float, default=0.0, metavar="DEG", help="height of the field; 0: unknown"
    )
    parser.add_argument("-o", metavar="BASE", help="path of the results without a suffix")
    parser.add_argument(
        "-d",
        default=os.environ.get("STARCAT_DATABASE", ""),
        metavar="FOLDER",
        help="a database; by default $STARCAT_DATABASE",
    )
    parser.add_argument("-wcs", action="store_true", help="write the .wcs as FITS, not in lines")
    for flag in ("-update", "-log", "-progress", "-annotate"):
        parser.add_argument(flag, action="store_true", help=argparse.SUPPRESS)
    for option in _TAKEN:
        parser.add_argument(option, help=argparse.SUPPRESS)
    return parser


def _solved(
    picture: Path, astap_options: argparse.Namespace
) -> tuple[int, dict[str, str], Header | None]:
    from starcat.database.reader import open_database_folder
    from starcat.frames.images.image_file import read_image
    from starcat.frames.images.solve_files import open_matcher
    from starcat.matcher.options import IdentifyOptions
    from starcat.pipeline.specs.reading import spec_of_database

    if not astap_options.d:
        message = "no database: give its folder with -d, or in $STARCAT_DATABASE"
        return NO_DATABASE, {"ERROR": message}, None
    try:
        matcher = open_matcher(Path(astap_options.d), IdentifyOptions())
        spec = spec_of_database(open_database_folder(Path(astap_options.d)))
    except StarcatError as error:
        missing = isinstance(error, ProductError) and not Path(astap_options.d).is_dir()
        return NO_DATABASE if missing else BAD_DATABASE, {"ERROR": str(error)}, None
    try:
        height_px, width_px = read_image(picture).shape
        options = _scale(spec, astap_options.fov * width_px / height_px)
        return _identified(picture, matcher, options)
    except StarcatError as error:
        return NO_PICTURE, {"ERROR": str(error)}, None


def _identified(
    picture: Path, matcher: Matcher, options: dict[str, Any]
) -> tuple[int, dict[str, str], Header | None]:
    """Identify a picture with its first row at the top or bottom: programs send both."""
    from astropy.io import fits

    from starcat.frames.images.image_file import wcs_header
    from starcat.frames.images.solve_files import identify_either_way
    from starcat.matcher.options import IdentifyOptions

    answers, frame_answers = identify_either_way(picture, matcher, IdentifyOptions(**options))
    result = frame_answers[0].result
    if result.ok:
        text = wcs_header(result, picture, flip=answers.options.flip)
        header = fits.Header.fromstring(text.decode())
        return SOLVED, _facts(header), header
    why = result.refusal
    code = TOO_FEW_STARS if result.status == "too_few_stars" else NOT_SOLVED
    return code, {"ERROR": result.status if why is None else f"{why.message}; {why.hint}"}, None


def _scale(spec: BuildSpec, fov_deg: float) -> dict[str, Any]:
    """Return the options of the scale; a width of 0 is unknown."""
    if not spec.is_for_a_range:
        return {"fov_error": _SCALE_ERROR} if fov_deg else {}
    narrow, wide = spec.fields_deg
    if fov_deg:
        narrow = min(max(narrow, fov_deg * (1.0 - _SCALE_ERROR)), wide)
        wide = max(min(wide, fov_deg * (1.0 + _SCALE_ERROR)), narrow)
    return {"fov_deg": (narrow, wide)}


def _facts(header: Header) -> dict[str, str]:
    """Return the keys of a solution with the scales and rotations of axes that ASTAP adds."""
    from astropy.wcs import WCS

    (a, b), (c, d) = WCS(header, naxis=2).pixel_scale_matrix
    sign = 1.0 if a * d - b * c >= 0.0 else -1.0
    scale_keys = {
        "CD1_1": a, "CD1_2": b, "CD2_1": c, "CD2_2": d,
        "CDELT1": sign * math.hypot(a, c), "CDELT2": math.hypot(b, d),
        "CROTA1": math.degrees(math.atan2(sign * c, sign * a)),
        "CROTA2": math.degrees(math.atan2(-b, d)),
    }  # fmt: skip
    header.update(scale_keys)
    return {key: f"{float(header[key]): .16E}" for key in _KEYS}
