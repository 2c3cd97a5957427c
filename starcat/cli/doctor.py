"""The command that reports what starcat finds on this machine."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import typer

from starcat.cli.catalogs import source_facts
from starcat.cli.console import show_result
from starcat.cli.options import Json

app = typer.Typer()


@app.command("doctor")
def doctor(json: Json = False) -> None:
    """Report versions, the C library, folders, catalogs, memory and disk, for a bug report.

    Example: starcat doctor
    """
    show_result(_facts(), as_json=json)


def _facts() -> dict[str, Any]:
    from starcat.database.manifest import software_versions
    from starcat.matcher.c_engine import library_version
    from starcat.pipeline.log import available_memory_bytes
    from starcat.storage.atomic import state_folder
    from starcat.storage.cache import cache_folder

    cache = cache_folder()
    files = [path for path in cache.rglob("*") if path.is_file()]
    variables = ("STARCAT_CATALOGS", "STARCAT_SOURCES", "STARCAT_CACHE")
    return {
        "software": software_versions(),
        "c_library": library_version() or None,
        "processors": os.cpu_count(),
        "memory_bytes": available_memory_bytes(),
        "disk_free_bytes": shutil.disk_usage(Path()).free,
        "cache": {
            "folder": str(cache),
            "files": len(files),
            "bytes": sum(path.stat().st_size for path in files),
        },
        "state_folder": str(state_folder()),
        "environment": {name: os.environ[name] for name in variables if name in os.environ},
        "catalogs": {source["name"]: source["found_at"] for source in source_facts()},
    }
