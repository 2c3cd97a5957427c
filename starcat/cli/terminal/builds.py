"""What each command prints: the same facts as tables for people or JSON for machines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from starcat.cli.terminal.console import print_json, print_table, say
from starcat.cli.terminal.coverage_tables import print_coverage_table
from starcat.errors import SourceError

if TYPE_CHECKING:
    from starcat.artifact.reader import Artifact
    from starcat.catalog.fetch import FetchReport
    from starcat.catalog.ingest import Ingested
    from starcat.pipeline.build import Built
    from starcat.pipeline.cost import Cost
    from starcat.simulation.selftest import Rates
    from starcat.store.ingest import Stored


def print_sources(*, as_json: bool) -> None:
    """Print the data sources and where each would be read from."""
    from starcat.catalog.source import data_source, source_names
    from starcat.catalog.source_files import locate

    found: list[dict[str, Any]] = []
    for name in source_names():
        source = data_source(name)
        try:
            place = ", ".join(str(path) for path in locate(name, {}))
        except SourceError:
            place = ""
        found.append(
            {
                "name": name,
                "kind": source.kind,
                "identifier": source.identifier,
                "rows": source.rows,
                "bands": list(source.bands),
                "epoch_jyear": source.epoch_jyear,
                "licence": source.licence,
                "citation": source.citation,
                "found_at": place or None,
            }
        )
    if as_json:
        print_json(found)
        return
    print_table(
        "",
        ("source", "identifier", "rows", "bands", "read from"),
        [
            (
                entry["name"],
                entry["identifier"],
                f"{entry['rows']:,}" if entry["rows"] else "",
                " ".join(entry["bands"]) or "(joined)",
                entry["found_at"] or "not found",
            )
            for entry in found
        ],
        numbers=(2,),
    )


def print_fetched(report: FetchReport, *, as_json: bool) -> None:
    """Print what was fetched."""
    rows = [
        {
            "name": file.name,
            "status": file.status,
            "rows": file.rows,
            "bytes": file.bytes,
            "sha256": file.sha256,
            "path": str(file.path),
        }
        for file in report.files
    ]
    if as_json:
        print_json(rows)
        return
    cells = [(r["name"], r["status"], f"{r['rows']:,}", f"{r['bytes']:,}") for r in rows]
    print_table(f"{report.source}", ("file", "status", "rows", "bytes"), cells, numbers=(2, 3))


def print_ingested(read: Ingested, output: Path, *, as_json: bool) -> None:
    """Print what became of the records of a catalog."""
    from starcat.catalog.verdict import rejected_path

    facts = {
        "source": read.source,
        "band": read.band,
        "rows_read": read.rows_read,
        "kept": len(read.stars),
        "rejected": read.rejected_by_reason,
        "files": [vars(file) for file in read.files],
        "stars": str(output),
        "rejected_rows": str(rejected_path(output)) if len(read.rejected) else None,
        "problems": list(read.problems),
        "notes": list(read.notes),
    }
    beside = f" and {rejected_path(output).name}" if len(read.rejected) else ""
    _print_records(facts, f"wrote {output}{beside}", as_json=as_json)


def print_stored(made: Stored, *, as_json: bool) -> None:
    """Print what became of the records of a catalog that was read into a store."""
    manifest = made.manifest
    facts = {
        "source": manifest["source"],
        "band": manifest["band"],
        "rows_read": manifest["rows_read"],
        "kept": manifest["kept"],
        "rejected": manifest["rejected"],
        "files": manifest["files"],
        "store": str(made.folder),
        "outcome": made.outcome,
        "partitions": len(manifest["partitions"]),
        "problems": list(made.problems),
        "notes": list(made.notes),
    }
    told = f"{made.outcome} {made.folder}: {len(manifest['partitions'])} partitions"
    _print_records(facts, told, as_json=as_json)


def _print_records(facts: dict[str, Any], told: str, *, as_json: bool) -> None:
    """Print what was read, kept and rejected, and where it is."""
    for note in facts["notes"]:
        say(f"note: {note}")
    if as_json:
        print_json(facts)
        return
    print_table("", ("records", "rows"), _balance(facts), numbers=(1,))
    print_problems(facts["problems"])
    say(told)


def print_problems(problems: Sequence[str]) -> None:
    """Print the first malformed records on stderr."""
    for problem in problems[:5]:
        say(f"malformed: {problem}")


def _balance(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Rows read, kept and rejected by reason: the two sides are equal."""
    from starcat.catalog.verdict import Reason

    rows = [("read", f"{facts['rows_read']:,}"), ("kept", f"{facts['kept']:,}")]
    for name, count in facts["rejected"].items():
        rows.append((f"rejected: {name} ({Reason[name].value})", f"{count:,}"))
    if facts.get("role") == "crossmatch":
        rows.append(("guide stars with a counterpart", f"{facts['joined']:,}"))
    if facts.get("role") == "motions":
        rows.append(("guide stars whose motion is from here", f"{facts['joined']:,}"))
    for name, moved_arcsec in facts.get("moved_arcsec", {}).items():
        rows.append((f"{name} movement of these, arcsec", f"{moved_arcsec:.3f}"))
    return rows


def print_built(built: Built, *, as_json: bool) -> None:
    """Print what a build made."""
    manifest, report = built.manifest, built.folder / "report" / "index.html"
    for warning in built.warnings:
        say(f"warning: {warning}")
    if as_json:
        print_json(
            {
                "artifact": str(built.folder),
                "report": str(report),
                "outcome": built.outcome,
                "filters": [vars(step) for step in built.filters],
                "coverage": built.coverage.as_dict(),
                "self_test": [rates.as_dict() for rates in built.rates],
                "warnings": list(built.warnings),
                "times_s": built.times_s,
                **{key: manifest[key] for key in ("sources", "products", "files")},
            }
        )
        return
    _print_contents(built)
    seconds = [(stage, f"{taken:.2f}") for stage, taken in built.times_s.items()]
    print_table("Times", ("stage", "seconds"), seconds, numbers=(1,))
    print_problems(built.problems)
    say(f"{built.outcome}: {built.folder}")
    say(f"report: {report}")


def print_refused(built: Built, *, as_json: bool) -> None:
    """Print what a build made that failed its self-test, and what it warns of."""
    for warning in built.warnings:
        say(f"warning: {warning}")
    if not as_json:
        _print_contents(built)


def _print_contents(built: Built) -> None:
    """Print what went into a build, what it made and how that identifies."""
    manifest = built.manifest
    for source in manifest["sources"]:
        print_table(
            f"{source['source']} ({source['role']})",
            ("records", "rows"),
            _balance(source),
            numbers=(1,),
        )
    print_table(
        "What each filter leaves in the fields of the tiling",
        ("after", "stars", "median a field", "fewest", "fields below 4"),
        [
            (
                step.step,
                f"{step.stars:,}",
                f"{step.median_per_field:g}",
                step.min_per_field,
                f"{step.share_below_4:.2%}",
            )
            for step in built.filters
        ],
        numbers=(1, 2, 3, 4),
    )
    print_products(manifest)
    print_coverage_table(built.coverage)
    print_rates(built.rates, as_json=False)


def print_cost(cost: Cost) -> None:
    """Print on stderr what a build will cost."""
    say(cost.in_words)


def print_products(manifest: dict[str, Any]) -> None:
    """Print the products of an artifact."""
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


def print_rates(rates: Sequence[Rates], *, as_json: bool) -> None:
    """Print the rates of a self-test."""
    if as_json:
        print_json([rate.as_dict() for rate in rates])
        return
    print_table(
        "Simulated fields, with noise of position (px) and of magnitude",
        ("fields", "px", "mag", "dropped", "false", "tried", "4+ stars", "right", "wrong", "rate"),
        [
            (
                rate.name,
                f"{rate.noise_px:g}",
                "" if rate.noise_mag is None else f"{rate.noise_mag:g}",
                f"{rate.drop_probability:.0%}",
                rate.false_stars,
                rate.frames,
                rate.identifiable,
                rate.identified,
                rate.wrong,
                f"{rate.identified_share:.1%}",
            )
            for rate in rates
            if rate.frames
        ],
        numbers=tuple(range(1, 10)),
    )


def print_artifact(artifact: Artifact, *, as_json: bool) -> None:
    """Print what an artifact holds."""
    from starcat.specs.build_spec import CameraSpec

    manifest = artifact.manifest
    if as_json:
        print_json(manifest)
        return
    spec = manifest["spec"]
    camera = CameraSpec.model_validate(spec["camera"]).camera()
    selection = spec["selection"]
    print_table(
        f"{manifest['name']}-{manifest['version']}",
        ("", ""),
        [
            ("description", spec["description"]),
            ("frame, epoch", f"{manifest['frame']}, J{manifest['epoch_jyear']:g}"),
            ("camera", camera.in_words),
            ("faint limit", f"{selection['faint_limit_mag']:g} mag"),
            ("made by", ", ".join(f"{k} {v}" for k, v in manifest["software"].items())),
        ],
    )
    for source in manifest["sources"]:
        files = ", ".join(f"{file['name']} ({file['sha256'][:12]})" for file in source["files"])
        print_table(f"{source['source']} from {files}", ("records", "rows"), _balance(source), (1,))
    print_products(manifest)
