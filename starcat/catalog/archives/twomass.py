"""2MASS Point Source Catalog: meaning of the records.

Positions are ICRS at the date of observation (1997-2001), without proper motion. Flags have
one character per band, in the order J, H, Ks. Stars brighter than about 4 mag are saturated
(rd_flg 3) and their magnitudes come from a fit to the wings: kept, with a quality bit.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.photometry import blend_weights
from starcat.catalog.readers.records import ParsedRecords
from starcat.catalog.stars.star_table import Columns, join_flags, known_errors, text_column
from starcat.catalog.stars.verdict import Quality, Reason, Verdicts, quality_flags

COLUMNS = {
    "psc": (
        "ra", "dec", "designation", "j_m", "h_m", "k_m", "ph_qual", "rd_flg", "bl_flg", "cc_flg",
        "gal_contam", "mp_flg", "pts_key", "jdate", "use_src", "err_maj", "j_msigcom",
        "h_msigcom", "k_msigcom",
    ),
}  # fmt: skip

_BANDS = {"J": (0, "j_m"), "H": (1, "h_m"), "Ks": (2, "k_m")}
_ERRORS = {"J": "j_msigcom", "H": "h_msigcom", "Ks": "k_msigcom"}


def stars(records: ParsedRecords, band: str, verdicts: Verdicts) -> Columns:
    """Return the star-table columns of 2MASS records."""
    weights = blend_weights(band)
    mags = {name: _measured(records, name) for name in _BANDS}
    number = _identity(records)
    verdicts.reject(number == 0, Reason.no_identity)
    verdicts.reject(np.isnan(records["ra"]) | np.isnan(records["dec"]), Reason.no_position)
    verdicts.reject(records["use_src"] == 0, Reason.duplicate_record)
    verdicts.reject(records["mp_flg"] == 1, Reason.minor_planet)
    verdicts.reject(records["gal_contam"] == 1, Reason.extended)
    verdicts.reject(_any_flag(records, "cc_flg", b"PCDSB", weights), Reason.artifact)
    second = "Ks" if "Ks" not in weights else "H" if "H" not in weights else "J"
    colour = "J-H" if second == "Ks" else "J-Ks"
    blended = _any_flag(records, "bl_flg", b"23456789", weights)
    epoch_jyear = 2000.0 + (records["jdate"] - 2451545.0) / 365.25
    error_mas = 1000.0 * known_errors(records["err_maj"])
    return {
        "star_id": number,
        "designation": pc.binary_join_element_wise(
            "2MASS J", text_column(records["designation"]), ""
        ),
        "ra_deg": records["ra"],
        "dec_deg": records["dec"],
        "epoch_jyear": epoch_jyear,
        "ra_error_mas": error_mas,  # the larger axis of the ellipse for both
        "dec_error_mas": error_mas,
        "ra_central_jyear": epoch_jyear,
        "dec_central_jyear": epoch_jyear,
        "mag": _blend(mags, weights),
        "mag_error": np.sqrt(
            sum((weight * known_errors(records[_ERRORS[n]])) ** 2 for n, weight in weights.items())
        ),
        "band": band,
        "second_mag": mags[second],
        "second_band": second,
        "colour_mag": mags["J"] - mags[colour[2:]],
        "colour_bands": colour,
        "double_flag": join_flags({"bl_flg": (blended, records["bl_flg"])}),
        "is_flagged_double": blended,
        "quality_flags": quality_flags(
            len(records),
            {
                Quality.SATURATED: _any_flag(records, "rd_flg", b"3", weights),
                Quality.BLENDED: blended,
                Quality.POOR_PHOTOMETRY: _any_flag(records, "ph_qual", b"DEF", weights),
                Quality.CONTAMINATED: _any_flag(records, "cc_flg", b"pcdsb", weights)
                | (records["gal_contam"] == 2),
            },
        ),
    }


def magnitudes(records: ParsedRecords, band: str) -> Array:
    """Return the magnitudes of 2MASS records."""
    weights = blend_weights(band)
    return _blend({name: _measured(records, name) for name in weights}, weights)


def _blend(mags: Mapping[str, Array], weights: Mapping[str, float]) -> Array:
    return np.asarray(np.sum([weight * mags[name] for name, weight in weights.items()], 0))


def _measured(records: ParsedRecords, band: str) -> Array:
    """Return the measured magnitudes; NaN for upper limits and bands without a source."""
    _, column = _BANDS[band]
    limit = _any_flag(records, "ph_qual", b"UX", {band: 1.0})
    unmeasured = _any_flag(records, "rd_flg", b"069", {band: 1.0})
    return np.where(limit | unmeasured, np.nan, records[column])


def _any_flag(records: ParsedRecords, column: str, codes: bytes, bands: dict[str, float]) -> Mask:
    """Return the records whose flag column has one of the codes in any of the bands."""
    text = records[column]
    chars = text.view(np.uint8).reshape(len(text), text.dtype.itemsize)
    is_wanted = np.zeros(256, dtype=bool)
    is_wanted[list(codes)] = True
    has_flag = np.zeros(len(text), dtype=bool)
    for band in bands:
        index = _BANDS[band][0]
        if index < chars.shape[1]:
            has_flag |= is_wanted[chars[:, index]]
    return has_flag


def _identity(records: ParsedRecords) -> NDArray[np.int64]:
    """Return pts_key, or else the designation as a number above all keys; 0 if both are missing.

    The last 15 digits of the number are the digits of ``hhmmssss+ddmmsss``. The two digits before
    them, the 16th and 17th from the right, are the component letter: 1 for A, 0 without a letter.
    The 19th digit from the right is the hemisphere: 1 for north, 2 for south.
    """
    key = records["pts_key"]
    number: NDArray[np.int64] = np.nan_to_num(key).astype(np.int64)
    unknown = np.isnan(key)
    if unknown.any():
        number[unknown] = _packed(records["designation"][unknown])
    return number


def _packed(text: NDArray[np.bytes_]) -> NDArray[np.int64]:
    """Return designations as numbers; 0 for any other text."""
    chars = np.zeros((len(text), 20), dtype=np.uint8)
    octets = text.view(np.uint8).reshape(len(text), text.dtype.itemsize)[:, :20]
    chars[:, : octets.shape[1]] = octets
    digits = chars[:, [*range(8), *range(9, 16)]].astype(np.int64) - ord("0")
    sign, tail = chars[:, 8], chars[:, 16:].max(axis=1)
    component = np.where(tail >= ord("A"), tail.astype(np.int64) - ord("A") + 1, 0)
    packed = digits @ (10 ** np.arange(14, -1, -1, dtype=np.int64)) + component * 10**15
    packed += np.where(sign == ord("-"), 2, 1) * 10**18
    is_regular = ((digits >= 0) & (digits <= 9)).all(axis=1) & np.isin(sign, [ord("+"), ord("-")])
    return np.where(is_regular, packed, 0)
