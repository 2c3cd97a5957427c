"""The tables and the settings of docs/howto-serve.md agree with the program.

``tests/project/test_docs.py`` runs its commands.
"""

from __future__ import annotations

import json
import re
from pathlib import Path

from starcat_service.security.metrics import Metrics
from starcat_service.service import Service
from starcat_service.settings import ServiceSettings, read_settings

PAGE = Path(__file__).parents[3] / "docs" / "howto-serve.md"


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
    for figure in Metrics(service).registry.collect():
        name = f"{figure.name}_total" if figure.type == "counter" else figure.name
        assert f"| `{name}` | {figure.documentation} |" in page
    service.close()


def test_the_settings_that_the_page_shows_are_read(tmp_path: Path) -> None:
    [example] = re.findall(
        r"```toml\n# service/service.toml\n(.*?)```", PAGE.read_text(), re.DOTALL
    )
    (tmp_path / "service.toml").write_text(example)
    settings = read_settings(tmp_path)
    assert (settings.workers, settings.is_secure) == (2, True)
