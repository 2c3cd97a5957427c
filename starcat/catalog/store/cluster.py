"""Dask clusters (a local one on this machine, or an existing one), and tasks that run on them."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

from starcat.errors import BuildError, ConfigError
from starcat.version import __version__, install_command

if TYPE_CHECKING:
    from distributed import Client

ALLOWED_DEATHS = 10
"""If this many workers die during a task, the task is considered the cause."""

_CONNECT_S = 20

_WORKER_ENVIRONMENT = {
    "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "DASK_DISTRIBUTED__WORKER__PROFILE__ENABLED": "False",
    "OMP_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}
"""Blocks of an archive are allocated and freed by the megabyte. Dask's workers return freed memory
to the system each time; allocating it again takes a quarter of the run time. Dask's profiler
samples each worker a hundred times per second."""


@contextmanager
def cluster(
    workers: int = 2, scheduler: str | None = None, *, is_small: bool = False
) -> Iterator[Client]:
    """Yield a client of a Dask cluster."""
    try:
        import dask
        import distributed
    except ImportError as error:
        raise ConfigError(
            "this needs the packages dask and distributed, which are not installed",
            hint=install_command("hats"),
        ) from error
    settings = {
        "distributed.scheduler.allowed-failures": ALLOWED_DEATHS,
        "distributed.nanny.pre-spawn-environ": _WORKER_ENVIRONMENT,
    }
    if scheduler is not None:
        with _connected(distributed.Client, scheduler) as client:
            _check_versions(client)
            yield client
        return
    with (
        dask.config.set(settings),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=not is_small,
            memory_limit=0,  # no limit by Dask: the size of a task limits its memory
            # By default it would use port 8787 on all interfaces, and warn if the port is in use.
            dashboard_address="127.0.0.1:0",
            scheduler_kwargs={"dashboard": False},
            silence_logs=logging.CRITICAL,
        ) as local,
        distributed.Client(local, set_as_default=False) as client,
    ):
        yield client


@contextmanager
def _connected(client_class: Any, scheduler: str) -> Iterator[Client]:
    try:
        client = client_class(scheduler, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(
            f"no scheduler answers ({error})",
            parameter="scheduler",
            value=scheduler,
            hint=(
                "start one with 'dask scheduler' and workers with 'dask worker'",
                "leave it out to use this machine",
            ),
        ) from error
    with client:
        yield client


def _check_versions(client: Client) -> None:
    here = versions()
    for worker, there in client.run(versions).items():
        if there != here:
            raise ConfigError(
                f"the worker {worker} has {_named(there)}, this process has {_named(here)}",
                parameter="scheduler",
                hint="install the same on both, as the bytes of a store depend on it",
            )


def versions() -> dict[str, str]:
    """Return the versions of the packages on which the bytes of a store depend."""
    packages = {name: version(name) for name in ("cdshealpix", "numpy", "pyarrow", "scipy")}
    return {"starcat": __version__, **packages}


def _named(by_package: dict[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in by_package.items())


def run_tasks(
    client: Client,
    function: Callable[[Any], Any],
    items: Sequence[Any],
    report: Callable[[int, Any], None] | None = None,
) -> list[Any]:
    """Call a function for each item on the workers of a cluster."""
    from distributed import KilledWorker, as_completed

    futures = client.map(function, list(items), pure=False, retries=0)
    number_of = {future.key: number for number, future in enumerate(futures)}
    results: list[Any] = [None] * len(futures)
    try:
        for future in as_completed(futures, loop=client.loop):
            number = number_of[future.key]
            results[number] = future.result()
            if report is not None:
                report(number, results[number])
    except KilledWorker as error:
        raise BuildError(
            f"worker processes died again and again ({error})",
            hint="give each more memory, with fewer {workers} or a smaller {max_partition_rows}, "
            "then continue with {resume:True}",
        ) from error
    finally:
        client.cancel(futures, force=True)
    return results
