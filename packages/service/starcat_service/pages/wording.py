"""Messages in the words of a page: what the command line calls by an option has a field here."""

from __future__ import annotations

import re

from starcat_service.problems import ProblemDetails, problem_of

_PHRASES = (
    (
        r"Name it with --input (\w+)=PATH, set \S+ to [^;]*?, or run 'starcat fetch \w+'",
        r"Whoever runs this service gets it with 'starcat fetch \1'",
    ),
    (r"with --camera\b", "under “Another camera”"),
    (r"with --plane\b", "before it is sent"),
    (r"give its value with --set \w+=VALUE", "give its value in the field of that name"),
    (r"'starcat sql --macros' lists", "the list beside the query tells"),
    (r"'starcat sql --list' shows", "the list beside the query shows"),
    (r"(?<!\w)-o writes", "“Download all rows” writes"),
    (r"'starcat crossmatch'", "The command crossmatch"),
    (r"with --scheduler\b", "by the operator"),
    (r" \(--[a-z][^)]*\)", ""),
    (r"\(fov_error\)", "(“Error of the field”)"),
    (r"\(flip\)", "(“y counts up”)"),
    (r"a larger error of the prior \([a-z_]+\)", "a larger error of the prior"),
    (r", state their noise \([a-z_, ]+\) in place of a tolerance", ""),
    (r", or ask for a smaller share \([a-z_]+\)", ""),
    (r"--fov-error\b", "“Error of the field”"),
    (r"--tolerance-px\b", "“Tolerance”"),
    (r"--flip\b", "“y counts up”"),
    (r"--method\b", "“Method”"),
    (r"--camera\b", "“Another camera”"),
    (r"--fov\b", "the field of view"),
    (r"--time\b", "the time"),
    (r"--size\b", "width and height"),
)
"""Phrases of the command line, and what they are on a page."""

_OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
_ENDS = re.compile(r"(; |\. (?=[A-Z]))")


def in_page_words(text: str) -> str:
    """Return a message without options of the command line; advice that is only one is left out.

    Examples
    --------
    >>> in_page_words("the frame is mirrored; use --flip")
    'the frame is mirrored; use “y counts up”'
    >>> in_page_words("a.tar is too large; allow more with --max-bytes")
    'a.tar is too large'
    """
    for phrase, words in _PHRASES:
        text = re.sub(phrase, words, text)
    if not _OPTION.search(text):
        return text
    parts = _ENDS.split(text)
    kept = [
        (part, end)
        for part, end in zip(parts[::2], [*parts[1::2], ""], strict=True)
        if not _OPTION.search(part)
    ]
    if not kept:
        return _OPTION.sub("that option", text)
    return "".join(part + end for part, end in kept).rstrip("; ")


def page_problem(error: Exception) -> ProblemDetails:
    """Return what a page says of any exception."""
    problem = problem_of(error)
    return problem.model_copy(update={"detail": in_page_words(problem.detail)})
