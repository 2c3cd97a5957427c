"""Messages of the library that a command prints: those about work that is done only once."""

from __future__ import annotations

import logging
import sys

PRINTED = ("starcat.matcher.search_tables", "starcat.storage.cache")
"""Modules whose messages are printed."""


class _StandardError(logging.Handler):
    """Prints messages on stderr, above progress bars."""

    def emit(self, record: logging.LogRecord) -> None:
        sys.stderr.write(record.getMessage() + "\n")


_PRINTER = _StandardError()


def print_messages() -> None:
    """Print messages of the modules `PRINTED` from now on."""
    for name in PRINTED:
        logger = logging.getLogger(name)
        logger.setLevel(logging.INFO)
        logger.addHandler(_PRINTER)
