"""The command that builds a database, and the tables that it prints."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli.catalogs import print_problems, record_rows
from starcat.cli.console import (
    command_line,
    print_json,
    print_record,
    print_rows,
    print_table,
    print_things,
    progress_bars,
    say,
    show_result,
    warn,
)
from starcat.cli.options import (
    Changes,
    Input,
    Json,
    OwnSources,
    PresetName,
    SpecFile,
    chosen_spec,
    inputs_by_source,
    option_of,
)
from starcat.cli.outputs import Replace, to_folder
from starcat.cli.remote import client_of
from starcat.errors import BuildError
from starcat.failures import failure_of
from starcat.results import plain

if TYPE_CHECKING:
    from starcat.database.reader import DatabaseFolder
    from starcat.pipeline.build import Built
    from starcat.pipeline.report.report import CoverageReport
    from starcat.pipeline.simulation.selftest import Rates
    from starcat.pipeline.specs.build_spec import BuildSpec
    from starcat.pipeline.stages import PlannedStage

app = typer.Typer()

MAX_NAMES = 3
"""Number of files of a source in the table of ``--explain``."""


@app.command("build")
def build_command(
    context: typer.Context,
    spec: SpecFile = None,
    preset: PresetName = None,
    changes: Changes = None,
    inputs: Input = None,
    sources: OwnSources = None,
    output: Annotated[Path, to_folder("Where <name>-<version>/ goes.")] = Path("dist"),
    replace: Replace = False,
    workers: Annotated[
        int, typer.Option(min=1, max=64, help="Threads; the database is the same for any number.")
    ] = 2,
    max_memory: Annotated[
        float | None,
        typer.Option(
            min=0.1, help="Refuse a build that needs more memory, GiB. Default: the free memory."
        ),
    ] = None,
    explain: Annotated[
        bool,
        typer.Option(
            "--explain", help="Only print what each stage would do, and which files it would read."
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Build a guide-star database, check it, and prove that it identifies its own fields.

    Example: starcat build --preset gaia-12deg -o dist
    """
    if explain:
        _explain(chosen_spec(spec, preset, changes), inputs_by_source(inputs, maps=sources), json)
        return
    if context.obj is not None:
        _build_remotely(context, chosen_spec(spec, preset, changes), output, as_json=json)
        return
    from starcat.pipeline.build import Built, build

    paths_by_source = inputs_by_source(inputs, maps=sources)
    build_spec = chosen_spec(spec, preset, changes)
    most = None if max_memory is None else int(max_memory * 2**30)
    try:
        with progress_bars() as progress:
            built = build(
                build_spec, output, inputs=paths_by_source, replace=replace, workers=workers,
                progress=progress, announce=lambda cost: say(cost.in_words), max_memory_bytes=most,
            )  # fmt: skip
    except BuildError as error:
        if isinstance(error.built, Built):
            warn(error.built.warnings)
            if not json:
                _print_contents(error.built)
        raise
    print_built(built, as_json=json)


def _explain(spec: BuildSpec, inputs: Mapping[str, Sequence[Path]], as_json: bool) -> None:
    """Print what the stages of a build would do."""
    from starcat.pipeline.stages import explain as explained

    stages = explained(spec, inputs)
    rows = [
        {"stage": each.title, "does": each.does or "nothing", "reads": list(_read_by(each))}
        for each in stages
    ]
    if as_json:
        print_json(plain(stages))
    else:
        print_rows(rows, f"{spec.name} {spec.version}")
    missing = {name: error for each in stages for name, error in each.missing.items()}
    warn(failure_of(error, "starcat build", option_of).message for error in missing.values())
    for name, paths in {n: p for each in stages for n, p in each.reads.items()}.items():
        if paths and not inputs.get(name):
            folders = dict.fromkeys(str(Path(path).parent) for path in paths)
            say(f"{name}: found in {' and '.join(folders)}")


def _read_by(planned: PlannedStage) -> Iterator[str]:
    """Yield each source that a stage reads, with the names of its first files."""
    for name, paths in planned.reads.items():
        names = [Path(path).name or path for path in paths[:MAX_NAMES]]
        more = f"and {len(paths) - MAX_NAMES:,} more" if len(paths) > MAX_NAMES else ""
        yield " ".join([name, *(names or ["(missing)"]), more]).rstrip()


def _build_remotely(
    context: typer.Context, spec: BuildSpec, output: Path, *, as_json: bool
) -> None:
    """Build a database on a service, download it, and print its contents."""
    from starcat.database.reader import open_database_folder
    from starcat.pipeline.simulation.selftest import rates_of

    client = client_of(context)
    with progress_bars() as progress:
        job = client.build(spec.recorded(), progress)
        database = str(job["result"]["database"])
        folder, outcome = client.download(database, output, progress)
    report = client.report(database)
    warn(report["warnings"])
    opened = open_database_folder(folder)
    if as_json:
        facts = {key: report[key] for key in ("filters", "coverage", "self_test", "warnings")}
        facts = {"database": database, "job": job["id"], **facts}
        _print_facts(folder, outcome, opened.manifest, facts)
        return
    print_database(opened)
    print_rates(list(map(rates_of, report["self_test"])))
    say(f"{outcome}: {folder}")
    say(f"database {database} of {client.url}")
    _say_next(folder)


def _print_facts(
    folder: Path, outcome: str, manifest: dict[str, Any], facts: dict[str, Any]
) -> None:
    report = folder / "report" / "index.html"
    where = {"folder": str(folder), "report": str(report), "outcome": outcome}
    contents = {key: manifest[key] for key in ("sources", "products", "files")}
    print_json({**where, **facts, **contents})


def print_built(built: Built, *, as_json: bool) -> None:
    """Print the result of a build."""
    warn(built.warnings)
    if as_json:
        facts = {
            "filters": [vars(step) for step in built.filters],
            "coverage": built.coverage.as_dict(),
            "self_test": plain(built.rates),
            "warnings": list(built.warnings),
            "times_s": built.times_s,
        }
        _print_facts(built.folder, built.outcome, built.manifest, facts)
        return
    _print_contents(built)
    seconds = [(stage, f"{taken:.2f}") for stage, taken in built.times_s.items()]
    print_table("Times", ("stage", "seconds"), seconds, numbers=(1,))
    print_problems(built.problems)
    say(f"{built.outcome}: {built.folder}")
    say(f"report: {built.folder / 'report' / 'index.html'}")
    _say_next(built.folder)


def _say_next(folder: Path) -> None:
    say("go on with:")
    for words in (
        ("simulate", folder, "-o", "frame.csv"),
        ("identify", folder, "frame.csv"),
        ("export", folder, "--to", "onboard", "-o", f"{folder.name}.img"),
    ):
        say(f"  {command_line('starcat', *words)}")


def _print_contents(built: Built) -> None:
    manifest = built.manifest
    for source in manifest["sources"]:
        _print_records(f"{source['source']} ({source['role']})", source)
    print_things(
        "Stars in the fields of the tiling after each filter",
        built.filters,
        {
            "after": "{0.step}",
            "stars": "{0.stars:,}",
            "median a field": "{0.median_per_field:g}",
            "fewest": "{0.min_per_field}",
            "fields below 4": "{0.share_below_4:.2%}",
        },
        numbers=(1, 2, 3, 4),
    )
    print_products(manifest)
    show_coverage(built.coverage, as_json=False)
    print_rates(built.rates)


def _print_records(title: str, source: dict[str, Any]) -> None:
    print_table(title, ("records", "rows"), record_rows(source), numbers=(1,))


def print_products(manifest: dict[str, Any]) -> None:
    """Print the products of a database."""
    files = manifest["files"]
    rows = [
        (
            name,
            facts["schema"],
            f"{facts['rows']:,}",
            f"{files[facts['parquet']]['bytes']:,}",
            f"{facts['records']:,} over all fields" if "records" in facts else "",
        )
        for name, facts in manifest["products"].items()
    ]
    rows.append(("database.h5", "", "", f"{files['database.h5']['bytes']:,}", ""))
    print_table("Products", ("product", "schema", "rows", "bytes", ""), rows, numbers=(2, 3))


def print_rates(rates: Sequence[Rates]) -> None:
    """Print the rates of a self-test."""
    print_things(
        "Simulated fields, with noise of position (px) and of magnitude",
        [rate for rate in rates if rate.frames],
        {
            "fields": "{0.name}",
            "px": "{0.noise_px:g}",
            "mag": "{0.noise_mag:g}",
            "dropped": "{0.drop_probability:.0%}",
            "false": "{0.false_stars}",
            "tried": "{0.frames}",
            "4+ stars": "{0.identifiable}",
            "right": "{0.identified}",
            "wrong": "{0.wrong}",
            "of all": "{0.identified_share:.1%}",
            "of 4+": "{0.share_of_identifiable:.1%}",
        },
        numbers=range(1, 11),
    )


def print_database(database: DatabaseFolder) -> None:
    """Print the contents of a database."""
    from starcat.pipeline.specs.build_spec import CameraSpec

    manifest = database.manifest
    spec = manifest["spec"]
    facts = {
        "description": spec["description"],
        "frame, epoch": f"{manifest['frame']}, J{manifest['epoch_jyear']:g}",
        "camera": CameraSpec.model_validate(spec["camera"]).camera().in_words,
        "faint limit": f"{spec['selection']['faint_limit_mag']:g} mag",
        "made by": ", ".join(f"{k} {v}" for k, v in manifest["software"].items()),
    }
    print_record(facts, f"{manifest['name']}-{manifest['version']}")
    for source in manifest["sources"]:
        files = ", ".join(f"{file['name']} ({file['sha256'][:12]})" for file in source["files"])
        _print_records(f"{source['source']} from {files}", source)
    print_products(manifest)


def show_coverage(report: CoverageReport, title: str = "Coverage", *, as_json: bool) -> None:
    """Print the coverage in a few numbers; JSON also has the number of fields by their stars."""
    record = report.as_dict()
    shown = {key: value for key, value in record.items() if key != "fields_by_stars"}
    show_result(record if as_json else shown, title, as_json=as_json)
