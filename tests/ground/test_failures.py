"""What a failing command says: one place, one language, for people and for programs."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pyarrow as pa
import pytest

from starcat.cli.console import progress_bars
from starcat.cli.options import option_of
from starcat.errors import ConfigError, SourceMissing
from starcat.failures import DEFECT, MAX_MESSAGE, failure_of
from starcat.pipeline import finish
from starcat.version import install_command

Run = Callable[[list[Any]], Any]


@pytest.fixture
def breaking(monkeypatch: pytest.MonkeyPatch) -> Callable[[BaseException], None]:
    """Let ``starcat sources``, which needs nothing, end with an exception."""

    def set_up(error: BaseException) -> None:
        def broken(*_: object, **__: object) -> None:
            raise error

        monkeypatch.setattr("starcat.cli.catalogs.source_facts", broken)

    return set_up


def error_of(text: str) -> dict[str, Any]:
    """The JSON object in the last line of stderr."""
    content = json.loads(text.splitlines()[-1])
    assert list(content) == ["error"]
    assert list(content["error"]) == ["code", "kind", "message", "hint"]
    return dict(content["error"])


# Errors under --json ------------------------------------------------------------------------


def test_an_error_under_json_is_an_object(starcat, tmp_path):
    run = starcat(["inspect", tmp_path / "none-1.0.0", "--json"])
    error = error_of(run.err)
    assert (run.code, run.out, run.err.count("\n")) == (3, "", 1)
    assert (error["code"], error["kind"]) == (3, "DatabaseMissing")
    assert "none-1.0.0: no such database" in error["message"]
    assert error["hint"] == "give the folder <name>-<version> that 'starcat build' made"


@pytest.mark.parametrize(
    ("arguments", "words", "hint"),
    [
        (["build", "--ouput", "x", "--json"], "No such option: --ouput", "build"),
        (["selftest", "x", "--frames", "0", "--json"], "--frames", "selftest"),
        (["inspect", "--json"], "Missing argument", "inspect"),
    ],
)
def test_usage_errors_under_json_are_objects(starcat, arguments, words, hint):
    run = starcat(arguments)
    error = error_of(run.err)
    assert (run.code, run.out, error["code"]) == (2, "", 2)
    assert words in error["message"]
    assert error["hint"] == f"Try 'starcat {hint} --help' for help."


def test_what_stands_behind_two_dashes_is_no_option(starcat):
    run = starcat(["inspect", "--", "--json"])
    assert run.err.startswith("starcat: error: --json: no such database")
    assert starcat(["inspect", "--", "--debug"]).err.startswith("starcat: error: --debug: no such")


def test_a_hint_is_a_field_of_the_error():
    error = ConfigError("limits swapped; a < b", hint=("Check {fov_deg}", "leave it out"))
    failure = failure_of(error, "starcat build", option_of)
    assert failure.hint == "Check --fov, or leave it out"
    assert failure.message == f"limits swapped; a < b. {failure.hint}"
    assert failure_of(ConfigError("limits swapped; a < b"), "starcat build").hint is None


# Defects ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "error",
    [
        *(ValueError("cannot reshape array"), KeyError("stars"), IndexError(), AssertionError()),
        *(pa.ArrowInvalid("Integer value out of bounds"), EOFError("Compressed file ended")),
        RecursionError("maximum recursion depth exceeded"),
    ],
    ids=lambda error: type(error).__name__,
)
def test_an_unforeseen_error_is_called_a_defect(starcat, breaking, error):
    breaking(error)
    run = starcat(["sources"])
    assert (run.code, run.out) == (DEFECT, "") == (70, "")
    said = run.err.lstrip("\n")  # typer ends the line that Ctrl-D, an EOFError too, was typed on
    assert said.startswith("starcat: error: this is a defect of starcat: 'starcat sources' ")
    assert f"{type(error).__name__}: {error or 'no message'}" in run.err
    assert "run again with --debug for the traceback, and report it" in run.err
    assert "Traceback" not in run.err
    told = error_of(starcat(["sources", "--json"]).err)
    assert (told["code"], told["kind"]) == (70, type(error).__name__)
    debug = starcat(["sources", "--debug"])
    assert debug.code == 70
    assert "Traceback (most recent call last)" in debug.err
    assert debug.err.endswith(said)


def test_a_library_that_is_missing_is_named(starcat, breaking):
    breaking(ModuleNotFoundError("No module named 'rich'", name="rich.table"))
    run = starcat(["sources"])
    assert (run.code, run.err) == (
        2,
        "starcat: error: starcat sources needs the library 'rich', which is not installed; "
        f"{install_command()}\n",
    )


def test_a_want_of_memory_is_no_defect(starcat, breaking):
    breaking(MemoryError("Unable to allocate 16.0 TiB"))
    run = starcat(["sources"])
    assert run.code == 1
    assert "out of memory (Unable to allocate 16.0 TiB) while 'starcat sources' ran" in run.err


def test_a_defect_names_the_stage(starcat, monkeypatch, small_spec, sao_file, tmp_path):
    """A build whose self-test fails: no file is left, and the error names the last stage."""
    (tmp_path / "spec.toml").write_text(small_spec)

    def broken(*_: object, **__: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(finish, "run_self_test", broken)
    run = starcat(
        ["build", tmp_path / "spec.toml", "--input", f"sao={sao_file}", "-o", tmp_path / "dist"]
    )
    assert run.code == 70
    assert re.search(r"'starcat build' at 'product \w+' ended with ZeroDivisionError", run.err)
    assert not list((tmp_path / "dist").glob("small*"))


def test_a_message_is_bounded_and_holds_no_control_characters():
    long = failure_of(ValueError("\x1b[31m" + "x" * 20_000), "starcat sql").message
    assert len(long) < 800
    assert "\x1b" not in long
    assert r"\x1b[31mxxx" in long
    foreseen = failure_of(ConfigError("x" * 20_000), "starcat sql").message
    assert len(foreseen) == MAX_MESSAGE - 1


def test_only_the_stage_that_was_reached_is_noted():
    def work(*stages: str) -> None:
        with progress_bars() as progress:
            for stage in stages:
                progress(stage, 0, None)
            raise ValueError("odd")

    for stages, said in ((["read sao", "report"], " at 'report'"), ([], "")):
        with pytest.raises(ValueError, match="odd") as caught:
            work(*stages)
        assert f"'starcat build'{said} ended" in failure_of(caught.value, "starcat build").message


# --debug, signals, pipes --------------------------------------------------------------------


@pytest.mark.parametrize("at", [0, 1, 4])
def test_debug_works_anywhere_on_the_line(starcat, tmp_path, at):
    arguments = ["ingest", "sao", "-o", str(tmp_path / "stars.parquet")]
    arguments.insert(at, "--debug")
    run = starcat(arguments)
    assert run.code == SourceMissing.exit_code
    assert "SourceMissing: sao" in run.err
    assert run.err.splitlines()[-1].startswith("starcat: error: sao")
    arguments.remove("--debug")
    assert "Traceback" not in starcat(arguments).err


def test_help_has_a_short_name(starcat):
    for arguments in ([], ["build"], ["sql"]):
        long, short = starcat([*arguments, "--help"]), starcat([*arguments, "-h"])
        assert (short.code, short.out) == (0, long.out)
        assert "Usage: starcat" in short.out


def test_summaries_are_whole(starcat):
    text = starcat(["--help"]).out.partition("Design a database:")[2]
    assert "..." not in text
    assert "the five papers." in text


def test_the_shell_completes_commands_and_options():
    def completed(words: str, number: int) -> list[str]:
        variables = {"_STARCAT_COMPLETE": "complete_bash", "COMP_WORDS": words}
        environment = {**os.environ, **variables, "COMP_CWORD": str(number)}
        done = subprocess.run(
            [sys.executable, "-m", "starcat"], env=environment, capture_output=True, text=True,
            check=True,
        )  # fmt: skip
        return done.stdout.split()

    assert completed("starcat ver", 1) == ["verify"]
    assert completed("starcat build --pre", 2) == ["--preset"]


def test_ctrl_c_ends_quietly(starcat, breaking):
    breaking(KeyboardInterrupt())
    run = starcat(["sources"])
    assert (run.code, run.out, run.err) == (130, "", "")


def test_a_reader_that_goes_away_is_not_told():
    """Output that is shorter than a buffer is written at the end only."""
    read, write = os.pipe()
    os.close(read)
    run = subprocess.run(
        [sys.executable, "-m", "starcat", "sources"], stdout=write, stderr=subprocess.PIPE,
        check=False,
    )  # fmt: skip
    os.close(write)
    assert (run.returncode, run.stderr) == (1, b"")
