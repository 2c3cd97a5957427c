"""Star tables in the band of a sensor: every magnitude is predicted, with its error and origin.

The catalog's own magnitude stays in ``catalog_mag``. Of all relations whose magnitudes are known
for a star, the most exact is used. A star without a colour is predicted from its spectral type,
and a star without a type by the mean of all stars.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from starcat.arrays import Array, Mask
from starcat.catalog.bands.catalogs import colour_of, relations_of
from starcat.catalog.bands.measured import colour_share, companion_error, variation_error
from starcat.catalog.bands.photometry import band_error
from starcat.catalog.bands.relation import Prediction, Relation, combined, predict_by_type
from starcat.catalog.bands.response import Response, shipped_names
from starcat.catalog.stars.star_table import floats_of, with_columns
from starcat.catalog.stars.verdict import Quality
from starcat.errors import ConfigError

ALONE = " alone"
"""Suffix of the origin of a magnitude that was predicted by the mean of all stars of the band."""


@dataclass(frozen=True)
class InBand:
    """A star table in the band of a sensor."""

    stars: pa.Table
    response: Response
    band: str  # the catalog's band
    counts: dict[str, int]  # stars by the origin of their magnitude
    outside: int  # stars whose colour is outside the range of the relation
    relation: Relation | None  # the relation that predicted most stars


@dataclass(frozen=True)
class Other:
    """Magnitudes of some of the stars predicted from another catalog, arrays of shape (M,)."""

    source: str
    rows: NDArray[np.int64]  # rows of the stars
    prediction: Prediction
    code: NDArray[np.int32]  # origin of each magnitude: an index into ``origins``
    origins: tuple[str, ...]
    doubt_mag: Array  # errors due to companions and variability


def in_sensor_band(
    stars: pa.Table, source: str, response: Response, others: Sequence[Other] = ()
) -> InBand:
    """Return a star table with its magnitudes in the band of a sensor.

    Predictions from other catalogs for the same stars are averaged with it, weighted by the errors.
    """
    band = _only(stars, "band") or ""
    predicted, best = _predicted(stars, source, response)
    for other in others:
        predicted.mix(other)
    doubt = _doubt(stars)
    for other in others:
        doubt[other.rows] = np.fmax(doubt[other.rows], other.doubt_mag)
    columns = {
        "mag": predicted.mag,
        "band": response.name,
        "mag_error": np.hypot(predicted.error, doubt),
        "mag_source": pa.array(predicted.origins).take(
            pa.array(predicted.code, mask=np.isnan(predicted.mag))
        ),
        "catalog_mag": floats_of(stars, "mag"),
        "catalog_band": band,
        "quality_flags": stars["quality_flags"].to_numpy() | predicted.flags(),
    }
    has_mag = np.isfinite(predicted.mag)
    numbers = np.bincount(predicted.code[has_mag], minlength=len(predicted.origins)).tolist()
    counts = {name: n for name, n in sorted(zip(predicted.origins, numbers, strict=True)) if n}
    outside = int(np.count_nonzero(predicted.is_outside & has_mag))
    return InBand(with_columns(stars, columns), response, band, counts, outside, best)


def other_of(
    counterparts: pa.Table, rows: NDArray[np.int64], source: str, response: Response
) -> Other:
    """Return the magnitudes predicted from counterparts of stars, in the order of ``rows``."""
    predicted, _ = _predicted(counterparts, source, response)
    origins = tuple(predicted.origins)
    return Other(source, rows, predicted.prediction, predicted.code, origins, _doubt(counterparts))


def _doubt(stars: pa.Table) -> Array:
    """Return the errors of magnitudes due to companions and variability, mag."""
    variation = variation_error(_is_flagged(stars, "variable"), floats_of(stars, "amplitude_mag"))
    return np.hypot(companion_doubt(stars), variation)


def companion_doubt(stars: pa.Table) -> Array:
    """Return the errors that companions add to the magnitudes of a star table, mag."""
    error = companion_error(
        _is_flagged(stars, "double"),
        pc.is_valid(stars["double_flag"]).to_numpy(),
        floats_of(stars, "companion_separation_arcsec"),
        floats_of(stars, "companion_delta_mag"),
    )
    colours = _colours(stars)
    return error * colour_share(colours["BP-RP"]) if "BP-RP" in colours else error


def _is_flagged(stars: pa.Table, what: str) -> Mask:
    return np.asarray(pc.fill_null(stars[f"is_flagged_{what}"], False).to_numpy())


def _predicted(
    stars: pa.Table, source: str, response: Response
) -> tuple[_Predicted, Relation | None]:
    """Return magnitudes without variability, and the most exact relation."""
    band = _only(stars, "band") or ""
    predicted = _Predicted(len(stars))
    if not len(stars):
        return predicted, None
    if band not in shipped_names():
        raise ConfigError(
            f"the passband of {source} {band!r} is unknown, so it cannot predict a sensor's band",
            where="catalog.band",
            key="catalog.band",
            value=band,
            hint="choose another, such as J, H or Ks of 2mass",
        )
    mags, colours = _magnitudes(stars, band), _colours(stars)
    best: Relation | None = None
    for relation in relations_of(list(mags), list(colours), response):
        text, base = "-".join(relation.colour), mags[relation.base]
        error = _error(stars, relation.base, base, source, is_own=relation.base == band)
        colour_error = np.hypot(*(band_error(colour_band, base) for colour_band in relation.colour))
        prediction = relation.predict(base, colours[text], error, colour_error)
        took = predicted.take(prediction, f"{relation.base}, {text}", prediction.has_colour)
        best = best or (relation if took else None)
    mag, error = mags[band], _error(stars, band, mags[band], source, is_own=True)
    if predicted.is_open.any() and stars["spectral_type"].null_count < len(stars):
        types = [text or "" for text in stars["spectral_type"].to_pylist()]
        prediction = predict_by_type(band, response, mag, types, error)
        predicted.take(prediction, f"{band}, spectral type", prediction.has_colour)
    if predicted.is_open.all():
        raise ConfigError(
            f"no star of {source} has a colour or a spectral type, so magnitudes "
            "in that band cannot be predicted",
            where=response.name,
            key="camera.response",
            value=source,
            hint="choose a catalog with colours: gaia, hipparcos, tycho2 or 2mass",
        )
    prediction = predict_by_type(band, response, mag, [""] * len(stars), error)
    predicted.take(prediction, f"{band}{ALONE}", np.ones(len(stars), dtype=bool))
    return predicted, best


class _Predicted:
    """The magnitudes of stars, filled in relation by relation."""

    def __init__(self, count: int) -> None:
        self.mag, self.error = np.full(count, np.nan), np.full(count, np.nan)
        self.is_outside = np.zeros(count, dtype=bool)
        # Origin of each magnitude as an index into a list: one text per star takes 0.5 kB.
        self.code, self.origins = np.zeros(count, dtype=np.int32), [""]

    @property
    def is_open(self) -> Mask:
        """Whether a star has no magnitude yet."""
        return np.asarray(self.code == 0)

    @property
    def is_alone(self) -> Mask:
        """Whether a star's magnitude was predicted without a colour or a type."""
        parts = (text.split(" + ") for text in self.origins)
        return np.array([all(part.endswith(ALONE) for part in texts) for texts in parts])[self.code]

    @property
    def prediction(self) -> Prediction:
        """The magnitudes as a `Prediction`."""
        has_colour = ~self.is_open & ~self.is_alone
        return Prediction(self.mag, self.error, self.is_outside, has_colour)

    def _code_of(self, text: str) -> int:
        if text not in self.origins:
            self.origins.append(text)
        return self.origins.index(text)

    def take(self, prediction: Prediction, source: str, where: Mask) -> bool:
        """Fill in stars that have no magnitude yet; return whether there were any."""
        rows = self.is_open & where & np.isfinite(prediction.mag)
        if not rows.any():
            return False
        self.mag[rows], self.error[rows] = prediction.mag[rows], prediction.error_mag[rows]
        self.code[rows], self.is_outside[rows] = self._code_of(source), prediction.is_outside[rows]
        return True

    def mix(self, other: Other) -> None:
        """Average magnitudes of some stars with the magnitudes that another catalog predicts."""
        rows, its, whole = other.rows, other.prediction, self.prediction
        present = Prediction(*(array[rows] for array in vars(whole).values()))
        both = combined([present, its])
        ours, theirs = np.isfinite(present.mag), np.isfinite(its.mag)
        # A prediction outside the range of its relation is dropped if the other one is inside.
        only_theirs = theirs & (~ours | (present.is_outside & ~its.is_outside))
        only_ours = ~theirs | (ours & its.is_outside & ~present.is_outside)
        ways = np.stack([self.code[rows], other.code, only_theirs, only_ours])
        kinds, kind = np.unique(ways, axis=1, return_inverse=True)
        codes = []
        for mine, its_code, is_theirs, is_ours in kinds.T.tolist():
            origin = f"{other.source} {other.origins[its_code]}"
            mixed = self.origins[mine] if is_ours else f"{self.origins[mine]} + {origin}"
            codes.append(self._code_of(origin if is_theirs else mixed))
        self.code[rows] = np.array(codes, dtype=np.int32)[kind.ravel()] if codes else 0
        self.mag[rows], self.error[rows] = both.mag, both.error_mag
        self.is_outside[rows] = both.is_outside

    def flags(self) -> Array:
        """Return the quality bits of the magnitudes."""
        outside, estimated = int(Quality.COLOUR_OUT_OF_RANGE), int(Quality.ESTIMATED_MAGNITUDE)
        bits = np.where(self.is_outside, outside, 0) | np.where(self.is_alone, estimated, 0)
        return np.asarray(bits, dtype=np.int32)


def _only(stars: pa.Table, name: str) -> str | None:
    """Return the text of a column that has the same text in every row."""
    values = pc.drop_null(stars[name])
    return str(values[0]) if len(values) else None


def _colours(stars: pa.Table) -> dict[str, Array]:
    """Return the colours of a star table for which both bands are known."""
    colours = {}
    for name in ("colour", "second_colour"):
        text = _only(stars, f"{name}_bands")
        if text and colour_of(text):
            colours[text] = floats_of(stars, f"{name}_mag")
    return colours


def _magnitudes(stars: pa.Table, band: str) -> dict[str, Array]:
    """Return magnitudes by band: the bands in a star table, and those that its colours give."""
    mags = {band: floats_of(stars, "mag")}
    second_mag = floats_of(stars, "second_mag")
    for second in pc.unique(stars["second_band"]).to_pylist():
        if second in shipped_names():
            is_in_it = pc.fill_null(pc.equal(stars["second_band"], second), False).to_numpy()
            mags[second] = np.where(is_in_it, second_mag, np.nan)
    for text, colour in _colours(stars).items():
        first, last = colour_of(text) or ("", "")
        if first in mags and last not in mags:
            mags[last] = mags[first] - colour
        elif last in mags and first not in mags:
            mags[first] = mags[last] + colour
    return mags


def _error(stars: pa.Table, band: str, mag: Array, source: str, *, is_own: bool) -> Array:
    """Return the errors of magnitudes: the catalog's errors if it states them, else usual ones."""
    usual = band_error(band, mag, source)
    if not is_own:
        return usual
    stated = floats_of(stars, "mag_error")
    return np.where(np.isfinite(stated), stated, usual)
