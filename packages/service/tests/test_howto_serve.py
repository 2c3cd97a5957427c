"""The commands of docs/howto-serve.md run as printed, and its tables agree with the program."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from served import serve

from starcat_service.security.metrics import Metrics
from starcat_service.service import Service
from starcat_service.settings import ServiceSettings, read_settings

PAGE = Path(__file__).parents[3] / "docs" / "howto-serve.md"
BLOCK = re.compile(r"```(console|python)\n(.*?)```", re.DOTALL)
START = "starcat serve --root service"


def steps(port: int) -> list[tuple[str, str]]:
    """The blocks of the page that are run, with a port that is free in place of 8000."""
    found = [(kind, text) for kind, text in BLOCK.findall(PAGE.read_text())]
    assert found[0][1].strip() == f"$ {START}"
    return [(kind, text.replace("127.0.0.1:8000", f"127.0.0.1:{port}")) for kind, text in found]


def script_of(blocks: list[tuple[str, str]]) -> str:
    """The blocks as one script of bash that ends at the first error."""
    lines = ["set -euo pipefail", 'starcat() { "$PYTHON" -m starcat "$@"; }']
    for kind, text in blocks:
        if kind == "python":
            lines.append(f'"$PYTHON" -W error -c {shlex.quote(text)}')
            continue
        for command in re.sub(r"\\\n", " ", text).splitlines():
            assert command.startswith("$ "), command
            lines.append(command[2:])
    return "\n".join(lines)


@pytest.mark.slow
@pytest.mark.timeout(540)
def test_the_way_of_a_newcomer_runs_as_printed(tmp_path: Path) -> None:
    with serve(tmp_path / "service", tmp_path / "log") as served:
        script = script_of(steps(served.port)[1:])
        done = subprocess.run(
            ["bash", "-c", script],
            cwd=tmp_path,
            env=os.environ | {"PYTHON": sys.executable},
            capture_output=True,
            text=True,
            check=False,
        )
    assert done.returncode == 0, f"{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    for said in ('"guide_stars"', '"state": "done"', "mine-1.0.0", "HIP 26311", "identified"):
        assert said in done.stdout, said
    assert (tmp_path / "flight" / "mine-1.0.0" / "manifest.json").is_file()
    assert (tmp_path / "backup" / "records.sqlite").stat().st_size > 0
    assert (tmp_path / "backup" / "registry" / "index.json").is_file()


def test_the_table_of_settings_is_that_of_the_program() -> None:
    page = PAGE.read_text()
    for name, field in ServiceSettings.model_fields.items():
        if name != "root":
            default = "" if field.default is None else f"`{json.dumps(field.default)}`"
            assert f"| `{name}` | {default} | {field.description} |" in page
    named = set(re.findall(r"^\| `(\w+)` \|[^|]*\|[^|]*\|$", page, re.MULTILINE))
    assert named == set(ServiceSettings.model_fields) - {"root"}


def test_the_table_of_figures_is_that_of_the_program(tmp_path: Path) -> None:
    page = PAGE.read_text()
    service = Service(read_settings(tmp_path))
    for one in Metrics(service).registry.collect():
        name = f"{one.name}_total" if one.type == "counter" else one.name
        assert f"| `{name}` | {one.documentation} |" in page
    service.close()


def test_the_settings_that_the_page_shows_are_read(tmp_path: Path) -> None:
    [example] = re.findall(
        r"```toml\n# service/service.toml\n(.*?)```", PAGE.read_text(), re.DOTALL
    )
    (tmp_path / "service.toml").write_text(example)
    settings = read_settings(tmp_path)
    assert (settings.workers, settings.is_secure) == (2, True)
