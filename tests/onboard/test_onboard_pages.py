"""The pages on the C library: their code compiles, and their numbers follow from each other."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
ONBOARD = ROOT / "onboard"
sys.path.insert(0, str(ROOT / "benchmarks"))

from steps import Bound, Budget, budget_rows, cortex_m7_bounds  # noqa: E402

MANUAL = (ROOT / "docs" / "onboard-manual.md").read_text(encoding="utf-8")
PAGE = (ROOT / "docs" / "onboard-microcontroller.md").read_text(encoding="utf-8")

LIBM = "".join(
    f"float {name}({takes});\n"
    for name, takes in {
        "sqrtf": "float x", "sinf": "float x", "cosf": "float x", "logf": "float x",
        "atan2f": "float y, float x",
    }.items()
)  # fmt: skip

OF_LIBC = """
#include <stddef.h>
#include "libm.h"
float sqrtf(float x) { return x; }
float sinf(float x) { return x; }
float cosf(float x) { return x; }
float logf(float x) { return x; }
float atan2f(float y, float x) { return y + x; }
void *memcpy(void *to, const void *from, size_t n) {
  for (size_t k = 0; k < n; k++) ((volatile char *)to)[k] = ((const char *)from)[k];
  return to;
}
void *memmove(void *to, const void *from, size_t n) { return memcpy(to, from, n); }
void *memset(void *to, int byte, size_t n) {
  for (size_t k = 0; k < n; k++) ((volatile char *)to)[k] = (char)byte;
  return to;
}
"""
"""Functions in the place of libm's and libc's, so that any compiler for ARM links the example."""

CALLS = ("start_tracker", "track_stars", "longest_frame_cycles", "check_flash")


def numbers(text: str) -> list[float]:
    return [float(number.replace(",", "")) for number in re.findall(r"\d[\d,]*\.?\d*", text)]


def test_a_bound_counts_at_most_5000_look_ups():
    bound = Bound(once=1000, per_step=10, per_look_up=100)
    assert bound.longest_s(100, 1.0) == pytest.approx(1.5 * (1000 + 1000 + 10_000) * 1e-6)
    assert bound.longest_s(6000, 2.0) == pytest.approx(1.5 * (1000 + 60_000 + 500_000) * 0.5e-6)


def test_the_budget_of_the_manual_follows_from_the_steps_and_the_bounds():
    """`benchmarks/steps.py` prints these rows: after a new table of either, print them again."""
    steps = (ROOT / "docs" / "onboard.md").read_text(encoding="utf-8").split("\n## Steps\n")[1]
    shown = re.findall(r"^\| \d+ MHz \|.*\|$", MANUAL, re.MULTILINE)
    bounds, budgets = cortex_m7_bounds(MANUAL), {}
    for row in shown[:2]:
        call, *cells = (cell.strip() for cell in row.strip("|").split("|")[1:])
        max_steps, identified = int(cells[0].replace(",", "")), float(cells[1].removesuffix(" %"))
        [of_frames] = re.findall(rf"^\| gaia-12deg \| {call} \| hard \|(.*)$", steps, re.MULTILINE)
        within_99, least = numbers(of_frames)[-3], numbers(of_frames)[-1]
        assert identified >= 99.0
        assert least <= max_steps < within_99 + 1000.0
        budgets[call] = Budget(max_steps, identified)
    printed = [row for clock_mhz in (100, 400) for row in budget_rows(budgets, bounds, clock_mhz)]
    assert shown == printed


def test_one_document_has_the_limit_of_code():
    """SC-304 has it; ``make size`` reads it there."""
    texts = {
        path: path.read_text(encoding="utf-8")
        for path in (*ROOT.glob("docs/*.md"), *ONBOARD.rglob("*"))
        if path.suffix in (".md", ".sh", ".toml", ".h", ".c") and "build" not in path.parts
    }
    limit = r"at most [\d,]+ (?:KiB|kB|bytes) of code|code.{0,40}at most [\d,]+ (?:KiB|bytes)"
    assert [path.name for path, text in texts.items() if re.search(limit, text)] == [
        "requirements.toml"
    ]


def test_what_flies_knows_nothing_of_the_ground():
    for path in (*ONBOARD.glob("src/*"), *ONBOARD.glob("include/*")):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r"STARCAT_GROUND|\bPython\b|\bcFS\b|\bBasilisk\b", text), path.name


def test_the_example_for_a_microcontroller_compiles_and_fits(tmp_path):
    """The code and the linker script of the page, with its flags, for the Cortex-M7."""
    names = ("arm-none-eabi-gcc", "arm-linux-gnueabihf-gcc")
    compiler = next((name for name in names if shutil.which(name)), None)
    if compiler is None:
        pytest.skip("there is no compiler for ARM")
    [code] = re.findall(r"```c\n(.*?)```", PAGE, re.DOTALL)
    [script] = re.findall(r"```ld\n(.*?)```", PAGE, re.DOTALL)
    flags = re.search(r'^m7="(.*)"$', PAGE, re.MULTILINE)[1].split()
    limits = re.search(r'^limits="(.*)"$', PAGE, re.MULTILINE)[1].split()
    texts = {"tracker.c": code, "flash.ld": script, "libc.c": OF_LIBC, "libm.h": LIBM}
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    (tmp_path / "small.img").write_bytes(bytes(159_744))

    def run(*command: str | Path) -> str:
        ran = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert ran.returncode == 0, ran.stderr
        return ran.stdout

    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-fno-builtin", *limits]
    strict += [f"-I{ONBOARD / 'include'}", "-I.", '-DSTARCAT_MATH_HEADER="libm.h"']
    run(compiler, *flags, *strict, "-c", *ONBOARD.glob("src/*.c"), "tracker.c", "libc.c")
    image = ONBOARD / "examples" / "cortex-m" / "image.S"
    run(compiler, *flags, '-DIMAGE="small.img"', "-c", image, "-o", "flash.o")
    kept = [f"-Wl,--undefined={name}" for name in CALLS]
    linked = ["-nostdlib", "-static", "-T", "flash.ld", "-Wl,--gc-sections,-e,start_tracker"]
    run(compiler, *flags, *linked, *kept, *tmp_path.glob("*.o"), "-lgcc", "-o", "tracker.elf")
    symbols = [line.split() for line in run(f"{compiler[:-3]}nm", "tracker.elf").splitlines()]
    at = {words[2]: int(words[0], 16) for words in symbols if len(words) == 3}
    assert at["image_begin"] == 0x08040000
    assert at["image_end"] - at["image_begin"] == 159_744
    assert 0x20000000 <= at["session"] < 0x20020000
    assert all(0x08000000 <= at[name] < 0x08040000 for name in CALLS)
