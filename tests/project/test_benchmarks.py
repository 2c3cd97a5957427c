"""Benchmarks run: the quick form of each succeeds, or names what it needs and does not find."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
LACKING = 77

BENCHMARKS = [
    "acquisition", "campaign", "crossmatch_sql", "crowded", "deep_fields", "engines",
    "false_matches", "fields", "first_camera", "hostile", "ingest", "instructions", "interrupts",
    "matcher --of tetra3rs", "matcher --of starcat", "matcher --of cedar-solve",
    "matcher --of ruststartracker", "narrow_field", "other_fields", "photographs", "pictures",
    "planning", "products", "scale", "service", "service_load", "shapes", "small_images", "sql",
    "steps", "tracking", "votable",
]  # fmt: skip


def test_every_script_is_a_benchmark_or_a_part_of_one():
    texts = {path.stem: path.read_text() for path in FOLDER.glob("*.py")}
    known = {name.split()[0] for name in BENCHMARKS}
    while more := {
        part
        for name in known
        for part in re.findall(r"\b(?:from|import) (\w+)", texts[name])
        if part in texts and part not in known
    }:
        known |= more
    # ingest has its bare parsers in a process of its own, scale the peer that it is compared with.
    assert known | {"bare_parsers", "hats_peer"} == set(texts)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize("asked", BENCHMARKS)
def test_the_quick_form_of_a_benchmark_ends_well(asked, tmp_path):
    name, *options = asked.split()
    command = [sys.executable, str(FOLDER / f"{name}.py"), "--quick", *options]
    ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    if ran.returncode == LACKING:
        pytest.skip(ran.stderr.strip().splitlines()[-1])
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert ran.stdout


def test_a_row_that_fails_fails_the_benchmark(tmp_path):
    script = tmp_path / "one.py"
    script.write_text(
        f"import sys; sys.path.insert(0, {str(FOLDER)!r})\n"
        "from rows import LackingError, ended\n"
        "def main(rows):\n"
        "    with rows.row('first'):\n"
        "        raise LackingError('a program')\n"
        "    if '--fail' in sys.argv:\n"
        "        with rows.row('second'):\n"
        "            raise ValueError('two rows')\n"
        "        rows.expect(1 > 2, 'third: one is less')\n"
        "ended(main)\n"
    )
    lacking, failed = (
        subprocess.run([sys.executable, script, *given], capture_output=True, text=True)
        for given in ([], ["--fail"])
    )
    assert lacking.returncode == LACKING
    assert lacking.stderr == "not there: first: a program\n"
    assert failed.returncode == 1
    assert "failed: second: ValueError: two rows\nfailed: third: one is less\n" in failed.stderr
