"""The message of a failed command: one line of text, or of JSON, and an exit code.

Every exception that reaches the command line becomes a message here and nowhere else. The
exceptions of `starcat.errors` carry their message. Any other exception is a defect of starcat, and
the message calls it a defect.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple, Protocol

from typer import Abort, TyperException

from starcat.errors import NameOf, StarcatError, python_name, reason
from starcat.version import install_command, missing_packages

DEFECT = 70
"""Exit code of a defect of starcat: EX_SOFTWARE, the internal error of BSD's exit codes."""

AT_STAGE = "at stage: "
"""Beginning of the note that progress bars add to an exception that passes through them."""

MAX_MESSAGE, MAX_FOREIGN = 2000, 400
"""Characters shown of a long message: by starcat, and by a library."""


@dataclass(frozen=True)
class Failure:
    """Why a command ended without a result."""

    code: int  # exit code
    kind: str  # name of the exception's class
    message: str  # the finding, its place, and what to do
    hint: str | None = None  # the part of the message with what to do

    def as_text(self) -> str:
        """Return the message for people."""
        return f"starcat: error: {self.message}\n"

    def as_json(self) -> str:
        """Return the message for programs."""
        return json.dumps({"error": asdict(self)}, ensure_ascii=False) + "\n"


def failure_of(error: Exception, doing: str, name_of: NameOf = python_name) -> Failure:
    """Return the message and the exit code for an exception.

    ``doing`` is the command that ended. ``name_of`` returns the name of a parameter in the
    interface.
    """
    if isinstance(error, Abort) and isinstance(error.__cause__, Exception):
        error = error.__cause__  # a library's EOFError, which typer mistakes for Ctrl-D
    kind = type(error).__name__
    if isinstance(error, StarcatError):
        message = shown(error.message(name_of), MAX_MESSAGE)
        hint = shown(error.advice_for(name_of), MAX_MESSAGE)
        return Failure(error.exit_code, kind, message, hint or None)
    if isinstance(error, TyperException):
        _put_plainly(error)
        return Failure(
            error.exit_code, kind, shown(error.format_message(), MAX_MESSAGE), _usage(error)
        )
    if isinstance(error, ModuleNotFoundError) and _is_outsider(error.name):
        return Failure(2, kind, missing_packages(doing, error), install_command())
    if isinstance(error, MemoryError):
        hint = "ask for less at a time, or use a machine with more memory"
        text = f"out of memory{_in_brackets(error)} while '{doing}' ran{_stage_of(error)}; {hint}"
        return Failure(1, kind, text, hint)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return Failure(1, kind, shown(f"{where}{reason(error)}", MAX_MESSAGE))
    hint = "run again with --debug for the traceback, and report it"
    text = shown(str(error), MAX_FOREIGN) or "no message"
    what = f"this is a defect of starcat: '{doing}'{_stage_of(error)} ended with {kind}: {text}"
    return Failure(DEFECT, kind, f"{what}; {hint}", hint)


def _is_outsider(name: str | None) -> bool:
    return name is not None and name.partition(".")[0] != "starcat"


class ValidationFailure(Protocol):
    """An exception of pydantic or FastAPI."""

    def errors(self) -> Sequence[Mapping[str, Any]]:
        """Return the errors, each with ``loc``, ``msg``, ``type`` and ``input``."""


class Invalid(NamedTuple):
    """The first error that pydantic found."""

    key: str
    """Dotted key of the value; empty for the value as a whole."""
    message: str


def validation_message(error: ValidationFailure, *, show_input: bool = False) -> Invalid:
    """Return the first error of pydantic in words; ``show_input`` adds the value it found."""
    first = error.errors()[0]
    key = ".".join(str(step)[:100] for step in first["loc"][:10])
    found = show_input and first["type"] not in ("missing", "json_invalid")
    value = f" (found {str(first['input'])[:80]!r})" if found else ""
    return Invalid(key, expected_words(first) + value)


_EXPECTED = {
    "greater_than_equal": "at least {ge:,}",
    "greater_than": "more than {gt:,}",
    "less_than_equal": "at most {le:,}",
    "less_than": "less than {lt:,}",
    "string_type": "a text in quotes",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "int_parsing_size": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "model_type": "a table",
    "dataclass_type": "a table",
    "model_attributes_type": "a table",
    "dict_type": "a table",
    "tuple_type": "a list",
    "list_type": "a list",
    "literal_error": "{expected}",
    "enum": "{expected}",
    "finite_number": "a finite number",
    "string_too_long": "at most {max_length:,} characters",
    "string_too_short": "a text of {min_length:,} or more characters",
    "too_long": "a list of at most {max_length:,}",
    "too_short": "a list of at least {min_length:,}",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
}


def expected_words(error: Mapping[str, Any]) -> str:
    """Return the expectation that a value which pydantic refused does not meet.

    Examples
    --------
    >>> expected_words({"type": "less_than", "msg": "...", "ctx": {"lt": 120.0}})
    'expected less than 120'
    >>> expected_words({"type": "literal_error", "ctx": {"expected": "'csv' or 'fits'"}})
    "expected 'csv' or 'fits'"
    """
    kind, context = error["type"], error.get("ctx", {})
    if kind == "missing":
        return "missing"
    if kind == "unexpected_keyword_argument":
        return "there is no such key"
    if kind == "string_pattern_mismatch":
        from starcat.sections import PATTERN_WORDS

        words: str = PATTERN_WORDS.get(context["pattern"], "other characters")
        return f"expected {words}"
    if kind in _EXPECTED:
        return f"expected {_EXPECTED[kind].format(**context)}".removesuffix(".0")
    return str(context["error"] if kind == "value_error" and context else error["msg"])


def shown(text: str, most: int) -> str:
    """Return a text that is safe to print on a terminal, cut in the middle if it is too long.

    Examples
    --------
    >>> shown("a" * 50 + "b" * 50, 11)
    'aaaaa…bbbbb'
    """
    if len(text) > most:
        half = (most - 1) // 2
        text = f"{text[:half]}…{text[-half:]}"
    return "".join(
        c
        if c.isprintable() or c == "\n"
        else " "
        if c == "\t"
        else c.encode("unicode_escape").decode()
        for c in text
    )


def _put_plainly(error: TyperException) -> None:
    """Reword a usage error: the value that was typed, and the value that was expected."""
    errors = getattr(error.__cause__, "errors", None)
    if errors is not None:
        first = errors()[0]
        error.message = f"found {str(first['input'])[:80]!r}; {expected_words(first)}"


def _usage(error: TyperException) -> str | None:
    context = getattr(error, "ctx", None)
    return f"Try '{context.command_path} --help' for help." if context else None


def _stage_of(error: Exception) -> str:
    """Return the stage that an exception was raised in, where progress bars noted one."""
    notes = [str(note) for note in getattr(error, "__notes__", [])]
    stages = [note.removeprefix(AT_STAGE) for note in notes if note.startswith(AT_STAGE)]
    return f" at '{shown(stages[0], 80)}'" if stages else ""


def _in_brackets(error: Exception) -> str:
    text = shown(str(error), MAX_FOREIGN)
    return f" ({text})" if text else ""
