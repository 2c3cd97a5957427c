"""The command line: parse, call one function, print, exit code.

Results go to stdout as tables or, with ``--json``, as JSON; messages and progress bars go to
stderr. Exit codes: 0 done, 1 failed, 2 usage or spec, 3 source missing or damaged, 4 schema,
5 artifact damaged.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from starcat import __version__
from starcat.errors import ConfigError, ProductError, StarcatError, reason

if TYPE_CHECKING:
    from starcat.spec import BuildSpec

app = typer.Typer(
    name="starcat",
    help="Guide-star databases for star trackers, built from star catalogs.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)

Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of tables.")]
Input = Annotated[
    list[str] | None,
    typer.Option("--input", metavar="SOURCE=PATH", help="File or folder of a source. Repeatable."),
]
NoisePx = Annotated[float, typer.Option(min=0, max=50, help="Of a centroid, each axis.")]


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"starcat {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of errors.")] = False,
) -> None:
    """Guide-star databases for star trackers, built from star catalogs."""


@app.command()
def sources(json: Json = False) -> None:
    """List the catalogs that starcat knows, and where each would be read from.

    Example: starcat sources
    """
    from starcat.reports import print_sources

    print_sources(as_json=json)


@app.command()
def presets(json: Json = False) -> None:
    """List the build specs that ship with starcat.

    Example: starcat presets
    """
    from starcat.reports import print_presets

    print_presets(as_json=json)


@app.command()
def fetch(
    source: Annotated[str, typer.Argument(help="A source, as 'starcat sources' lists them.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder; default: the download cache.")
    ] = None,
    part: Annotated[
        list[str] | None, typer.Option("--part", help="Only this part. Repeatable.")
    ] = None,
    retries: Annotated[int, typer.Option(min=0, help="Tries again per address.")] = 3,
    json: Json = False,
) -> None:
    """Download a catalog, check it, and remember its digest.

    Example: starcat fetch tycho2
    """
    from starcat.catalog.fetch import cache_folder, fetch_source
    from starcat.catalog.source import data_source
    from starcat.console import progress_bars
    from starcat.reports import print_fetched

    with progress_bars() as progress:
        report = fetch_source(
            data_source(source),
            output or cache_folder(),
            parts=tuple(part or ()),
            retries=retries,
            progress=progress,
        )
    print_fetched(report, as_json=json)


@app.command()
def ingest(
    source: Annotated[str, typer.Argument(help="A star catalog, such as sao.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Parquet file to write.")],
    inputs: Annotated[
        list[Path] | None,
        typer.Option("--input", help="File or folder of the catalog. Repeatable."),
    ] = None,
    epoch: Annotated[
        float | None,
        typer.Option(
            min=1800, max=2200, help="Julian year to move positions to; default: its own."
        ),
    ] = None,
    band: Annotated[str | None, typer.Option(help="Band of the magnitudes.")] = None,
    read_limit_mag: Annotated[
        float | None,
        typer.Option(min=-30, max=40, help="Leave out fainter records while reading."),
    ] = None,
    json: Json = False,
) -> None:
    """Read an archive file into a star table (Parquet), with a reason for every row left out.

    Example: starcat ingest sao --input sao.dat.gz -o sao.parquet --epoch 2026.0
    """
    from starcat.catalog.export import write_star_tables
    from starcat.catalog.ingest import ingest as read_catalog
    from starcat.catalog.locate import locate
    from starcat.console import progress_bars
    from starcat.reports import print_ingested

    with progress_bars() as progress:
        read = read_catalog(
            source,
            locate(source, {source: inputs or []}),
            band=band,
            epoch_jyear=epoch,
            read_limit_mag=read_limit_mag,
            progress=progress,
        )
        write_star_tables(read, output)
    print_ingested(read, output, as_json=json)


@app.command()
def build(
    spec: Annotated[Path | None, typer.Argument(help="A build spec (TOML).")] = None,
    preset: Annotated[str | None, typer.Option(help="A spec that ships with starcat.")] = None,
    inputs: Input = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder to put <name>-<version>/ into.")
    ] = Path("dist"),
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace a different artifact of that name.")
    ] = False,
    workers: Annotated[
        int, typer.Option(min=1, max=64, help="Threads; the artifact is the same for any number.")
    ] = 2,
    json: Json = False,
) -> None:
    """Build a guide-star database, check it, and prove that it identifies its own fields.

    Example: starcat build --preset sao-12deg --input sao=sao.dat.gz -o dist
    """
    from starcat.console import progress_bars
    from starcat.pipeline import build as run_build
    from starcat.reports import print_built

    chosen, given = _spec(spec, preset), _inputs(inputs)
    with progress_bars() as progress:
        built = run_build(
            chosen, given, output, replace=replace, workers=workers, progress=progress
        )
    print_built(built, as_json=json)


@app.command()
def inspect(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    json: Json = False,
) -> None:
    """Say what an artifact holds and what it was made from.

    Example: starcat inspect dist/gaia-12deg-1.0.0
    """
    from starcat.artifact.reader import open_artifact
    from starcat.reports import print_artifact

    print_artifact(open_artifact(artifact), as_json=json)


@app.command()
def verify(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    json: Json = False,
) -> None:
    """Check an artifact: digests, schemas, rows, orders, indices, references, counts.

    Exits with 5 if anything is wrong.

    Example: starcat verify dist/gaia-12deg-1.0.0
    """
    from starcat.artifact.verify import verify_artifact
    from starcat.artifact_reports import print_verification

    found = verify_artifact(artifact)
    print_verification(found, as_json=json)
    if found.findings:
        raise typer.Exit(ProductError.exit_code)


@app.command()
def diff(
    a: Annotated[Path, typer.Argument(metavar="A", help="The earlier artifact's folder.")],
    b: Annotated[Path, typer.Argument(metavar="B", help="The later one's.")],
    json: Json = False,
) -> None:
    """Say what differs between two artifacts: spec, sources, stars and why, products.

    Example: starcat diff dist/gaia-12deg-1.0.0 dist/gaia-12deg-1.1.0
    """
    from starcat.artifact.diff import diff_artifacts
    from starcat.artifact.reader import open_artifact
    from starcat.artifact_reports import print_difference

    found = diff_artifacts(open_artifact(a), open_artifact(b))
    print_difference(found, (a.resolve().name, b.resolve().name), as_json=json)


@app.command()
def rebuild(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    inputs: Input = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder to keep the new artifact in.")
    ] = None,
    json: Json = False,
) -> None:
    """Build an artifact again from its manifest and compare every byte.

    Exits with 5 if a file differs.

    Example: starcat rebuild dist/sao-12deg-1.0.0 --input sao=sao.dat.gz
    """
    from starcat.artifact_reports import print_rebuilt
    from starcat.console import progress_bars
    from starcat.rebuild import rebuild as build_again

    given = _inputs(inputs)
    with progress_bars() as progress:
        rebuilt = build_again(artifact, given, output, progress)
    print_rebuilt(rebuilt, as_json=json)
    if not rebuilt.is_identical:
        raise typer.Exit(ProductError.exit_code)


@app.command()
def coverage(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for CSV, JSON, PNG and SVG.")
    ] = None,
    json: Json = False,
) -> None:
    """Say how many stars, pairs and triangles the fields of an artifact hold.

    Example: starcat coverage dist/gaia-12deg-1.0.0 -o coverage
    """
    from starcat.artifact.reader import open_artifact
    from starcat.coverage_tables import print_coverage

    print_coverage(open_artifact(artifact), output, as_json=json)


@app.command()
def simulate(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="CSV file to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same frame.")] = 0,
    noise_px: NoisePx = 0.5,
    false_stars: Annotated[int, typer.Option(min=0, help="Spots that are no stars.")] = 0,
) -> None:
    """Write the centroids of one simulated frame, to try 'starcat identify' with.

    Example: starcat simulate dist/gaia-12deg-1.0.0 -o frame.csv --seed 7
    """
    from starcat.evaluation.simulate import Noise, simulate_frames
    from starcat.matcher.centroids import write_centroids
    from starcat.matcher.database import open_database

    database = open_database(artifact)
    noise = Noise(noise_px, false_stars=false_stars)
    frame = next(simulate_frames(database.directions, database.camera, 1, noise, seed))
    write_centroids(frame.centroids_px, output)


@app.command()
def identify(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    centroids: Annotated[Path, typer.Argument(help="CSV file with the columns x_px,y_px.")],
    tolerance_px: Annotated[
        float, typer.Option(min=0.01, max=200, help="Largest error of a centroid.")
    ] = 2.0,
    json: Json = False,
) -> None:
    """Identify the stars of a frame and find the camera's attitude.

    Example: starcat identify dist/gaia-12deg-1.0.0 frame.csv
    """
    from starcat.matcher.centroids import read_centroids
    from starcat.matcher.matcher import Matcher
    from starcat.reports import print_match

    matcher = Matcher.open(artifact, tolerance_px)
    measured = read_centroids(centroids)
    print_match(matcher.identify(measured), measured, matcher.database, as_json=json)


@app.command()
def selftest(
    artifact: Annotated[Path, typer.Argument(help="The folder <name>-<version>.")],
    frames: Annotated[int, typer.Option(min=1, help="Fields of each kind.")] = 500,
    seed: Annotated[int, typer.Option(min=0, help="Same seed, same fields.")] = 1,
    noise_px: NoisePx = 0.5,
    json: Json = False,
) -> None:
    """Identify simulated fields with a database and print the rates.

    Example: starcat selftest dist/gaia-12deg-1.0.0 --frames 1000
    """
    from starcat.console import progress_bars
    from starcat.evaluation.selftest import self_test
    from starcat.matcher.matcher import Matcher
    from starcat.reports import print_rates

    matcher = Matcher.open(artifact, tolerance_px=max(0.5, 4.0 * noise_px))
    with progress_bars() as progress:
        rates = self_test(matcher, frames, noise_px, seed, progress)
    print_rates(rates, as_json=json)


def _spec(path: Path | None, name: str | None) -> BuildSpec:
    from starcat.spec import preset as named_preset
    from starcat.spec import preset_names, read_spec

    if path is not None and name is not None:
        raise ConfigError("give either a spec file or --preset, not both")
    if path is not None:
        return read_spec(path)
    return named_preset(name or preset_names()[0])


def _inputs(given: list[str] | None) -> Mapping[str, list[Path]]:
    from starcat.catalog.source import data_source

    inputs: dict[str, list[Path]] = {}
    for text in given or []:
        name, separator, path = text.partition("=")
        if not separator or not path:
            raise ConfigError(f"--input {text!r} is not SOURCE=PATH, such as sao=sao.dat.gz")
        inputs.setdefault(data_source(name).name, []).append(Path(path))
    return inputs


def _stop(number: int, frame: Any) -> None:
    """Turn a termination signal into an exit that cleans up."""
    sys.exit(128 + number)


def main() -> None:
    """Run the command line, and turn errors into a message and an exit code.

    What the operating system refuses at a place that nobody foresaw exits with 1.
    """
    signal.signal(signal.SIGTERM, _stop)
    try:
        app(prog_name="starcat")
    except StarcatError as error:
        if "--debug" in sys.argv:
            raise
        sys.stderr.write(f"starcat: error: {error}\n")
        sys.exit(error.exit_code)
    except OSError as error:
        if "--debug" in sys.argv:
            raise
        where = f"{error.filename}: " if error.filename else ""
        sys.stderr.write(f"starcat: error: {where}{reason(error)}\n")
        sys.exit(1)
