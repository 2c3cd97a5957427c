"""One small event for long work: which stage, how much is done, how much there is.

Library code calls a ``Progress`` callback; the command line draws bars from it, a test
can count it. The default does nothing.
"""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int | None], None]
"""Called with (stage, done, total); ``total`` is None where it is not known.

A stage whose name begins with one of `BYTE_STAGES` and that knows its total counts bytes; others
count what they work on.
"""

BYTE_STAGES = ("fetch", "publish", "pull", "read")

ROW_STAGE = "rows"
"""First word of the stages that count rows of a catalog, where people ask how fast it goes."""


def no_progress(stage: str, done: int, total: int | None) -> None:
    """Ignore the event: the default of every function that reports progress."""
