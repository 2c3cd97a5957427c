"""The index of the runs: which batches of which runs hold the stars of a pixel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from starcat.store.pixels import Pixel, Pixels, at_order
from starcat.store.runs import BUCKETS, Run, Share, repeated_places


@dataclass(frozen=True)
class RunIndex:
    """Batches by coarse pixel."""

    order: int  # order of the coarse pixels
    paths: tuple[Path, ...]  # arrow files of the runs
    pixels: Pixels  # shape (B,): coarse pixel of each batch, ascending
    # runs, batches: shape (B,): number of its run, and its number in the run
    runs: NDArray[np.int64]
    batches: NDArray[np.int64]
    # shape (R, BUCKETS + 1): where each bucket of numbers begins in the places of each run
    buckets: NDArray[np.int64]

    def shares(self, pixel: Pixel) -> list[Share]:
        """Return the batches that hold the stars of a pixel."""
        return self.shares_of(pixel.order, np.array([pixel.number]))

    def shares_of(self, order: int, pixels: Pixels) -> list[Share]:
        """Return the batches that hold the stars of several pixels."""
        coarse = at_order(order, pixels, self.order)
        begins = np.searchsorted(self.pixels, coarse)
        ends = np.searchsorted(self.pixels, coarse, side="right")
        ranges = [np.arange(b, e) for b, e in zip(begins, ends, strict=True) if e > b]
        if not ranges:
            return []
        rows = np.concatenate(ranges)
        shares: list[Share] = []
        for run in np.unique(self.runs[rows]).tolist():
            batches = np.sort(self.batches[rows[self.runs[rows] == run]])
            shares.append(Share(self.paths[run], tuple(batches.tolist())))
        return shares


def read_runs(path: Path, count: int) -> list[Run]:
    """Read what the runs of a file hold."""
    with np.load(path) as held:
        return [
            Run(
                path.with_name(f"{path.stem}-{k:04}.arrow"),
                path.with_name(f"{path.stem}-{k:04}.places"),
                held[f"batches{k}"],
                held[f"rows{k}"],
                held[f"buckets{k}"],
            )
            for k in range(count)
        ]


def write_index(path: Path, order: int, runs: Sequence[Run]) -> None:
    """Write the index of all runs."""
    empty = np.empty(0, dtype=np.int64)
    pixels = np.concatenate([empty, *(run.pixels for run in runs)])
    number = np.repeat(np.arange(len(runs)), [len(run.pixels) for run in runs])
    batch = np.concatenate([empty, *(np.arange(len(run.pixels)) for run in runs)])
    ascending = np.argsort(pixels, kind="stable")
    np.savez(
        path,
        order=order,
        paths=np.array([str(run.stars) for run in runs], dtype=np.str_),
        pixels=pixels[ascending],
        runs=number[ascending],
        batches=batch[ascending],
        buckets=np.array([run.buckets for run in runs]).reshape(len(runs), BUCKETS + 1),
    )


@lru_cache(maxsize=2)
def read_index(path: Path) -> RunIndex:
    """Read the index of all runs; a worker does so once."""
    with np.load(path) as held:
        paths = tuple(Path(text) for text in held["paths"].tolist())
        names = ("pixels", "runs", "batches", "buckets")
        return RunIndex(int(held["order"]), paths, *(held[name] for name in names))


def find_repeated(asked: tuple[Path, int]) -> NDArray[np.int64]:
    """Return the records of a bucket of numbers whose star was read before."""
    index = read_index(asked[0])
    ranges = index.buckets[:, asked[1] : asked[1] + 2].tolist()
    files = [path.with_suffix(".places") for path in index.paths]
    return repeated_places(list(zip(files, ranges, strict=True)))
