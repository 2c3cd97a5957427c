"""Benchmarks run: the quick form of those that have one ends well."""

import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["campaign", "false_matches", "fields", "hostile"])
def test_the_quick_form_of_a_benchmark_ends_well(name, tmp_path):
    script = str(FOLDER / f"{name}.py")
    ran = subprocess.run(
        [sys.executable, script, "--quick"], cwd=tmp_path, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    assert ran.stdout
