"""Ctrl-C and termination: a command ends with the exit code of its signal and a message.

In some places Python ignores exceptions, for example in a finaliser, so the exception of a signal
can be lost. The signal is therefore recorded, and the next report of progress raises it again.
"""

from __future__ import annotations

import signal
from typing import Any

_received: list[int] = []

LEFT = {
    "evaluate": "finished trials are kept, and the same command continues with them",
    "fetch": "the same command continues the download",
    "ingest": "nothing is left except finished parts of --to hats, with which --resume continues",
}
"""The files that a command leaves when it is interrupted; other commands leave none."""


def catch_signals() -> None:
    """Make SIGINT and SIGTERM raise exceptions, so that the command cleans up."""
    _received.clear()
    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)


def stop(number: int, frame: Any) -> None:
    """Handle a signal."""
    _received.append(number)
    _raise(number)


def check_interrupt() -> None:
    """Raise the exception of a received signal again, in case it was lost."""
    if _received:
        _raise(_received[0])


def forget() -> None:
    """Clear the received signals: the interrupted work has ended, but the command continues."""
    _received.clear()


def _raise(number: int) -> None:
    raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)


def left_by(command: str) -> str:
    """Return the message of an interrupted command."""
    return f"starcat: interrupted; {LEFT.get(command, 'nothing is left of an unfinished output')}\n"
