"""Ctrl-C and termination: a command ends with the exit code of its signal, and says what is left.

The exception that a signal raises is lost where Python ignores exceptions, in a finaliser for
example. The signal is remembered, and the next report of progress raises it again.
"""

from __future__ import annotations

import signal
from typing import Any

_received: list[int] = []

LEFT = {
    "evaluate": "finished trials are kept, and the same command goes on with them",
    "fetch": "the same command goes on with what has arrived",
    "ingest": "nothing is left, but finished parts of --to hats, with which --resume goes on",
}
"""What a command leaves when it is interrupted; others leave nothing."""


def catch_signals() -> None:
    """Let SIGINT and SIGTERM end the command by exceptions, which clean up."""
    _received.clear()
    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)


def stop(number: int, frame: Any) -> None:
    """Handle a signal."""
    _received.append(number)
    _raise(number)


def check_interrupt() -> None:
    """Raise the exception of a signal that has come and was lost."""
    if _received:
        _raise(_received[0])


def forget() -> None:
    """Forget signals: what they interrupted has ended, and the command goes on."""
    _received.clear()


def _raise(number: int) -> None:
    raise KeyboardInterrupt if number == signal.SIGINT else SystemExit(128 + number)


def left_by(command: str) -> str:
    """Return what to say of an interrupted command."""
    return f"starcat: interrupted; {LEFT.get(command, 'nothing is left of an unfinished output')}\n"
