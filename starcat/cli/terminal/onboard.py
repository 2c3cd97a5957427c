"""What export and inspect print of onboard images."""

from __future__ import annotations

from starcat.cli.terminal.console import print_json, print_table, say
from starcat.exchange.onboard import ExportedImage
from starcat.onboard.layout import DIRECTION_SCALE
from starcat.onboard.reading import OnboardImage

LIBRARY_STARS = 192
"""Stars in a field that the onboard library holds unless it is told otherwise."""

_ARCSEC_QUANTUM = 206264.80624709636 / DIRECTION_SCALE


def print_exported_image(exported: ExportedImage, *, as_json: bool) -> None:
    """Print what was written, and say what was left out on stderr."""
    fitted, made = exported.fitted, exported.made
    noun = _features(fitted.contents.method)
    if fitted.features < fitted.features_before:
        say(f"{fitted.features_before - fitted.features:,} {noun} are left out, to fit")
    if fitted.stars_per_field is not None:
        say(
            f"{fitted.stars_before - fitted.stars:,} stars are left out, to fit: those that are "
            f"not among the {fitted.stars_per_field} brightest of a field"
        )
    if made.most_near > LIBRARY_STARS:
        say(
            f"a field may have {made.most_near} stars: compile the onboard library with "
            f"-DSTARCAT_MAX_STARS={made.most_near}, as it holds {LIBRARY_STARS} otherwise"
        )
    if as_json:
        print_json(exported.as_dict())
        return
    rows = [
        ("method, byte order", f"{fitted.contents.method}, {exported.byte_order}-endian"),
        ("stars", f"{fitted.stars:,} of {fitted.stars_before:,}"),
        (noun, f"{fitted.features:,} of {fitted.features_before:,}"),
        ("image", f"{len(made.data):,} bytes"),
        *(("file", str(path)) for path in exported.files),
    ]
    print_table(f"{fitted.contents.name} as {exported.file_format}", ("", ""), rows)


def print_image(image: OnboardImage, *, as_json: bool) -> None:
    """Print what an image holds."""
    if as_json:
        print_json(image.as_dict())
        return
    header = image.header
    rows = [
        ("format", f"{image.version}, {image.byte_order}-endian"),
        ("epoch", f"J{header['epoch_jyear']:g}"),
        ("camera", image.camera.in_words),
        ("method", image.method),
        ("stars", f"{header['n_stars']:,}, at most {header['most_near']} near a field"),
        (_features(image.method), f"{header['n_features']:,}"),
        ("quantum", f"{_ARCSEC_QUANTUM:.2g} arcsec, 0.001 mag"),
        ("manifest", f"sha256 {image.manifest_sha256}"),
        ("image", f"{len(image.data):,} bytes"),
    ]
    print_table(image.name, ("", ""), rows)
    sections = [
        (name, f"{len(part):,}", f"{part.nbytes:,}") for name, part in image.sections.items()
    ]
    print_table("", ("section", "rows", "bytes"), sections, numbers=(1, 2))


def _features(method: str) -> str:
    return "triangles" if method == "triangle" else "pairs"
