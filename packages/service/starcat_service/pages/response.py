"""The response of the sensor on the page *New database*: picked from a list, or from a CSV file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

from starcat.catalog.bands import response_from_text, shipped, shipped_names
from starcat.errors import ConfigError
from starcat.pipeline.specs import MAX_ROWS, value_at

NAME = "camera.response.name"
FILE = "response_file"  # field of a form with a CSV file; its error appears next to it
PER = "response_per"  # per photon or energy, if the file does not state it

MAX_BYTES = 500_000

_OWN = ("per", "wavelength_nm", "value")
"""Keys of a response that stands in the spec."""

_OTHERS = ("file", "optics_file", "optics_wavelength_nm", "optics_transmission")
_LATER = ("photometry", "zero_point")


def responses_of(current: str) -> list[tuple[str, str]]:
    """Return name and text of the responses that a design may choose from, its own one included."""
    responses = [("", "the catalog's band")]
    responses += [(name, f"{name}: {shipped(name).title}") for name in shipped_names()]
    if current and current not in shipped_names():
        responses.append((current, f"{current[:60]}: from a file"))
    return responses


def keys_of_another(content: Mapping[str, Any], name: str) -> dict[str, None]:
    """Return the keys that are removed with a response if another one, or none, is chosen."""
    gone = _OWN if name else (*_OWN, *_OTHERS, *_LATER)
    keys = [f"camera.response.{key}" for key in gone]
    return dict.fromkeys(key for key in keys if value_at(content, key) is not None)


def keys_of_file(filename: str, content: bytes, per: str) -> dict[str, Any]:
    """Return the keys of a spec that a CSV file gives, with the numbers that are in it."""
    try:
        name = _name(filename)
        if len(content) > MAX_BYTES:
            raise ConfigError(f"it has more than {MAX_BYTES:,} bytes")
        text = content.decode("utf-8-sig")
        try:
            response = response_from_text(name, text, None)
        except ConfigError as error:
            if error.key != "per" or per not in ("photon", "energy"):
                raise
            response = response_from_text(name, text, "photon" if per == "photon" else "energy")
        if len(response.value) > MAX_ROWS:
            raise ConfigError(
                f"it has {len(response.value):,} rows, and a spec {MAX_ROWS:,} at most"
            )
    except (ConfigError, UnicodeDecodeError) as error:
        message = str(error)
        if isinstance(error, UnicodeDecodeError):
            message = "it is no text; give a CSV file of two columns, wavelength in nm and response"
        raise ConfigError(f"{PurePath(filename).name[:60]}: {message}", key=FILE) from error
    table = {"wavelength_nm": response.wavelength_nm.tolist(), "value": response.value.tolist()}
    keys = {"name": name, "per": response.counts, **table}
    return {f"camera.response.{key}": value for key, value in keys.items()}


def _name(filename: str) -> str:
    """Return the name of a file as the name of a response, none that ships with starcat."""
    stem = re.sub(r"[^0-9A-Za-z._-]+", "-", PurePath(filename).stem).strip("-._")[:28] or "sensor"
    return f"{stem}-own" if stem in shipped_names() else stem
