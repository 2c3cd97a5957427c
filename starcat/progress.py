"""One small event for long work: the stage, the amount done, and the total.

Library code calls a ``Progress`` callback; the command line draws bars from it, a test
can count it. The default does nothing.
"""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int | None], None]
"""Called with (stage, done, total); ``total`` is None if it is unknown.

A stage counts bytes if its name begins with one of `BYTE_STAGES` and its total is known. Other
stages count the items they process.
"""

BYTE_STAGES = ("fetch", "publish", "pull", "read")

ROW_STAGE = "rows"
"""First words of the stages that count rows of a catalog; for these a speed is shown."""


def no_progress(stage: str, done: int, total: int | None) -> None:
    """Ignore the event: the default of every function that reports progress."""
