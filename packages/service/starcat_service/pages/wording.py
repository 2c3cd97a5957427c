"""Messages in the words of a page: a parameter has the label of its field, or is not named."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

from starcat.errors import advice_in_words, error_from_fields
from starcat.matcher import OPTIONS
from starcat_service.problems import ProblemDetails, problem_of

WORDED = (
    "method", "fov_error", "fov_deg", "size_px", "flip", "camera", "time", "time_limit_s",
)  # fmt: skip
"""Options of an identification that a page states in its own way, or that the service sets."""

OPTION_FIELDS = {name: option for name, option in OPTIONS.items() if name not in WORDED}
"""Options of an identification that have a field with their name."""

_COUNTS = Counter(option.label for option in OPTION_FIELDS.values())

LABELS = {
    **{
        name: f"“{option.label}” in {option.unit}"
        if _COUNTS[option.label] > 1
        else f"“{option.label}”"
        for name, option in OPTION_FIELDS.items()
    },
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
"""Parameters with a field on a page, and the label of the field; with its unit if two share it."""


def label_of(parameter: str, value: str = "", item: str = "") -> str | None:
    """Return the label of the field for a parameter, or None if no page has such a field.

    A part of a hint about a parameter without a field is left out: it cannot be followed.

    Examples
    --------
    >>> label_of("flip"), label_of("max_bytes"), label_of("values", item="mag")
    ('“y counts up”', None, 'the field “mag”')
    >>> label_of("noise_px"), label_of("threshold", "8")
    ('“Noise” in px', '“Threshold” 8')
    """
    if item:
        return f"the field “{item}”" if parameter == "values" else None
    label = LABELS.get(parameter)
    return label if label is None or value in ("", "True") else f"{label} {value}"


def option_hints() -> dict[str, str]:
    """Return the descriptions of the options of an identification, with the labels of the page."""
    return {name: option.described(label_of) for name, option in OPTIONS.items()}


def advice_in_page_words(advice: Sequence[str]) -> str:
    """Return the advice for a frame that was not identified, with the labels of a page.

    Examples
    --------
    >>> advice_in_page_words(["turn the frame over ({flip})", "allow more time ({time_limit_s})"])
    'turn the frame over (“y counts up”)'
    """
    return advice_in_words(advice, label_of)


def problem_in_page_words(problem: ProblemDetails | Mapping[str, Any]) -> str:
    """Return the detail of problem details, also of the problem details stored with a job."""
    fields = problem.model_dump() if isinstance(problem, ProblemDetails) else problem
    error = error_from_fields({**fields, "kind": "StarcatError"}) if fields.get("problem") else None
    return str(fields.get("detail") or "") if error is None else error.message(label_of)


def page_problem(error: Exception) -> ProblemDetails:
    """Return the problem details that a page shows for any exception."""
    problem = problem_of(error)
    return problem.model_copy(update={"detail": problem_in_page_words(problem), "problem": None})
