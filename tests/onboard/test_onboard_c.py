"""The C library of ``onboard/``: its own tests, with the compilers and tools that are there.

The folder is copied first, so that it is built as it stands for itself, without the rest.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from compilers import c_compiler

from starcat.database.onboard.image import Contents, longest_pair_rad, make_image
from starcat.database.products.pairs import find_pairs
from starcat.geometry.attitude import quaternion_from_matrix
from starcat.geometry.camera import Camera
from starcat.pipeline.simulation.simulate import Noise, simulate_frames

ONBOARD = Path(__file__).parents[2] / "onboard"
README = (ONBOARD / "README.md").read_text(encoding="utf-8")
PAGE = (ONBOARD.parent / "docs" / "onboard.md").read_text(encoding="utf-8")
LIBM = {"sqrt", "sin", "cos", "atan2", "log"}
COMPILERS_OWN = {"memcpy", "memmove", "memset", "_GLOBAL_OFFSET_TABLE_", "__stack_chk_fail"}
"""What compilers call by themselves."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    copy = tmp_path_factory.mktemp("vendored") / "onboard"
    shutil.copytree(ONBOARD, copy, ignore=shutil.ignore_patterns("build", "target"))
    return copy


def make(folder: Path, *arguments: str, **environment: str) -> str:
    """Run make in the folder; skip if a tool that the target needs is missing."""
    if shutil.which("make") is None:
        pytest.skip("make is missing")
    if "example" in arguments:  # the targets without a list of the tools that they need
        arguments = *arguments, f"CC={c_compiler()}"
    # The targets find their own compilers; what builds the wheel is not theirs.
    kept = {name: text for name, text in os.environ.items() if name not in ("CC", "CFLAGS")}
    command = ["make", "--no-print-directory", "-s", *arguments]
    ran = subprocess.run(
        command, cwd=folder, env=kept | environment, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stdout[-3000:] + ran.stderr[-3000:]
    skipped = [line for line in ran.stdout.splitlines() if "skipped" in line]
    if skipped:
        pytest.skip("; ".join(skipped))
    return ran.stdout


def build(folder: Path, name: str, *sources: str, flags: tuple[str, ...] = ()) -> Path:
    """Compile a program of the folder's tests with the library."""
    program = folder / name
    every = [*folder.glob("src/*.c"), *(folder / "tests" / source for source in sources)]
    command = [c_compiler(), "-std=c99", "-O2", *flags, f"-I{folder / 'include'}", *every]
    subprocess.run([*command, "-lm", "-o", program], check=True)
    return program


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory, random_directions) -> dict[str, Path]:
    """An image of pairs in both byte orders, and frames of it as the C programs read them."""
    camera, folder = Camera(1024, 1024, fov_x_deg=40.0), tmp_path_factory.mktemp("images")
    u, mag = random_directions(300, 4), np.random.default_rng(4).uniform(2.0, 6.0, 300)
    pairs = find_pairs(u, 0.0, longest_pair_rad(camera))
    rows = np.stack([pairs.i, pairs.j], axis=-1)
    contents = Contents("sky-1.0.0", 2026.0, camera, np.arange(1, 301), u, mag, "pyramid", rows)
    paths = {order: folder / f"{order}.img" for order in ("little", "big")}
    for order, path in paths.items():
        path.write_bytes(make_image(contents, order).data)
    lines = []
    for frame in simulate_frames(u, camera, 100, Noise(0.4, 0.1, 3), 5, mag):
        q = quaternion_from_matrix(frame.matrix)
        lines.append(f"{len(frame.centroids_px)} " + " ".join(float(x).hex() for x in q))
        spots = np.column_stack([frame.centroids_px, frame.mag])
        lines += [" ".join(float(x).hex() for x in spot) for spot in spots]
    paths["frames"] = folder / "frames.txt"
    paths["frames"].write_text("\n".join(lines) + "\n")
    return paths


@pytest.mark.timeout(300)
@pytest.mark.slow
@pytest.mark.parametrize("cc", ["gcc", "clang"])
def test_the_unit_test_passes_where_the_folder_stands_alone(folder, cc):
    if shutil.which(cc) is None:
        pytest.skip(f"{cc} is missing")
    said = make(folder, "test", f"COMPILERS={cc}", "CFLAGS=-O1", f"BUILD=build-{cc}")
    assert re.findall(r"(\d+) checks, 0 failed", said)
    assert said.count(" 0 failed") == 2  # in double and in single precision


@pytest.mark.slow
def test_the_example_prints_the_attitude(folder):
    said = make(folder, "all", "example")
    assert "status 0 after" in said
    assert re.search(r"^attitude( -?0\.\d{9},?){4}", said, re.MULTILINE)


DRIVER = Path(__file__).with_name("crowded_frames.c")


@pytest.mark.slow
def test_the_code_of_the_page_compiles_and_identifies_crowded_frames(folder, made, tmp_path):
    example, *others = re.findall(r"```c\n(.*?)```", PAGE, re.DOTALL)
    strict = [c_compiler(), "-std=c99", "-O2", "-Wall", "-Wextra", "-Werror", f"-I{tmp_path}"]
    strict.append(f"-I{folder / 'include'}")
    (tmp_path / "example.c").write_text(example)
    (tmp_path / "others.c").write_text("\n".join(others))
    for precision in ((), ("-DSTARCAT_SINGLE",)):
        for name in ("example.c", "others.c"):
            command = [*strict, *precision, "-c", tmp_path / name, "-o", tmp_path / "made.o"]
            subprocess.run(command, check=True)
    sources = sorted((folder / "src").glob("*.c"))
    program = tmp_path / "driver"
    subprocess.run([*strict, DRIVER, *sources, "-lm", "-o", program], check=True)
    command = [program, made["little"], made["frames"]]
    ran = subprocess.run(command, capture_output=True, text=True, check=True)
    found, kept = map(int, re.findall(r"\d+", ran.stdout))
    assert (found >= 95, kept) == (True, 64), ran.stdout


def undefined(folder: Path, *flags: str) -> set[str]:
    """Return the functions that the library calls but does not define, without compilers' own."""
    defined, called = set(), set()
    options = ["-std=c99", "-Os", "-ffreestanding", *flags, f"-I{folder / 'include'}"]
    files = sorted((folder / "src").glob("*.c"))
    # Freestanding: otherwise gcc replaces a sine and a cosine by one call to sincos.
    subprocess.run([c_compiler(), *options, "-c", *files], cwd=folder, check=True)
    for file in files:
        target = folder / f"{file.stem}.o"
        said = subprocess.run(["nm", target], capture_output=True, text=True, check=True).stdout
        for line in said.splitlines():
            kind, name = line.split()[-2:]
            (called if kind == "U" else defined).add(name)
    return called - defined - COMPILERS_OWN


@pytest.mark.slow
def test_the_library_calls_nothing_but_five_functions_of_libm(folder):
    if shutil.which("nm") is None:
        pytest.skip("nm is missing")
    assert undefined(folder) == LIBM
    assert undefined(folder, "-DSTARCAT_SINGLE") == {f"{name}f" for name in LIBM}


@pytest.mark.slow
def test_the_functions_of_libm_can_be_replaced(folder, tmp_path):
    if shutil.which("nm") is None:
        pytest.skip("nm is missing")
    names = sorted(LIBM)
    takes = {name: "double, double" if name == "atan2" else "double" for name in names}
    lines = [f"double my_{name}({arguments});\n" for name, arguments in takes.items()]
    (tmp_path / "mine.h").write_text("".join(lines))
    flags = [f"-DSTARCAT_{name.upper()}=my_{name}" for name in names]
    found = undefined(folder, '-DSTARCAT_MATH_HEADER="mine.h"', f"-I{tmp_path}", *flags)
    assert found == {f"my_{name}" for name in names}


@pytest.mark.slow
def test_no_flipped_bit_goes_unseen(folder, made):
    program = build(folder, "flips", "flips.c", "random_sky.c")
    ran = subprocess.run([program, made["little"], "10000"], capture_output=True, text=True)
    assert ran.stdout == "10000 flips, 0 missed\n", ran.stderr


@pytest.mark.slow
def test_an_image_of_the_other_byte_order_is_refused(folder, made):
    program = build(folder, "replay", "replay.c")
    ran = subprocess.run([program, made["big"], made["frames"]], capture_output=True, text=True)
    assert (ran.returncode, ran.stderr) == (2, "cannot open: -5\n")
    ran = subprocess.run([program, made["little"], made["frames"]], capture_output=True, text=True)
    lines = ran.stdout.splitlines()
    assert len(lines) == 100
    assert sum(line.startswith("0 ") for line in lines) >= 95


def rows(heading: str) -> list[list[str]]:
    """Return the rows of the first table below a heading of the README."""
    part = README.split(f"\n## {heading}\n")[1]
    table = re.search(r"(?:^\|.*\|\n)+", part, re.MULTILINE)
    assert table is not None
    return [
        [cell.strip() for cell in line.strip("|").split("|")] for line in table[0].splitlines()[2:]
    ]


def test_every_status_is_in_the_table_and_reached_by_the_test_that_it_names():
    header = (ONBOARD / "include" / "starcat.h").read_text()
    declared = "".join(path.read_text() for path in ONBOARD.glob("include/*.h"))
    enum = header[header.index("typedef enum") : header.index("} starcat_status")]
    sources = {path.name: path.read_text() for path in ONBOARD.glob("tests/test_*.c")}
    named = set()
    for code, number, functions, _, tests in rows("What a call comes to"):
        name = code.strip("`")
        assert re.search(rf"\b{name} = {number}\b", enum)
        for file, function in re.findall(r"`([^`]+)` `([^`]+)`", tests):
            parts = re.split(rf"^(?:static )?void {function}\(", sources[file], flags=re.MULTILINE)
            assert len(parts) == 2, f"{file} has no {function}"
            assert name in parts[1].split("\n}\n")[0], f"{function} does not reach {name}"
        assert tests
        for called in re.findall(r"`(\w+)`", functions):
            assert f"starcat_{called}(" in declared
        named.add(name)
    assert named == set(re.findall(r"STARCAT_\w+(?= = )", enum))


def functions_of_headers() -> dict[str, tuple[str, list[str]]]:
    """Return the type and the parameters of each function that the headers declare."""
    text = "".join(path.read_text() for path in sorted(ONBOARD.glob("include/starcat*.h")))
    found = re.findall(r"^([a-z]\w*(?: \w+)*) \*?(starcat_\w+)\(([^;]*)\);", text, re.MULTILINE)
    return {name: (kind, parameters.split(",")) for kind, name, parameters in found}


def test_every_function_refuses_null_pointers(folder, tmp_path):
    """Every function of every header that takes a pointer; each is called with zeros."""
    functions = functions_of_headers()
    taking = [
        name
        for name, (_, parameters) in functions.items()
        if any("*" in parameter or "[" in parameter for parameter in parameters)
    ]
    assert set(functions) - set(taking) == {
        "starcat_version",
        "starcat_version_number",
        "starcat_count_parity_bytes",
    }
    assert len(taking) >= 40
    lines = ['#include <stdio.h>\n#include "starcat_session.h"', "int main(void) {"]
    for name in taking:
        kind, parameters = functions[name]
        assert kind == "starcat_status", name
        zeros = ", ".join("0" for _ in parameters)
        lines.append(f'  if ({name}({zeros}) != STARCAT_E_NULL) (void)puts("{name}");')
    source = tmp_path / "nulls.c"
    source.write_text("\n".join([*lines, "  return 0;", "}", ""]), encoding="utf-8")
    program = build(folder, "nulls", str(source), flags=("-O0",))
    ran = subprocess.run([program], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stdout) == (0, "")


COMMENTED = {".c", ".h", ".hpp", ".cpp", ".ads", ".adb", ".rs", ".py", ".sh", ".S", ".ld", ".awk"}


def test_every_source_names_its_licence():
    missing = [
        str(path.relative_to(ONBOARD))
        for path in sorted(ONBOARD.rglob("*"))
        if path.suffix in COMMENTED
        and not {"build", "target"} & set(path.relative_to(ONBOARD).parts)
        and "SPDX-License-Identifier: MIT" not in path.read_text(encoding="utf-8")
    ]
    assert missing == []
    licence = (ONBOARD / "LICENSE").read_text(encoding="utf-8")
    assert licence.startswith("MIT License")


@pytest.mark.slow
def test_callers_of_other_configurations_do_not_link(folder):
    said = make(folder, "misuse", "CFLAGS=-O0", "BUILD=build-misuse")
    assert "3 callers of other configurations do not link, 5 flags do not compile" in said


@pytest.mark.slow
def test_no_file_calls_back_into_one_that_needs_it(folder, tmp_path):
    assert "none leads back" in make(folder, "cycles", "BUILD=build-cycles")
    copy = tmp_path / "onboard"
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("build*"))
    with (copy / "src" / "budget.c").open("a", encoding="utf-8") as file:
        file.write("int back(starcat_call *call) { return starcat_try_attitude(call, 0, 1); }\n")
    ran = subprocess.run(["make", "-s", "cycles"], cwd=copy, capture_output=True, text=True)
    assert ran.returncode != 0
    assert "need each other in a circle" in ran.stdout


def test_every_deviation_from_misra_is_explained():
    text = (ONBOARD / "tests" / "cppcheck.txt").read_text()
    suppressed = re.findall(r"^misra-c2012-(\S+)|^(\w+):", text, re.MULTILINE)
    records = rows("MISRA C:2012")
    assert {a or b for a, b in suppressed} == {row[0].strip("`") for row in records}
    assert all(len(row) == 5 and all(row) for row in records)


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "target",
    [
        *("hostile", "sanitize", "valgrind", "coverage", "cppcheck", "misra", "size"),
        *("test-amalgamation", "test-install", "test-cpp", "test-rust"),
        "microcontroller",
    ],
)
def test_tools_find_nothing(folder, target):
    said = make(folder, target, f"BUILD=build-{target}")
    if target == "coverage":
        assert "(100.00 %)" in said
    if target == "size":
        assert len(re.findall(r"stack of starcat_\w+: \d+ bytes", said)) == 6


def test_every_requirement_has_its_tests(folder, tmp_path):
    """And every function of the unit test a requirement; the bill of materials has every file."""
    matrix = [sys.executable, "-B", "qualification/evidence/matrix.py", str(tmp_path)]
    said = subprocess.run(matrix, cwd=ONBOARD, capture_output=True, text=True, check=True).stdout
    assert said.rstrip().endswith(" 0 missing")
    test = folder / "tests" / "test_unnamed.c"
    test.write_text("static void check_unnamed(void) {\n}\n", encoding="utf-8")
    ran = subprocess.run(matrix, cwd=folder, capture_output=True, text=True, check=False)
    bills = []
    for name in ("with.json", "again.json", "without.json"):
        if name == "without.json":
            test.unlink()
        bill = [sys.executable, "-B", "qualification/evidence/sbom.py", str(tmp_path / name)]
        subprocess.run(bill, cwd=folder, capture_output=True, check=True)
        bills.append((tmp_path / name).read_bytes())
    assert ran.returncode == 1
    assert "test_unnamed.c check_unnamed: named by no requirement" in ran.stdout
    assert bills[0] == bills[1]
    assert b"./tests/test_unnamed.c" in bills[0]
    assert b"./tests/test_unnamed.c" not in bills[2]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_evidence_is_complete(folder):
    said = make(folder, "evidence", "SEU_FLIPS=40000", "BUILD=build-evidence")
    assert "0 wrong, 0 crash" in said
    assert re.findall(r"^\w.*?  +(pass|fail)  ", said, re.MULTILINE) == ["pass"] * 11
    assert (folder / "build-evidence" / "evidence" / "index.html").exists()


def test_every_loop_has_its_longest_count(folder, tmp_path):
    """``loops.txt`` has every loop; one that is added to the source is named."""
    compare = [sys.executable, "-B", "qualification/wcet/loops.py"]
    said = subprocess.run(compare, cwd=folder, capture_output=True, text=True, check=True).stdout
    assert re.match(r"loops.txt has all \d+ loops of the library", said)
    copy = tmp_path / "onboard"
    for name in ("src", "qualification"):
        shutil.copytree(folder / name, copy / name)
    source = copy / "src" / "sky.c"
    text = source.read_text(encoding="utf-8")
    added = text.replace("  query->count = count;\n", "  while (count > 9u) {\n  }\n")
    assert added != text
    source.write_text(added, encoding="utf-8")
    ran = subprocess.run(compare, cwd=copy, capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    assert ran.stdout == "not in loops.txt: sky.c gather_sectors while (count > 9u)\n"


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_no_call_takes_longer_than_its_bound(folder):
    said = make(folder, "wcet", "WCET_FRAMES=400", "BUILD=build-wcet")
    assert "Cortex-M7" in said
    assert "RISC-V" in said
    assert said.count("440 frames, 0 beyond the bound") == 2
    assert "wcet: no call beyond the bound" in said


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_other_processors_give_the_same_answers(folder, made):
    """32-bit ARM, and big-endian PowerPC with an image that Python wrote for it."""
    of_c = make(folder, "cross", "BUILD=build-cross")
    images = f"{made['little']} {made['big']}"
    given = {"IMAGES": images, "FRAMES": str(made["frames"])}
    of_python = make(folder, "cross", "BUILD=build-cross-images", **given)
    assert of_c.count("every answer the same") == 8
    assert of_python.count("100 frames, every answer the same") == 4


@pytest.mark.slow
@pytest.mark.timeout(120)
@pytest.mark.parametrize("target", ["fuzz-image", "fuzz-centroids"])
def test_fuzzing_finds_nothing(folder, target):
    make(folder, target, "FUZZ_SECONDS=5", f"BUILD=build-{target}")


def test_a_session_survives_operations_in_random_order(folder):
    said = make(folder, "fuzz-session", "SESSION_OPERATIONS=10000", "BUILD=build-session")
    assert "10000 operations" in said
    assert "0 violations" in said


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_session_survives_a_minute_of_operations(folder):
    said = make(folder, "fuzz-session", "SESSION_OPERATIONS=500000", "SESSION_SEED=2")
    assert "0 violations" in said


def test_a_mission_loads_tracks_uploads_refuses_recovers_and_restarts(folder):
    said = make(folder, "example", "CFLAGS=-O0", "BUILD=build-example")
    phases = re.findall(r"^\w.*?  +(yes|NO)$", said, re.MULTILINE)
    assert phases == ["yes"] * 18, said
