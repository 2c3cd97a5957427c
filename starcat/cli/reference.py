"""The reference pages: commands, spec, stages, products, sources and SQL, as Markdown.

They are made from the program itself: Sphinx does so when it builds the site, and the service
when a page is requested.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import typer

from starcat.catalog.source import data_source, source_names
from starcat.catalog.table_map import UNITS, ArchiveMap, Flags, Remote, StarColumns, TableMap
from starcat.database.products.coverage import MIN_GUIDE_STARS
from starcat.pipeline.selection.ruleset import ALL_REASONS
from starcat.pipeline.specs.keys import REQUIRED, SpecKey, spec_sections, toml_value
from starcat.pipeline.stages import CHOOSE, FINISH, PRODUCTS, READ
from starcat.pipeline.starter import ENOUGH_STARS
from starcat.query.gallery import gallery, macros
from starcat.resources import resource_folder
from starcat.storage.schema import read_schema


def every_command() -> dict[str, Any]:
    """Return all commands and subcommands, such as ``token create``, sorted by name."""
    from starcat.cli.main import app

    commands: dict[str, Any] = {}
    for name, command in sorted(typer.main.get_command(app).commands.items()):  # type: ignore[attr-defined]
        within = getattr(command, "commands", None)
        if within is None:
            commands[name] = command
        else:
            commands |= {
                f"{name} {word}": subcommand for word, subcommand in sorted(within.items())
            }
    return commands


def cli_page() -> str:
    """Return the reference of all commands, from their own help."""
    from starcat.cli.main import app

    page = [
        "# Commands\n\n`-o` names the result: a file if a command makes one file, else a folder,\n"
        "which is made if it does not exist. Formats are `--to` and `--format`.\n"
    ]
    commands = {"starcat": typer.main.get_command(app)}
    commands |= {f"starcat {name}": command for name, command in every_command().items()}
    for title, command in commands.items():
        context = typer.Context(command, info_name=title, terminal_width=96, max_content_width=96)
        body = "\n".join(line.rstrip() for line in command.get_help(context).strip().splitlines())
        page.append(f"## {title}\n\n```text\n{body}\n```\n")
    return "\n".join(page)


def products_page() -> str:
    """Return the reference of all products, from their schemas."""
    page = [
        "# Products\n\n"
        "Every product is a Parquet file. Products that a matcher needs are also groups of\n"
        "`database.h5`. Angles between stars are radians, positions degrees, in ICRS at the epoch\n"
        "of the manifest. `i`, `j` and the like are rows of the table `stars` of the database.\n"
    ]
    for path in sorted(resource_folder("schemas").glob("*.json")):
        if path.stem.startswith("manifest-"):
            continue
        schema = read_schema(path)
        page.append(f"## {schema.name}\n\n{schema.description}\n")
        page.append(f"Order of the rows: {', '.join(schema.order)}.\n")
        page.append("| column | dtype | unit | null | meaning |\n|---|---|---|---|---|")
        for c in schema.columns:
            page.append(
                f"| {c.name} | {c.dtype} | {c.unit} | {'yes' if c.nullable else ''} | "
                f"{c.description} |"
            )
        page.append("")
    page.append(
        "## Reasons\n\nReasons why a record is not a guide star, in the order in which they are"
    )
    page.append("tested; the first that applies counts.\n\n| reason | meaning |\n|---|---|")
    page += [f"| {name} | {words} |" for name, words in ALL_REASONS.items()]
    return "\n".join(page) + "\n"


def sql_page() -> str:
    """Return the reference of macros and named queries, from their SQL files."""
    page = [
        "# SQL: macros and named queries\n",
        "`starcat sql --macros` and `starcat sql --list` print the same. How to use them:",
        "[howto-query.md](howto-query.md).\n\n## Macros\n",
    ]
    for macro in sorted(macros(), key=lambda m: (m.is_table, m.name)):
        clause = "FROM " if macro.is_table else ""
        page.append(f"### {macro.name}\n\n`{clause}{macro.name}({macro.arguments})`\n")
        page.append(f"{macro.help}\n\n```sql\n{macro.example}\n```\n")
    page.append("## Named queries\n")
    for query in gallery().values():
        names = " ".join(chr(ord("A") + k) for k in range(query.targets))
        first = query.values[0] if query.values else None
        setting = f" --set {first.name}={first.default}" if first else ""
        page.append(f"### {query.name}\n\n{query.help}\n")
        page += [f"- `{v.name}` = {v.default}: {v.help}" for v in query.values]
        page.append(f"\n```text\nstarcat sql {names} --named {query.name}{setting}\n```\n")
        page.append(f"```sql\n{query.text}\n```\n")
    return "\n".join(page)


def sources_page() -> str:
    """Return the reference of all data sources, from their TOML files."""
    page = ["# Data sources\n"]
    for name in source_names():
        source = data_source(name)
        epoch = f", epoch J{source.epoch_jyear:g}" if source.epoch_jyear else ""
        page.append(f"## {name}: {source.title}\n")
        page.append(f"{source.identifier}; {source.frame}{epoch}.\n")
        page.append(f"Cite: {source.citation}\n\nLicence: {source.licence}\n")
        if source.table is not None and (remote := source.table.remote):
            ways = {"TAP": f"{remote.tap} {remote.table}", "HATS": remote.hats}
            services = "; ".join(f"{kind} `{way}`" for kind, way in ways.items() if way.strip())
            page.append(f"Served as {services} ({remote.checked}).\n")
        for file in source.files:
            rows = f"{file.rows:,} records" if file.rows else "records"
            size = f" of {file.record_bytes} bytes" if file.record_bytes else ""
            names = ", ".join(f"`{pattern}`" for pattern in file.file_names)
            parts = f" ({len(file.parts)} parts)" if file.parts else ""
            page.append(f"{names}{parts}: {rows}{size}, {file.layout.replace('_', ' ')}.\n")
    return "\n".join([*page, *map_keys()])


OF_ARCHIVE = "Of a table whose rows are the records of an archive"


def map_keys() -> list[str]:
    """Return the reference of the keys of a map."""
    page = [
        "## Maps of tables\n",
        "How to write one: [howto-own-catalog.md](howto-own-catalog.md).\n",
    ]
    for title, model in (
        ("", TableMap),
        ("columns", StarColumns),
        ("flags", Flags),
        ("remote", Remote),
        (OF_ARCHIVE, ArchiveMap),
    ):
        titles = {"": "At the top, and sections", OF_ARCHIVE: OF_ARCHIVE}
        page.append(f"### {titles.get(title, f'[{title}]')}\n")
        page.append("| key | needed | becomes | meaning |\n|---|---|---|---|")
        for name, field in model.model_fields.items():
            if field.description:
                needed = "yes" if field.is_required() else ""
                page.append(
                    f"| `{name}` | {needed} | {UNITS.get(name, '')} | {field.description} |"
                )
        page.append("")
    return page


def spec_page() -> str:
    """Return the reference of the build spec, from its own definition."""
    page = [
        "# The build spec\n",
        "A spec is a TOML file that determines a database, together with the input files.",
        "`starcat init` writes a spec for a camera, `starcat presets NAME --toml` prints one of",
        "starcat's own, both with every key explained. `starcat build --set KEY=VALUE` changes a",
        "key for one build. An unknown key is an error that names the nearest known key.\n",
        LIMIT_ADVICE,
    ]
    for section in spec_sections():
        name = ".".join(section.path)
        page.append(f"## {f'[{name}]' if name else 'At the top'}\n\n{section.description}\n")
        if not section.keys:
            continue
        page.append("| key | unit | range | default | example | meaning |\n" + "|---" * 6 + "|")
        for key in section.keys:
            cells = (f"`{key.name}`", key.unit or key.kind, key.range, _default(key), _example(key))
            # A "|" in the text, for example in a pattern, would end the cell.
            row = " | ".join(cell.replace("|", r"\|") for cell in (*cells, key.description))
            page.append(f"| {row} |")
        page.append("")
    return "\n".join(page)


LIMIT_ADVICE = f"""\
## Choosing the faint limit

A frame needs {MIN_GUIDE_STARS} stars. Choose the limit at which 99 of 100 fields have
{ENOUGH_STARS}: `starcat init` finds it and prints the stars of a field for limits around it (the
[FAQ](faq.md) has the limits of some cameras). The limit must not be fainter than the camera sees. A
much fainter limit does not help: triangles are made from each field's `boresights.brightest` stars,
and the other stars only make the database larger and the search longer.
`selection.max_stars_per_field` thins the Milky Way and keeps the poles of the galaxy. If a tracker
has room for a number of stars (`selection.max_stars`), `selection.thinning = "information"` keeps
the stars that make the sky even: [an even sky](algorithms-catalogs.md#an-even-sky).
"""


def _default(key: SpecKey) -> str:
    if key.default is REQUIRED:
        return "required"
    return "" if key.default in (None, "", []) else f"`{toml_value(key.default)}`"


def _example(key: SpecKey) -> str:
    return "" if key.example is None else f"`{toml_value(key.example)}`"


def stages_page() -> str:
    """Return the list of the stages of a build, with the output of `--explain` for a preset."""
    page = [
        "# The stages of a build\n",
        "A build runs these stages in this order. A stage that has nothing to do for the spec is",
        "skipped. All stages work on one `Draft` (`starcat/pipeline/draft.py`). An estimate runs",
        "the first two lists. `starcat build --explain SPEC` prints what each stage will do for a",
        "spec, and which files it would read.\n",
    ]
    for title, stages in (
        ("Read", READ), ("Choose", CHOOSE), ("Make products", PRODUCTS), ("Finish", FINISH)
    ):  # fmt: skip
        page.append(f"## {title}\n\n| stage | what it does | function |\n|---|---|---|")
        for each in stages:
            module = each.change.__module__.rpartition(".")[2]
            page.append(f"| {each.title} | {each.summary} | `{module}.{each.name}` |")
        page.append("")
    return "\n".join(page)


REFERENCE: dict[str, Callable[[], str]] = {
    "cli": cli_page,
    "spec": spec_page,
    "stages": stages_page,
    "products": products_page,
    "sources": sources_page,
    "sql": sql_page,
}
"""Function that makes each page, by the name of the page."""
