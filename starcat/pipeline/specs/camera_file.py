"""Camera files: a camera as TOML, read and written.

A camera file has the keys of `KEYS` at its top or in a table ``[camera]``, so that a build
spec is a camera file too. `Camera` checks the values; this module adds the file and the key to
its errors.
"""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from starcat.errors import AsWritten, ConfigError, Unstated, suggest
from starcat.geometry.camera import Camera
from starcat.geometry.distortion import Distortion, checked_number
from starcat.pipeline.specs.build_spec import check_one_side
from starcat.storage.toml_files import content_of_toml, text_of_toml, toml_shown

SCALES = (
    ("focal_length_px",),
    ("fov_x_deg",),
    ("fov_y_deg",),
    ("fov_x_deg", "fov_y_deg"),
    ("focal_length_mm", "pixel_um"),
)
"""Allowed combinations of keys that determine the scale of a pixel on the sky."""

SIZES = ("width_px", "height_px")
SCALE_KEYS = tuple(dict.fromkeys(key for keys in SCALES for key in keys))
KEYS = (*SIZES, *SCALE_KEYS, "principal_point_px", "readout_s", "distortion")
COEFFICIENTS = tuple(field.name for field in fields(Distortion))


def read_camera(path: Path) -> Camera:
    """Read a camera from a TOML file."""
    return parse_camera(
        text_of_toml(path, "no such camera file; 'starcat calibrate' writes one"), path
    )


def parse_camera(text: str, path: Path, size_px: tuple[int, int] | None = None) -> Camera:
    """Return the camera of a TOML text; ``path`` is its name in messages.

    ``size_px`` is the width and height, if the text states neither.
    """
    content = content_of_toml(text, str(path))
    if "camera" not in content:
        if size_px is not None and not any(key in content for key in SIZES):
            content |= dict(zip(SIZES, size_px, strict=True))
        return _camera(content, path, "")
    for key in KEYS:
        if key in content:
            raise _error(path, key, content[key], "found outside [camera]; expected in it")
    return _camera(_table(content["camera"], path, "camera"), path, "camera.")


def camera_toml(camera: Camera) -> str:
    """Return a TOML text from which `read_camera` reads the same camera.

    Examples
    --------
    >>> print(camera_toml(Camera(1024, 768, 2000.0)), end="")
    width_px = 1024
    height_px = 768
    focal_length_px = 2000.0
    principal_point_px = [512.0, 384.0]
    """
    lines = [
        f"width_px = {camera.width_px}",
        f"height_px = {camera.height_px}",
        f"focal_length_px = {camera.focal_length_px!r}",
        f"principal_point_px = {list(camera.principal_point_px)!r}",
    ]
    if camera.readout_s is not None:
        lines.append(f"readout_s = {camera.readout_s!r}")
    if not camera.distortion.is_none:
        lines += ["", "[distortion]"]
        lines += [f"{name} = {value!r}" for name, value in asdict(camera.distortion).items()]
    return "\n".join(lines) + "\n"


def _camera(table: dict[str, Any], path: Path, prefix: str) -> Camera:
    # A spec is a camera file too; drop its keys about light, which are not geometry.
    table = {key: value for key, value in table.items() if key not in ("response", "exposure")}
    _refuse_unknown(table, KEYS, path, prefix)
    for key in SIZES:
        if key not in table:
            raise _error(path, prefix + key, None, "missing; every camera needs it")
    scale = tuple(key for key in SCALE_KEYS if key in table)
    if scale not in SCALES:
        raise ConfigError(
            f"found {' and '.join(scale) or 'no scale'}; expected one of "
            + ", ".join(" with ".join(keys) for keys in SCALES),
            where=path,
        )
    arguments = dict(table)
    inside = _table(arguments.pop("distortion", {}), path, f"{prefix}distortion")
    _refuse_unknown(inside, COEFFICIENTS, path, f"{prefix}distortion.")
    where = f"{prefix}distortion."
    try:
        check_one_side(table.get("pixel_um"))
    except ConfigError as error:
        error.key, error.value = f"{prefix}pixel_um", table["pixel_um"]
        raise error.in_file(f"{path}: {error.key}") from None
    try:
        distortion = Distortion(**inside)
        where = prefix
        if "pixel_um" in arguments:
            pixel_um = checked_number("pixel_um", arguments.pop("pixel_um"), 0.0)
            length_mm = checked_number("focal_length_mm", arguments.pop("focal_length_mm"), 0.0)
            arguments["focal_length_px"] = length_mm * 1000.0 / pixel_um
        return Camera(**arguments, distortion=distortion)
    except ConfigError as error:
        name = error.parameter or ""
        error.key, value = where + name, inside.get(name, table.get(name))
        error.parameter = error.key if name else None
        if error.value is not Unstated.UNSTATED:
            error.value = AsWritten(toml_shown(value))
        error_in_file = error.in_file(path)
        error_in_file.value = value
        raise error_in_file from error


def _refuse_unknown(
    table: dict[str, Any], allowed: tuple[str, ...], path: Path, prefix: str
) -> None:
    for key, value in table.items():
        if key not in allowed:
            hint = suggest(key, allowed)
            shown = key if key.isprintable() else repr(key)
            text = f"unknown key; {hint}known keys here: {', '.join(allowed)}"
            raise _error(path, prefix + shown, value, text)


def _table(value: object, path: Path, key: str) -> dict[str, Any]:
    if isinstance(value, dict):
        return value
    raise _error(path, key, value, f"found {toml_shown(value)}; expected a table")


def _error(path: Path, key: str, value: object, text: str) -> ConfigError:
    return ConfigError(text, where=f"{path}: {key}", key=key, value=value)
