"""The process that has jobs done: a few slots that take them from the queue.

The server starts it, with the settings as the first line of its input. A line ``stop`` has it take
no further job, and end when those that run have ended or their time is over. When its input ends
the server is gone: then all of its processes end at once, and the next server takes the jobs up.
"""

from __future__ import annotations

import logging.config
import os
import signal
import sys
import threading
import time

from huey.consumer import Consumer

from starcat.service.jobs.ground import open_ground
from starcat.service.jobs.runner import Slots
from starcat.service.jobs.task import end_with_parent
from starcat.service.security.logs import log_settings
from starcat.service.settings import Settings

PROGRAM = (
    "import sys; sys.path[:] = sys.argv[1:]; from starcat.service.jobs.worker import main; main()"
)

POLL_S = (0.05, 0.25)
"""Seconds between two looks into a queue that is a file: the first, and at the most."""


def main() -> None:
    """Have jobs done until the server says otherwise."""
    end_with_parent()
    logging.config.dictConfig(log_settings())
    settings = Settings.model_validate_json(sys.stdin.buffer.readline())
    slots = Slots(open_ground(settings))
    threading.Thread(target=_listen, args=(slots, settings.shutdown_s), daemon=True).start()
    serve_queue(slots)
    os._exit(0)


def serve_queue(slots: Slots) -> None:
    """Take jobs from the queue until asked to stop, then wait for those that run."""
    settings = slots.service.settings
    slots.service.queue.on_job(slots.run_job)
    first_s, most_s = POLL_S
    consumer = Consumer(
        slots.service.queue.huey,
        workers=max(1, settings.workers),
        periodic=False,
        initial_delay=first_s,
        max_delay=most_s,
        worker_type="thread",
        scheduler_interval=60,
        health_check_interval=5,
    )
    consumer.start()
    # A system that goes down tells all processes: jobs have their time, as when the server asks.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: _stop(slots, settings.shutdown_s))
    while slots.stop_at_s is None:
        time.sleep(0.1)
        consumer.check_worker_health()
    consumer.stop(graceful=True)


def _stop(slots: Slots, more_s: float) -> None:
    if slots.stop_at_s is None:
        slots.stop_at_s = time.monotonic() + more_s


def _listen(slots: Slots, more_s: float) -> None:
    for line in sys.stdin.buffer:
        if line.strip() == b"stop":
            _stop(slots, more_s)
    slots.end_all()
    os._exit(1)
