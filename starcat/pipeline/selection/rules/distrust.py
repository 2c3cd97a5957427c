"""Stars to distrust, because frames of the sensor contradict the catalog."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import numpy as np
import pyarrow as pa
from pydantic import Field, StringConstraints

from starcat.pipeline.selection.rule import Context, Rejection, RuleReason
from starcat.sections import Section

STEP = "distrust"
DISTRUSTED = RuleReason("distrusted", "distrusted by what flew: [selection.observed] lists it")
REASONS = (DISTRUSTED,)

SHA256_PATTERN = r"^[0-9a-f]{64}$"
Sha256 = Annotated[str, StringConstraints(pattern=SHA256_PATTERN)]


NumberInCatalog = Annotated[str, StringConstraints(pattern=r"^[a-z0-9_]+ -?[0-9]{1,19}$")]


class Observed(Section):
    """What frames of the sensor say of it and of its stars, as 'starcat learn' writes it."""

    is_later = True

    zero_point_mag: float | None = Field(
        None,
        ge=-100.0,
        le=100.0,
        description="measured magnitude of a star of colour 0 minus the catalog's; told, not "
        "applied",
        examples=[0.2],
    )
    colour_term: float = Field(
        0.0,
        ge=-5.0,
        le=5.0,
        description="mag becomes mag + colour_term x (colour_mag - reference_colour_mag)",
    )
    colour_bands: str | None = Field(
        None, max_length=40, description="the colour that the term is for", examples=["BP-RP"]
    )
    reference_colour_mag: float = Field(
        0.0,
        ge=-20.0,
        le=20.0,
        description="stars of this colour keep their mag, as do those of unknown colour",
    )
    reject: tuple[int | NumberInCatalog, ...] = Field(
        (),
        strict=False,  # a list in TOML
        max_length=4000,
        description="star_id of the stars to distrust, which are rejected; with the catalog before "
        'it, such as "sao 308", if two merged catalogs have the number',
        examples=[[3, 17]],
    )
    frames: int = Field(0, ge=0, le=2**31, description="identified frames that say so")
    database: str | None = Field(
        None,
        max_length=200,
        description="database that they were identified with",
        examples=["mycam-1.0.0"],
    )
    manifest_sha256: str | None = Field(
        None, pattern=SHA256_PATTERN, description="digest of its manifest", examples=["0" * 64]
    )
    results_sha256: tuple[Sha256, ...] = Field(
        (),
        strict=False,
        max_length=1000,
        description="digests of the files of identified frames",
        examples=[["0" * 64]],
    )


TABLE, KEYS = "observed", Observed


def reject(context: Context, keys: Observed) -> list[Rejection] | None:
    """Reject the stars that the spec lists as distrusted."""
    if not keys.reject:
        return None
    where = np.zeros(len(context.stars), dtype=bool)
    for rows in rows_named(context.stars, keys.reject).values():
        where[rows] = True
    return [Rejection(where, DISTRUSTED)]


def rows_named(stars: pa.Table, named: Sequence[int | str]) -> dict[int | str, list[int]]:
    """Return the rows of the stars that each number stands for, or each number in a catalog."""
    texts = {int(str(name).split()[-1]): [] for name in named}  # type: dict[int, list[int]]
    numbers = stars["star_id"].to_numpy()
    for row in np.flatnonzero(np.isin(numbers, np.array(list(texts), dtype=np.int64))).tolist():
        texts[int(numbers[row])].append(row)
    rows_by_name: dict[int | str, list[int]] = {}
    for name in named:
        *catalog, number = str(name).split()
        rows_by_name[name] = [
            row
            for row in texts[int(number)]
            if not catalog or stars["catalog"][row].as_py() == catalog[0]
        ]
    return rows_by_name
