"""Messages in the words of a page: a parameter has the label of its field, or is not named."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from starcat.errors import words_of
from starcat.matcher import OPTIONS, bracketed
from starcat_service.problems import ProblemDetails, problem_of

WORDED = (
    "method", "fov_error", "fov_deg", "size_px", "flip", "camera", "time", "time_limit_s",
)  # fmt: skip
"""Options of an identification that a page states in its own way, or that the service sets."""

OPTION_FIELDS = {name: option for name, option in OPTIONS.items() if name not in WORDED}
"""Options of an identification that have a field with their name."""

LABELS = {
    **{name: f"“{option.label}”" for name, option in OPTION_FIELDS.items()},
    "camera": "“Another camera”",
    "fov_deg": "the field of view",
    "fov_error": "“Error of the field”",
    "flip": "“y counts up”",
    "keep_out_deg": "“Keep-out angles”",
    "method": "“Method”",
    "orbit": "“Orbit”",
    "size_px": "the width and height",
    "time": "“Time of the frame”",
}
"""Parameters that have a field on a page, and the label of the field."""

_ITEM = re.compile(r'values\["(\w+)"\]')
_NAMELESS = "\0"
_CLAUSE = re.compile(r"(; |, (?:or |and )?|\. (?=[A-Z]))(?![^()]*\))")


def in_page_words(text: str, fields: Iterable[str] = ()) -> str:
    """Return a message in which parameters have the labels of a page.

    A clause about a parameter without a field on the pages is left out: its advice cannot be
    followed there.

    Examples
    --------
    >>> in_page_words("the frame is mirrored; use flip", ["flip"])
    'the frame is mirrored; use “y counts up”'
    >>> in_page_words("a.tar is too large; allow more with max_bytes", ["max_bytes"])
    'a.tar is too large'
    """
    names = list(fields)
    marked = words_of(text, names, _label_of)
    if _NAMELESS not in marked:
        return marked
    parts = _CLAUSE.split(marked)
    kept = [
        (before, part)
        for before, part in zip(["", *parts[1::2]], parts[::2], strict=True)
        if _NAMELESS not in part
    ]
    if not kept:
        return text
    return kept[0][1] + "".join(before + part for before, part in kept[1:])


def option_hints() -> dict[str, str]:
    """Return the descriptions of the options of an identification, with the labels of the page."""
    others = [name for name in OPTIONS if "_" in name]
    return {name: in_page_words(option.description, others) for name, option in OPTIONS.items()}


def _label_of(field: str) -> str:
    if item := _ITEM.fullmatch(field):
        return f"the field “{item[1]}”"
    return LABELS.get(re.split(r"[=\[]", field)[0], _NAMELESS)


def advice_in_page_words(text: str) -> str:
    """Return the advice for a frame that was not identified, with the labels of a page."""
    return in_page_words(text, bracketed(text))


def problem_in_page_words(problem: ProblemDetails | Mapping[str, Any]) -> str:
    """Return the detail of problem details, also of the problem details stored with a job."""
    found = problem.model_dump() if isinstance(problem, ProblemDetails) else problem
    return in_page_words(str(found.get("detail") or ""), found.get("fields") or ())


def page_problem(error: Exception) -> ProblemDetails:
    """Return the problem details that a page shows for any exception."""
    problem = problem_of(error)
    return problem.model_copy(update={"detail": problem_in_page_words(problem), "fields": None})
