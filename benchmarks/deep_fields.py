"""Fields of 1 degree: the embedded sky alone, and merged with a simulated deeper catalog.

Whole builds of one spec, with their self-tests over the whole sphere. The deeper catalog is made
from a seed: every star of the embedded sky again, with errors, and fainter ones scattered about
them in the number that star counts have (a factor of 10^0.35 a magnitude). It says that such a
depth can be built and identified, not what the real catalog's rate is.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from rows import Options, Rows, ended

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.source import give_map
from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.products.table import USUAL_PRODUCTS
from starcat.geometry.sphere import radec_from_directions
from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import spec_from_dict

SLOPE = 0.35  # dex a magnitude: about what Gaia counts of G 11 to 14
FIRST_NUMBER = 3 * 10**12

_MAP = """name = "deep"
frame = "ICRS"
epoch = 2016.0
[columns]
star_id = "number"
ra = { value = "ra", unit = "deg" }
dec = { value = "dec", unit = "deg" }
[magnitudes]
G = "g"
"""


def main(rows: Rows) -> None:
    """Print a row for each of the two builds."""
    options = Options(__doc__)
    options.size("--fov", 1.0, 4.0, "field of view, degrees")
    options.size("--boresights", 100_000, 2_000, "fields of the tiling")
    options.size("--frames", 1000, 10, "frames of the self-test")
    options.size("--deeper", 1.5, 0.1, "magnitudes that the simulated catalog is deeper")
    asked = options.asked()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        limit = make_deep(folder, asked.deeper)
        give_map(folder / "deep.toml")
        for merged in ((), ("deep",)):
            faint = limit + (asked.deeper if merged else 0.0)
            name = "embedded sky" if not merged else "merged"
            with rows.row(name):
                spec = spec_from_dict(spec_of(merged, faint, asked), name)
                built = build(
                    spec, folder, inputs={"deep": [folder / "deep.parquet"]} if merged else {}
                )
                clean, hard = built.rates[:2]
                facts = built.manifest["sources"]
                told = "; ".join(f"{one['source']} {one['kept']:,} kept" for one in facts)
                print(
                    f"{name:12} to G {faint:.2f}: clean {clean.identified_share:.1%}, hard "
                    f"{hard.identified_share:.1%}, wrong {clean.wrong + hard.wrong}; {told}; "
                    f"{sum(built.times_s.values()):.0f} s",
                    flush=True,
                )
                for one in facts[1:]:
                    print(f"{'':12} {one['source']}: {one['rows_read']:,} read, {one['rejected']}")


def spec_of(merged: tuple[str, ...], faint: float, asked: object) -> dict[str, object]:
    """Return the spec of a build."""
    fov, count, frames = (getattr(asked, name) for name in ("fov", "boresights", "frames"))
    return {
        "name": "deep" if merged else "shallow",
        "version": "1.0.0",
        "epoch_jyear": 2026.0,
        "catalog": {"source": "gaia", "merged": list(merged)},
        "selection": {"faint_limit_mag": round(faint, 2), "max_stars_per_field": 14},
        "camera": {"width_px": 1024, "height_px": 1024, "fov_x_deg": fov},
        "boresights": {"count": count},
        "products": {
            name: {"enabled": False}
            for name in USUAL_PRODUCTS
            if name not in ("pairs", "triangles")
        },
        "self_test": {"frames": frames, "min_identified": 0.0},
    }


def make_deep(folder: Path, deeper: float) -> float:
    """Write a catalog that is deeper than the embedded sky; return the limit of that."""
    stars = ingest_catalog("gaia", [embedded_sky()], epoch_jyear=2016.0, neighbours=False).stars
    mag, unit = floats_of(stars, "mag"), directions_of(stars)
    limit = float(np.nanpercentile(mag, 99.9))
    generator = np.random.default_rng(11)
    count = int(len(mag) * (10.0 ** (SLOPE * deeper) - 1.0))
    around = unit[generator.integers(0, len(unit), count)]
    around = around + generator.normal(scale=np.radians(1.5), size=around.shape)
    again = unit + generator.normal(scale=np.radians(0.02 / 3600.0), size=unit.shape)
    places = np.concatenate([again, around])
    places /= np.linalg.norm(places, axis=1)[:, None]
    share = generator.uniform(0.0, 1.0, count)
    growth = 10.0 ** (SLOPE * deeper) - 1.0
    fainter = limit + np.log10(1.0 + share * growth) / SLOPE
    ra, dec = radec_from_directions(places)
    number = FIRST_NUMBER + np.arange(len(places))
    mags = np.concatenate([mag + generator.normal(scale=0.01, size=len(mag)), fainter])
    table = pa.table({"number": number, "ra": ra, "dec": dec, "g": mags})
    pq.write_table(table, folder / "deep.parquet")
    (folder / "deep.toml").write_text(_MAP)
    return limit


if __name__ == "__main__":
    ended(main)
