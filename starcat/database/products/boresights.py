"""The product ``boresights``: the points of the tiling, and the brightest stars around each."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from starcat.database.products.index import Index, Ragged
from starcat.database.products.kind import Extent, ProductInputs, ProductKind
from starcat.geometry.sphere import radec_from_directions


def _make(inputs: ProductInputs, _: None) -> SimpleNamespace:
    fields = inputs.fields
    ra_deg, dec_deg = radec_from_directions(fields.boresights)
    x, y, z = np.ascontiguousarray(fields.boresights.T)
    return SimpleNamespace(
        boresight=np.arange(len(fields.count), dtype=np.int32),
        ra_deg=ra_deg,
        dec_deg=dec_deg,
        x=x,
        y=y,
        z=z,
        star_count=fields.count.astype(np.int32),
        brightest=Ragged(*fields.brightest(inputs.brightest)),
        index=Index(),
    )


def _count(inputs: ProductInputs, _: None) -> Extent:
    listed = np.minimum(inputs.fields.count, inputs.brightest).sum()
    return Extent(float(len(inputs.fields.count)), {"brightest": float(listed)})


KIND = ProductKind(name="boresights", make=_make, count=_count)
