"""The command that measures how often stars are identified."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat.cli import (
    Input,
    Json,
    inputs_by_source,
    print_table,
    progress_bars,
    say,
    show,
    to_folder,
    typer_option,
)
from starcat.errors import ConfigError
from starcat.matcher import OPTIONS
from starcat.progress import Progress

if TYPE_CHECKING:
    from starcat_lab.report.tables import ReportTable
    from starcat_lab.run import Evaluation

app = typer.Typer()
METAVAR = "VALUE[,VALUE...]"  # form of the values of a quantity that a sweep varies

Folder = Annotated[
    Path | None,
    typer.Argument(metavar="DATABASE", help="The folder <name>-<version>; or else --paper."),
]
PaperName = Annotated[str | None, typer.Option(help="S1 to S5, or all: what they print.")]
NoisesPx = Annotated[
    str | None, typer.Option(metavar=METAVAR, help="Noise of a centroid, each axis.")
]
NoisesMag = Annotated[str | None, typer.Option(metavar=METAVAR, help="Noise of a magnitude.")]
FalseStars = Annotated[
    str | None, typer.Option(metavar=METAVAR, help="Centroids that are not stars.")
]
FalseShares = Annotated[
    str | None, typer.Option(metavar=METAVAR, help="Share of false stars among the spots.")
]
DropProbabilities = Annotated[
    str | None, typer.Option(metavar=METAVAR, help="Chance of a star to be missing.")
]
K1s = Annotated[
    str | None, typer.Option(metavar=METAVAR, help="Distortion that the matcher does not know.")
]
RollsDeg = Annotated[str | None, typer.Option(metavar=METAVAR, help="Roll about a guide star.")]
Scales = Annotated[
    str | None, typer.Option(metavar=METAVAR, help="True focal length over the assumed one.")
]
LimitsMag = Annotated[
    str | None, typer.Option(metavar=METAVAR, help="Faintest magnitude that is seen.")
]
MethodNames = Annotated[
    str | None, typer.Option(help="See 'starcat methods', or all; default: the best there is.")
]
CameraFile = Annotated[
    Path | None, typer.Option(help="Camera file (TOML); default: the database's camera.")
]
Frames = Annotated[
    int | None, typer.Option(min=1, help="Frames of each trial; default: 500, with --quick 100.")
]
TolerancePx = Annotated[
    float | None,
    typer_option(OPTIONS["tolerance_px"], "Default: three times the position noise, or 1."),
]
Ecss = Annotated[
    Path | None,
    typer.Option(metavar="SENSOR.toml", help="Sensor to simulate for ECSS-E-ST-60-20C figures."),
]


def _print_example(is_wanted: bool) -> None:
    from starcat.pipeline.specs import example_toml

    if is_wanted:
        typer.echo(example_toml(), nl=False)
        raise typer.Exit


EcssExample = Annotated[
    bool,
    typer.Option(
        "--ecss-example",
        callback=_print_example,
        is_eager=True,
        help="Print a sensor with every key explained.",
    ),
]
Output = Annotated[Path, to_folder("Where the records and reports go: a folder.")]


@app.command("evaluate")
def evaluate_command(
    database: Folder = None,
    paper: PaperName = None,
    noise_px: NoisesPx = None,
    noise_mag: NoisesMag = None,
    false_stars: FalseStars = None,
    false_share: FalseShares = None,
    drop_probability: DropProbabilities = None,
    k1: K1s = None,
    roll_deg: RollsDeg = None,
    scale: Scales = None,
    limit_mag: LimitsMag = None,
    method: MethodNames = None,
    camera: CameraFile = None,
    frames: Frames = None,
    tolerance_px: TolerancePx = None,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same frames.")] = 1,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer frames.")] = False,
    ecss: Ecss = None,
    ecss_example: EcssExample = False,
    inputs: Input = None,
    output: Output = Path("dist/evaluation"),
    workers: Annotated[int, typer.Option(min=1, max=64, help="Processes.")] = 2,
    json: Json = False,
) -> None:
    """Measure how often simulated frames are identified, or reproduce the five papers.

    Finished trials are kept in the output folder and not run again. A quantity with several values
    is varied, with one value it is fixed; without any, each is varied over its usual values. With
    --ecss it simulates a star sensor from electrons to attitude, --frames pointings per trial.

    Example: starcat evaluate dist/gaia-12deg-1.0.0 --noise-px 0,0.5,1 --frames 50
    """
    from starcat.pipeline.specs import read_camera
    from starcat_lab.run import evaluate_database, evaluate_papers
    from starcat_lab.sweep import plan_sweep, sweep_values

    if (database is None) == (paper is None):
        raise ConfigError("give either a database or --paper")
    values = sweep_values(
        noise_px=noise_px, noise_mag=noise_mag, false_stars=false_stars, false_share=false_share,
        drop_probability=drop_probability, k1=k1, roll_deg=roll_deg, scale=scale,
        limit_mag=limit_mag)  # fmt: skip
    if ecss is not None:
        others = bool(values or camera or tolerance_px)
        _evaluate_sensor(database, ecss, output, method, frames, seed, quick, workers, json, others)
        return
    files, eye = inputs_by_source(inputs), read_camera(camera) if camera else None
    sweep = None
    if database is not None:
        sweep = plan_sweep(
            database, values, method=method, camera=eye, frames=frames,
            tolerance_px=tolerance_px, seed=seed, quick=quick,
        )  # fmt: skip
    with _progress_towards(output) as progress:
        if sweep is None:
            evaluation = evaluate_papers(
                paper or "all", files, output, quick=quick, workers=workers, progress=progress
            )
        else:
            evaluation = evaluate_database(sweep, output, workers=workers, progress=progress)
    print_evaluation(evaluation, as_json=json)


@contextmanager
def _progress_towards(output: Path) -> Iterator[Progress]:
    """Print the place of the results, and draw the progress."""
    say(f"records and report go to {output}")
    with progress_bars() as progress:
        yield progress


def _evaluate_sensor(
    database: Path | None, ecss: Path, output: Path, method: str | None, frames: int | None,
    seed: int, quick: bool, workers: int, as_json: bool, has_others: bool,
) -> None:  # fmt: skip
    from starcat.pipeline.specs import read_sensor
    from starcat_lab.ecss.pages import sensor_tables
    from starcat_lab.ecss.report import FEW_POINTINGS, POINTINGS, evaluate_sensor

    if database is None or has_others:
        raise ConfigError(
            "--ecss goes with a database, --frames, --method, --seed, --quick, --workers and "
            "--output only; what a sensor is tried with is in its file"
        )
    sensor = read_sensor(ecss)
    with _progress_towards(output) as progress:
        content, page = evaluate_sensor(
            database, sensor, output, method=method, seed=seed, workers=workers,
            pointings=frames or (FEW_POINTINGS if quick else POINTINGS), progress=progress,
        )  # fmt: skip
    checklist = sensor_tables(content)["checklist"]
    rows = tuple((subject, value) for subject, _, _, value, *_ in checklist.rows)
    short = replace(checklist, title="Star sensor", heads=("subject", "value"), rows=rows)
    show(as_json, content, _print, short)
    say(f"wrote {page}")


def print_evaluation(evaluation: Evaluation, *, as_json: bool) -> None:
    """Print what was measured."""
    contents = evaluation.contents
    show(as_json, list(contents), _print_tables, contents)
    say(f"wrote {evaluation.page}")


def _print_tables(contents: Sequence[Mapping[str, Any]]) -> None:
    from starcat_lab.report import tables as report_tables
    from starcat_lab.report.files import legend, rules_of

    for content in contents:
        failed = report_tables.failure_table(content)
        tables = [
            *report_tables.rate_tables(content, report_tables.SHORT),
            *report_tables.limit_tables(content),
            *report_tables.statistic_tables(content, report_tables.verdict),
        ]
        for table in (*tables, *([failed] if failed else [])):
            _print(table, f"{content['name']}: ")
    if summary := report_tables.summary_table(contents):
        _print(summary)
    for head, meaning in legend(contents):
        say(f"{head}: {meaning}")
    for rule, meaning in rules_of(contents):
        say(f"success by the rule {rule}: {meaning}")


def _print(table: ReportTable, prefix: str = "") -> None:
    heads = [head.replace(" guide stars", "\nguide stars") for head in table.heads]
    print_table(prefix + table.title, heads, table.rows, table.numbers)
