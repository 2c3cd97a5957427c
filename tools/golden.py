"""Write the golden figures of three builds: ``make golden``; look at the difference.

Whole numbers and texts are held as digests. Real numbers are held as sums and first rows, as
their last bit may differ between processors (docs/decisions.md).
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

from catalog_folder import write_catalog_folder

from starcat.database.reader import open_database_folder
from starcat.pipeline.build import Built, build
from starcat.pipeline.specs.reading import preset

MADE = "sao-12deg-made"
"""The preset sao-12deg on the generated catalogs, which replace excerpts that are not there."""

BUILDS = ("gaia-12deg", "sao-12deg", MADE)
GOLDEN = Path(__file__).parents[1] / "tests" / "golden"


def golden_build(name: str, catalogs: Path, folder: Path) -> Built:
    """Build a preset, or `MADE`, from the excerpts or the made catalogs."""
    inputs = {"sao": [catalogs / "sao.dat.gz"]} if name.startswith("sao") else {}
    if name == MADE:
        inputs["hipparcos"] = [catalogs / "hip_main.dat.gz"]
    return build(preset(name.removesuffix("-made")), folder, inputs=inputs)


def golden_figures(database: Path) -> dict[str, Any]:
    """Return what has to stay the same, by product."""
    return {name: figures(table) for name, table in open_database_folder(database).products.items()}


def figures(table: pa.Table) -> dict[str, Any]:
    """Return the golden figures of one product."""
    exact, sums = hashlib.sha256(), {}
    for field in table.schema:
        column = table[field.name]
        if pa.types.is_floating(field.type):
            sums[field.name] = [len(column) - column.null_count, pc.sum(column).as_py()]
        else:
            exact.update(json.dumps([field.name, column.to_pylist()]).encode())
    return {
        "rows": len(table),
        "exact_sha256": exact.hexdigest(),
        "sums": sums,
        "first_rows": table.slice(0, 3).to_pylist(),
    }


def main() -> None:
    """Write one file per build; the build from excerpts only if they are there."""
    default = Path(__file__).parents[2] / "shared" / "catalogs"
    catalogs = Path(os.environ.get("STARCAT_CATALOGS", default))
    GOLDEN.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as made:
        write_catalog_folder(Path(made))
        for name in BUILDS:
            folder = Path(made) if name == MADE else catalogs
            if name == "sao-12deg" and not folder.is_dir():
                continue
            with tempfile.TemporaryDirectory() as output:
                found = golden_figures(golden_build(name, folder, Path(output)).folder)
            text = json.dumps(found, indent=1, sort_keys=True)
            (GOLDEN / f"{name}.json").write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
