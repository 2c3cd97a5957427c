"""The queue: what tells a worker that a job waits, and nothing else.

The jobs themselves are in the records. A message that is lost is sent again when the service
starts or finds its queue empty; one that comes twice finds its job begun.
"""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterable

from huey import RedisHuey, SqliteHuey
from huey.api import Huey
from huey.registry import Message
from huey.serializer import Serializer

from starcat.errors import ConfigError
from starcat.service.paths import ServicePaths
from starcat.service.settings import Settings

NAME = "starcat"

_logger = logging.getLogger(__name__)


class JsonMessages(Serializer):  # type: ignore[misc]
    """Messages as JSON: whoever may write into a queue cannot have a worker run their code."""

    def _serialize(self, data: Message) -> bytes:
        return json.dumps(list(data)).encode()

    def _deserialize(self, data: bytes) -> Message:
        return Message(*json.loads(data))


class JobQueue:
    """A queue of jobs.

    Attributes
    ----------
    is_used : threading.Event
        Set when this process has sent a message: only then a worker is needed.
    """

    def __init__(self, huey: Huey) -> None:
        self.huey = huey
        self.is_used = threading.Event()
        self._run: Callable[[str], None] | None = None

        def run_job(job_id: str) -> None:
            if self._run is not None:
                self._run(job_id)

        self._send: Callable[[str], object] = huey.task()(run_job)

    def on_job(self, run: Callable[[str], None]) -> None:
        """Say what a worker does with a job that waits."""
        self._run = run

    def send(self, job_id: str) -> bool:
        """Tell the workers that a job waits."""
        self.is_used.set()
        try:
            self._send(job_id)
        except Exception:  # whatever the library of the store raises: the job is not lost
            _logger.warning("the queue takes no message; job %s waits", job_id, exc_info=True)
            return False
        return True

    def send_again(self, job_ids: Iterable[str]) -> None:
        """Forget all messages, and send those of the jobs that wait."""
        try:
            self.huey.flush()
        except Exception:
            _logger.warning("the queue cannot be emptied", exc_info=True)
        for job_id in job_ids:
            self.send(job_id)

    def is_empty(self) -> bool:
        """Return whether no message waits; False too where the store does not answer."""
        try:
            return not self.huey.pending_count()
        except Exception:
            _logger.warning("the queue does not answer", exc_info=True)
            return False

    def close(self) -> None:
        """Close the store."""
        self.huey.storage.close()


def open_queue(settings: Settings, paths: ServicePaths) -> JobQueue:
    """Open the queue of a service."""
    options = {"results": False, "serializer": JsonMessages(), "utc": True}
    if settings.queue_url is None:
        huey = SqliteHuey(NAME, filename=str(paths.queue), strict_fifo=True, **options)
        return JobQueue(huey)
    try:
        huey = RedisHuey(NAME, url=settings.queue_url, blocking=True, read_timeout=1, **options)
    except ValueError as error:
        raise ConfigError(
            f"queue_url: {error}; expected redis://HOST:PORT/NUMBER",
            key="queue_url",
            value=settings.queue_url,
        ) from error
    return JobQueue(huey)
