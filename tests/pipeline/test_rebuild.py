"""Rebuilding: the same bytes from the manifest, or what differs."""

from __future__ import annotations

import json

import pytest
from database_copies import seal

from starcat.cli.console import show_result
from starcat.database import manifest as manifest_module
from starcat.database.diff import Change
from starcat.database.manifest import MANIFEST_NAME
from starcat.errors import ChecksumMismatch, ConfigError, SourceMissing
from starcat.pipeline.rebuild import FileChange, Rebuilt, rebuild
from starcat.storage.parquet import read_parquet, write_parquet


def test_the_same_inputs_give_the_same_bytes(small_database, sao_file, tmp_path):
    events: list[str] = []
    rebuilt = rebuild(
        small_database,
        {"sao": [sao_file]},
        tmp_path / "again",
        lambda stage, *_: events.append(stage),
    )
    assert events[0] == "check inputs"
    assert "self-test" in events
    assert rebuilt.is_identical
    assert rebuilt.verdict == "identical"
    assert rebuilt.name == "small-1.0.0"
    assert rebuilt.files == sum(path.is_file() for path in small_database.rglob("*"))
    assert (rebuilt.changes, rebuilt.software) == ((), ())
    made = tmp_path / "again" / "small-1.0.0" / MANIFEST_NAME
    assert made.read_bytes() == (small_database / MANIFEST_NAME).read_bytes()


def test_another_input_is_refused(small_database, sao_file):
    data = bytearray(sao_file.read_bytes())
    data[83] ^= 1
    other = sao_file.with_name("other.dat")
    other.write_bytes(data)
    with pytest.raises(ChecksumMismatch, match=r"other.dat: sha256 .* was made from sao.dat") as e:
        rebuild(small_database, {"sao": [other]})
    assert (e.value.source, e.value.path) == ("sao", other)
    with pytest.raises(ChecksumMismatch, match=r"2 input files; .* was made from 1"):
        rebuild(small_database, {"sao": [sao_file, other]})
    with pytest.raises(ConfigError, match="does not read gaia"):
        rebuild(small_database, {"sao": [sao_file], "gaia": [sao_file]})


def test_a_missing_input_is_named(small_database, monkeypatch, tmp_path):
    monkeypatch.setenv("STARCAT_CATALOGS", str(tmp_path))
    monkeypatch.setenv("STARCAT_CACHE", str(tmp_path))
    with pytest.raises(SourceMissing, match=r"no file found in .*; small-1.0.0 was made from sao"):
        rebuild(small_database, {})


def test_what_differs_is_named(database_copy, sao_file, tmp_path, monkeypatch):
    """By another library, by other columns of a sound database, and by what was changed later.

    Without an output nothing is left.
    """
    found = manifest_module.version
    versions = {"numpy": "99.0"}
    monkeypatch.setattr(manifest_module, "version", lambda name: versions.get(name) or found(name))
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    path = database_copy / "stars.parquet"
    table = read_parquet(path)
    place = table.schema.get_field_index("mag")
    write_parquet(table.set_column(place, table.schema.field(place), table["z"]), path)
    short = read_parquet(database_copy / "boresights.parquet").slice(1)
    write_parquet(short, database_copy / "boresights.parquet")
    seal(database_copy)
    (database_copy / "pairs.parquet").write_bytes(b"PAR1")
    (database_copy / "triangles.parquet").unlink()
    (database_copy / "notes.txt").write_text("mine")
    rebuilt = rebuild(database_copy, {"sao": [sao_file]})
    assert not rebuilt.is_identical
    assert rebuilt.verdict == "different"
    assert rebuilt.software == (Change("numpy", found("numpy"), "99.0"),)
    changes = {change.file: change.what for change in rebuilt.changes}
    assert {name: what for name, what in changes.items() if not name.startswith("report/")} == {
        MANIFEST_NAME: "differs in files, software",
        "boresights.parquet": f"built differently: {len(short)} rows before, {len(short) + 1} now",
        "notes.txt": "not made by the rebuild",
        "pairs.parquet": "changed since it was built",
        "stars.parquet": "built differently: mag",
        "triangles.parquet": "missing in the database",
    }
    assert list(temporary.iterdir()) == []


def test_other_software_with_the_same_products_is_a_verdict_of_its_own(
    database_copy, sao_file, starcat, monkeypatch
):
    monkeypatch.setattr("platform.python_version", lambda: "3.99.0")
    ran = starcat(["rebuild", database_copy, "--input", f"sao={sao_file}"])
    assert ran.code == 7
    assert "files 28 verdict same products" in " ".join(ran.out.split())
    assert "3.99.0" in ran.out
    # A file that was changed since is another thing, whatever the software is.
    page = database_copy / "report" / "index.html"
    page.chmod(0o644)
    page.write_text("mine")
    ran = starcat(["rebuild", database_copy, "--input", f"sao={sao_file}", "--json"])
    assert ran.code == 5
    assert json.loads(ran.out)["verdict"] == "different"


@pytest.mark.slow
def test_the_command(database_copy, sao_file, starcat, capsys):
    ran = starcat(["rebuild", database_copy, "--input", f"sao={sao_file}"])
    assert ran.code == 0
    assert "verdict identical" in " ".join(ran.out.split())
    (database_copy / "pairs.parquet").write_bytes(b"PAR1")
    ran = starcat(["rebuild", database_copy, "--input", f"sao={sao_file}", "--json"])
    assert ran.code == 5
    content = json.loads(ran.out)
    assert content["is_identical"] is False
    assert [change["file"] for change in content["changes"]] == ["pairs.parquet"]
    capsys.readouterr()
    changes = (FileChange("pairs.parquet", "changed since it was built"),)
    show_result(Rebuilt("a-1.0.0", 9, changes, (Change("numpy", "1", "2"),), "different"))
    printed = capsys.readouterr().out
    assert "a-1.0.0" in printed
    assert "changed since it was built" in printed
    assert "numpy" in printed
    sao_file.write_bytes(b"")
    assert starcat(["rebuild", database_copy, "--input", f"sao={sao_file}"]).code == 3
