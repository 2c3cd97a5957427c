"""An answer on its way: made as fast as the query gives it, sent as fast as the client takes it.

What is not taken yet waits in a file. A client that reads slowly, or not at all, keeps no query
from being answered.
"""

from __future__ import annotations

import threading
from collections.abc import Generator, Iterator
from pathlib import Path
from tempfile import TemporaryFile

READ_BYTES = 1 << 18

LOOK_S = 1.0
"""How often a reader that waits looks whether the answer has ended."""


class ClientGone(Exception):  # noqa: N818 - the name reads as the fact
    """Nobody waits for the answer any more."""


class Spool:
    """Parts of an answer, made in a thread of their own."""

    def __init__(
        self, parts: Generator[bytes, None, None], scratch: Path, gone: threading.Event
    ) -> None:
        self._parts = parts
        self._gone = gone
        self._written = 0
        self._is_done = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._file = TemporaryFile(dir=scratch)  # noqa: SIM115 - closed by `close`
        self._thread = threading.Thread(target=self._make, name="tap-answer", daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[bytes]:
        """Give the bytes in order; what failed is raised behind the last that were made."""
        at = 0
        while True:
            with self._changed:
                while self._written == at and not self._is_done:
                    self._changed.wait(LOOK_S)
                if self._written == at:
                    if self._error is not None:
                        raise self._error
                    return
                self._file.seek(at)
                part = self._file.read(min(READ_BYTES, self._written - at))
            at += len(part)
            yield part

    def close(self) -> None:
        """End the making, and forget what was made."""
        self._gone.set()
        self._thread.join()
        self._file.close()

    def _make(self) -> None:
        try:
            for part in self._parts:
                if self._gone.is_set():
                    break
                with self._changed:
                    self._file.seek(self._written)
                    self._file.write(part)
                    self._written += len(part)
                    self._changed.notify_all()
        except BaseException as error:
            self._error = error
        finally:
            self._parts.close()
            with self._changed:
                self._is_done = True
                self._changed.notify_all()
