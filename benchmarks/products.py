"""Time, memory and bytes of each product, and how they grow with the number of stars.

Run with ``make bench``. Each growth step is a fresh process, so that its peak memory is its own.
It fails if a product is not made, is empty or has other rows in one of its files.
"""

from __future__ import annotations

import json
import resource
import sys
import tempfile
import time
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from rows import Options, Rows, ended, fresh

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest_catalog
from starcat.database.database import open_for_writing, write_product
from starcat.database.products.table import USUAL_PRODUCTS
from starcat.pipeline.recipes import make_product, product_inputs, tile_guide_stars
from starcat.pipeline.selection.selecting import select_guide_stars
from starcat.pipeline.specs.build_spec import BuildSpec
from starcat.pipeline.specs.reading import preset
from starcat.storage.parquet import write_parquet
from starcat.storage.schema import product_schema

LIMITS_MAG = (6.0, 7.0, 8.0, 9.0)
STARS_A_FIELD = 16
SKY_DEG2 = 41_252.96


def measure(spec: BuildSpec) -> dict[str, dict[str, float]]:
    """Make every product of a Gaia spec; return seconds, rows and bytes of each."""
    read = ingest_catalog("gaia", [embedded_sky()], epoch_jyear=spec.epoch_jyear, neighbours=False)
    stars = select_guide_stars(read.stars, spec.selection).guide_stars
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    sky = product_inputs(stars, tile_guide_stars(stars, spec), spec)
    found = {"tiling": {"seconds": time.perf_counter() - start, "rows": float(len(stars))}}
    with tempfile.TemporaryDirectory() as folder:
        for name in USUAL_PRODUCTS:
            start = time.perf_counter()
            product = make_product(name, sky)
            seconds = time.perf_counter() - start
            parquet, database = Path(folder, f"{name}.parquet"), Path(folder, f"{name}.h5")
            write_parquet(product.table, parquet)
            with open_for_writing(database) as file:
                write_product(file, product.table, product_schema(name), product.index, len(stars))
            with h5py.File(database) as file:
                columns = file[name]
                stored = sum(item.id.get_storage_size() for item in columns.values())
                in_files = {len(columns[product.table.column_names[0]])}
            in_files.add(pq.ParquetFile(parquet).metadata.num_rows)
            if in_files != {len(product.table)} or not len(product.table):
                raise ValueError(f"{name}: {len(product.table)} rows, in its files {in_files}")
            lists = [pc.list_flatten(c) for c in product.table if pa.types.is_list(c.type)]
            found[name] = {
                "seconds": seconds,
                # A product with one row per star: count the entries about the star's neighbours.
                "rows": float(len(lists[0] if lists else product.table)),
                "hdf5": float(stored),
                "parquet": float(parquet.stat().st_size),
            }
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    found["memory"] = {"stars": float(len(stars)), "peak_mib": after / 1024, "base": before / 1024}
    return found


def spec_at(limit_mag: float) -> BuildSpec:
    """Return gaia-12deg at a limit, its field shrunk to hold about 16 stars."""
    base = preset("gaia-12deg")
    counts = {6.0: 6_834, 7.0: 18_600, 8.0: 52_000, 9.0: 150_000}
    fov_deg = float(np.sqrt(STARS_A_FIELD / counts[limit_mag] * SKY_DEG2))
    content = base.model_dump(mode="json")
    content["selection"]["faint_limit_mag"] = limit_mag
    content["selection"]["doubles"]["min_separation_deg"] = 0.047 * fov_deg / 12.0
    content["camera"]["fov_x_deg"] = fov_deg
    content["boresights"]["count"] = int(1.5 * SKY_DEG2 / fov_deg**2 * 10)
    products = content["products"]
    products["neighbours"]["separation_bin_deg"] = fov_deg / 120.0
    products["grid"]["buffer_deg"] = fov_deg / 40.0
    return BuildSpec.model_validate(content)


def print_products(found: dict[str, dict[str, float]]) -> None:
    """Print one row per product."""
    print(f"  {'product':<18}{'rows':>10}{'ms':>9}{'ns/row':>9}{'HDF5 MB':>9}{'B/row':>7}", end="")
    print(f"{'Parquet MB':>12}")
    for name, facts in found.items():
        if "hdf5" in facts:
            rows = max(1.0, facts["rows"])
            print(
                f"  {name:<18}{facts['rows']:>10,.0f}{facts['seconds'] * 1e3:>9.1f}"
                f"{facts['seconds'] / rows * 1e9:>9.0f}{facts['hdf5'] / 1e6:>9.2f}"
                f"{facts['hdf5'] / rows:>7.1f}{facts['parquet'] / 1e6:>12.2f}"
            )


def main(rows: Rows) -> None:
    """Print the products of gaia-12deg, then their growth."""
    is_quick = Options(__doc__).asked().quick
    print("\nProducts of gaia-12deg, one process")
    with rows.row("gaia-12deg"):
        print_products(measure(preset("gaia-12deg")))
    growth = {}
    for limit in LIMITS_MAG[:1] if is_quick else LIMITS_MAG:
        with rows.row(f"G <= {limit:g}"):
            found = growth[limit] = json.loads(fresh(__file__, limit))
            fov, memory = spec_at(limit).camera.fov_x_deg, found["memory"]
            print(f"\nG <= {limit:g}: {memory['stars']:,.0f} stars, field {fov:.1f} deg", end="")
            print(f", peak {memory['peak_mib']:.0f} MiB")
            print_products(found)
    print("\nNanoseconds a row, smallest and largest of all limits")
    for name in USUAL_PRODUCTS if growth else ():
        each = [g[name]["seconds"] / max(1.0, g[name]["rows"]) * 1e9 for g in growth.values()]
        print(f"  {name:<18}{min(each):>8.0f}{max(each):>8.0f}{max(each) / min(each):>7.2f} x")


if __name__ == "__main__":
    if sys.argv[1:2] and sys.argv[1][0].isdigit():
        print(json.dumps(measure(spec_at(float(sys.argv[1])))))
    else:
        ended(main)
