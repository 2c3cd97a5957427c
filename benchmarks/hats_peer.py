"""hats-import on parts of 2MASS, in its own environment, for the comparison in `scale.py`.

    python hats_peer.py PARTS OUTPUT WORKERS COLUMNS

COLUMNS is JSON: all columns of a record, and the used columns.
"""

import json
import sys
from pathlib import Path

from dask.distributed import Client
from hats_import.catalog.arguments import ImportArguments
from hats_import.catalog.file_readers import CsvReader
from hats_import.catalog.run_import import run

MAX_ROWS = 500_000
"""Stars of a partition, as starcat has by default."""


def main(parts: str, output: str, workers: str, columns: str) -> None:
    """Import the parts."""
    names, used = json.loads(columns)
    reader = CsvReader(
        header=None,
        column_names=names,
        sep="|",
        compression="gzip",
        usecols=list(used),
        na_values=["\\N"],
        dtype=used,
        quoting=3,
    )
    arguments = ImportArguments(
        output_path=output,
        output_database_name="psc",
        input_file_list=sorted(map(str, Path(parts).glob("psc_*.gz"))),
        file_reader=reader,
        ra_column="ra",
        dec_column="dec",
        pixel_threshold=MAX_ROWS,
        progress_bar=False,
    )
    with Client(n_workers=int(workers), threads_per_worker=1, dashboard_address=None) as client:
        run(arguments, client)


if __name__ == "__main__":
    main(*sys.argv[1:])
