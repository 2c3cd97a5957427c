"""The REST interface follows its schema for all requests: schemathesis against a server.

The tool runs as a command of its own, since its plugin for pytest warns of what other tests do.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from served import Served, serve
from services import add_database, token_of

CHECKS = (
    "status_code_conformance,content_type_conformance,response_headers_conformance,"
    "response_schema_conformance"
)

MAY_BE_BUSY = (503,)
"""With ``Retry-After``, and in the schema of the operations that read a catalog first."""

HOOKS = """
import schemathesis

@schemathesis.serializer("application/toml", "application/x-tar")
def as_text(context, value):
    return value.encode() if isinstance(value, str) else str(value).encode()
"""


@pytest.fixture(scope="module")
def attacked(
    tmp_path_factory: pytest.TempPathFactory, small_artifact: Path
) -> Iterator[tuple[Served, str]]:
    root = tmp_path_factory.mktemp("openapi") / "root"
    add_database(root, small_artifact)
    token = token_of(root, "fuzzer")
    settings = {"workers": 0, "jobs_waiting": 5, "requests_per_minute": 1_000_000}
    with serve(root, root.parent / "log", query_time_s=2.0, **settings) as served:
        yield served, token


# TAP and cone searches describe themselves in documents of the Virtual Observatory. OpenAPI has
# little about their answers, so that they are checked for server errors only.
PARTS = {
    "REST": ("--checks", CHECKS, "--exclude-path-regex", "/events$|^/metrics$|^/tap|^/scs"),
    "VO": ("--checks", "not_a_server_error", "--include-path-regex", "^/tap|^/scs"),
}

# Coverage tries each value of each field, whatever ``--max-examples`` says: for the thirty options
# of identifying 1,700 requests, ten minutes. Of these there are examples and chance.
NOT_COVERED = {"REST": "|/identify/", "VO": ""}

LONGEST_S = 900
"""A run is bounded by its examples; this limit is for a run that hangs, under any load."""


def fuzz(attacked: tuple[Served, str], report: Path, part: str, phase: str) -> None:
    """Run schemathesis with the same examples each time."""
    served, token = attacked
    *checks, paths = PARTS[part]
    paths += NOT_COVERED[part] if phase == "coverage" else ""
    options = ("--max-examples", "12", "--phases", phase, *checks, paths)
    command = [
        sys.executable, "-m", "schemathesis.cli", "run", f"{served.address}/api/openapi.json",
        "--header", f"Authorization: Bearer {token}", "--seed", "1", "--generation-deterministic",
        "--no-color", "--request-timeout", "20", *options,
    ]  # fmt: skip
    hooks = report / "hooks.py"
    hooks.write_text(HOOKS)
    environment = os.environ | {"SCHEMATHESIS_HOOKS": "hooks", "PYTHONPATH": str(report)}
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, cwd=report, env=environment,
        timeout=LONGEST_S,
    )  # fmt: skip
    said = f"{done.stdout[-8000:]}\n{done.stderr[-2000:]}"
    assert done.returncode == 0, said
    entries = [json.loads(line) for line in served.log.read_text().splitlines() if line[0] == "{"]
    broken = [entry for entry in entries if entry.get("status", 0) >= 500]
    assert not [entry for entry in broken if entry["status"] not in MAY_BE_BUSY]


@pytest.mark.slow
@pytest.mark.timeout(LONGEST_S + 60)
@pytest.mark.parametrize("phase", ["examples", "coverage", "fuzzing"])
@pytest.mark.parametrize("part", PARTS)
def test_no_request_that_the_schema_allows_or_forbids_breaks_it(attacked, tmp_path, part, phase):
    fuzz(attacked, tmp_path, part, phase)
