"""Rebuilding: the same bytes from the manifest, or what differs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from artifact_copies import seal

from starcat.artifact import manifest as manifest_module
from starcat.artifact.diff import Change
from starcat.artifact.manifest import MANIFEST_NAME
from starcat.cli.artifacts import print_rebuilt
from starcat.errors import ChecksumMismatch, ConfigError, ProductError, SourceMissing
from starcat.pipeline.rebuild import FileChange, Rebuilt, rebuild
from starcat.storage.parquet import read_parquet, write_parquet


def test_the_same_inputs_give_the_same_bytes(small_artifact, sao_file, tmp_path):
    events: list[str] = []
    rebuilt = rebuild(
        small_artifact,
        {"sao": [sao_file]},
        tmp_path / "again",
        lambda stage, *_: events.append(stage),
    )
    assert events[0] == "check inputs"
    assert "self-test" in events
    assert rebuilt.is_identical
    assert rebuilt.name == "small-1.0.0"
    assert rebuilt.files == sum(path.is_file() for path in small_artifact.rglob("*"))
    assert (rebuilt.changes, rebuilt.software) == ((), ())
    made = tmp_path / "again" / "small-1.0.0" / MANIFEST_NAME
    assert made.read_bytes() == (small_artifact / MANIFEST_NAME).read_bytes()


def test_another_input_is_refused(small_artifact, sao_file):
    data = bytearray(sao_file.read_bytes())
    data[83] ^= 1
    other = sao_file.with_name("other.dat")
    other.write_bytes(data)
    with pytest.raises(ChecksumMismatch, match=r"other.dat: sha256 .* was made from sao.dat") as e:
        rebuild(small_artifact, {"sao": [other]})
    assert (e.value.source, e.value.path) == ("sao", other)
    with pytest.raises(ChecksumMismatch, match=r"2 input files; .* was made from 1"):
        rebuild(small_artifact, {"sao": [sao_file, other]})
    with pytest.raises(ConfigError, match="does not read gaia"):
        rebuild(small_artifact, {"sao": [sao_file], "gaia": [sao_file]})


def test_a_missing_input_or_artifact_is_an_error(small_artifact, tmp_path, monkeypatch):
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path / "none"))
    monkeypatch.delenv("STARCAT_CATALOGS", raising=False)
    with pytest.raises(SourceMissing):
        rebuild(small_artifact, {})
    with pytest.raises(ProductError):
        rebuild(tmp_path, {})


def test_other_libraries_are_named(artifact_copy, sao_file, monkeypatch):
    found = manifest_module.version

    def version(name: str) -> str:
        return "99.0" if name == "numpy" else found(name)

    monkeypatch.setattr(manifest_module, "version", version)
    rebuilt = rebuild(artifact_copy, {"sao": [sao_file]})
    assert not rebuilt.is_identical
    changes = {change.file: change.what for change in rebuilt.changes}
    assert changes.pop(MANIFEST_NAME).endswith("software")
    assert {Path(name).parts[0] for name in changes} <= {"report"}
    assert rebuilt.software == (Change("numpy", found("numpy"), "99.0"),)


def test_what_was_changed_afterwards_is_named(artifact_copy, sao_file, tmp_path, monkeypatch):
    """Without an output nothing is left."""
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    (artifact_copy / "pairs.parquet").write_bytes(b"PAR1")
    (artifact_copy / "triangles.parquet").unlink()
    (artifact_copy / "notes.txt").write_text("mine")
    rebuilt = rebuild(artifact_copy, {"sao": [sao_file]})
    assert [(change.file, change.what) for change in rebuilt.changes] == [
        ("notes.txt", "not made by the rebuild"),
        ("pairs.parquet", "changed since it was built"),
        ("triangles.parquet", "missing in the database"),
    ]
    assert list(temporary.iterdir()) == []


def test_columns_that_came_out_differently_are_named(artifact_copy, sao_file):
    """A database that is sound by its own manifest, and still not what the inputs give."""
    path = artifact_copy / "stars.parquet"
    table = read_parquet(path)
    place = table.schema.get_field_index("mag")
    write_parquet(table.set_column(place, table.schema.field(place), table["z"]), path)
    short = read_parquet(artifact_copy / "pairs.parquet").slice(1)
    write_parquet(short, artifact_copy / "pairs.parquet")
    seal(artifact_copy)
    changes = {
        change.file: change.what for change in rebuild(artifact_copy, {"sao": [sao_file]}).changes
    }
    assert changes == {
        MANIFEST_NAME: "differs in files",
        "pairs.parquet": f"built differently: {len(short)} rows before, {len(short) + 1} now",
        "stars.parquet": "built differently: mag",
    }


@pytest.mark.slow
def test_the_command(artifact_copy, sao_file, starcat, capsys):
    ran = starcat(["rebuild", artifact_copy, "--input", f"sao={sao_file}"])
    assert ran.code == 0
    assert "every byte the same" in ran.out
    (artifact_copy / "pairs.parquet").write_bytes(b"PAR1")
    ran = starcat(["rebuild", artifact_copy, "--input", f"sao={sao_file}", "--json"])
    assert ran.code == 5
    content = json.loads(ran.out)
    assert content["is_identical"] is False
    assert [change["file"] for change in content["changes"]] == ["pairs.parquet"]
    capsys.readouterr()
    changes = (FileChange("pairs.parquet", "changed since it was built"),)
    print_rebuilt(Rebuilt("a-1.0.0", 9, changes, (Change("numpy", "1", "2"),)))
    printed = capsys.readouterr().out
    assert "a-1.0.0: 1 of 9 files differ" in printed
    assert "changed since it was built" in printed
    assert "numpy" in printed
    sao_file.write_bytes(b"")
    assert starcat(["rebuild", artifact_copy, "--input", f"sao={sao_file}"]).code == 3
