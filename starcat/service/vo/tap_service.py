"""What the service keeps for TAP: its tables, what answers questions, and its jobs."""

from __future__ import annotations

from starcat.service.library import Library
from starcat.service.paths import ServicePaths
from starcat.service.query_pool import QueryPool
from starcat.service.records import Records
from starcat.service.sandbox.sandbox import Sandbox
from starcat.service.settings import Settings
from starcat.service.vo.tap_queries import TapQueries
from starcat.service.vo.tap_runner import TapRunner
from starcat.service.vo.tap_store import TapJobs
from starcat.service.vo.tap_tables import TapTables
from starcat.vo.documents import ServiceLimits

DAY_S = 86400


class Tap:
    """The parts of TAP.

    Attributes
    ----------
    limits : ServiceLimits
        What is granted.
    tables : TapTables
        What may be asked.
    queries : TapQueries
        What answers.
    jobs : TapJobs
        Questions whose answers are kept.
    runner : TapRunner
        What answers those.
    """

    def __init__(
        self,
        settings: Settings,
        paths: ServicePaths,
        records: Records,
        library: Library,
        sessions: QueryPool,
        sandbox: Sandbox,
    ) -> None:
        self.limits = ServiceLimits(
            run_s=int(settings.job_time_s),
            keep_s=int(settings.keep_results_days * DAY_S),
            rows=settings.max_rows,
            upload_bytes=int(settings.upload_mib * 2**20),
        )
        self.tables = TapTables(paths, library, sessions)
        self.queries = TapQueries(paths, self.tables, sessions, sandbox, settings.max_rows)
        self.jobs = TapJobs(records, paths, self.limits)
        # One of the queries that run at the same time is left to those who wait for the answer.
        self.runner = TapRunner(self.jobs, self.queries, max(1, settings.queries - 1))

    def close(self) -> None:
        """Stop answering; jobs that wait go on at the next start."""
        self.runner.close()
