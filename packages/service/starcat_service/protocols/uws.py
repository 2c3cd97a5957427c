"""Jobs as UWS 1.1 describes them: the documents about an asynchronous query.

The XML is made by vo-models.

References
----------
UWS 1.1, IVOA Recommendation, October 2016.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any

from pydantic_xml import BaseXmlModel, element
from vo_models.uws.models import (
    NSMAP,
    ErrorSummary,
    Jobs,
    JobSummary,
    Parameter,
    Parameters,
    ResultReference,
    Results,
    ShortJobDescription,
)
from vo_models.uws.types import ErrorType, ExecutionPhase
from vo_models.voresource.types import UTCTimestamp

_NOT_XML = re.compile("[^\t\n\r -\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

ACTIVE = ("PENDING", "QUEUED", "EXECUTING")  # phases of a job that has not ended


@dataclass(frozen=True)
class JobFacts:
    """A job."""

    # Its id, its owner, its phase, and the client's name for it.
    job_id: str
    owner: str
    phase: str
    run_id: str
    parameters: tuple[tuple[str, str], ...]  # as the client sent them
    # Seconds since 1970; the second and third are None before the job has begun or ended.
    created_s: float
    started_s: float | None
    ended_s: float | None
    destroyed_s: float
    limit_s: float  # longest time it may run, seconds
    error: str = ""  # why it failed; empty if it did not
    media_type: str = ""  # type of the result


class _Parameters(Parameters, tag="parameters", ns="uws", nsmap=NSMAP):
    """Parameters of any names."""

    parameter: list[Parameter] = element(tag="parameter", default=[])

    def __init__(self, **data: Any) -> None:
        BaseXmlModel.__init__(self, **data)


def xml_text(text: str) -> str:
    """Return a text with marks in place of characters that XML cannot contain."""
    return _NOT_XML.sub("\ufffd", text)


def iso_time(seconds: float) -> str:
    """Return a time as UWS writes it."""
    moment = datetime.fromtimestamp(seconds, UTC)
    return moment.strftime("%Y-%m-%dT%H:%M:%S.") + f"{moment.microsecond // 1000:03d}Z"


def job_document(job: JobFacts, url: str) -> bytes:
    """Return all facts of a job as XML."""
    error = ErrorSummary(message=xml_text(job.error), type=ErrorType.FATAL, has_detail=True)
    summary = JobSummary[_Parameters](
        job_id=job.job_id,
        run_id=xml_text(job.run_id) or None,
        owner_id=job.owner,
        phase=ExecutionPhase(job.phase),
        creation_time=_time(job.created_s),
        start_time=_time(job.started_s),
        end_time=_time(job.ended_s),
        execution_duration=int(job.limit_s),
        destruction=_time(job.destroyed_s),
        parameters=_parameters(job),
        results=_results(job, url),
        error_summary=error if job.error else None,
    )
    return document(summary)


def parameters_document(job: JobFacts) -> bytes:
    """Return the parameters of a job as XML."""
    return document(_parameters(job))


def results_document(job: JobFacts, url: str) -> bytes:
    """Return the addresses of the results of a job as XML."""
    return document(_results(job, url))


def jobs_document(jobs: Sequence[JobFacts], url: str) -> bytes:
    """Return a list of jobs."""
    descriptions = [
        ShortJobDescription(
            job_id=job.job_id,
            phase=ExecutionPhase(job.phase),
            run_id=xml_text(job.run_id) or None,
            owner_id=job.owner,
            creation_time=_time(job.created_s),
            href=f"{url}/{job.job_id}",
        )
        for job in jobs
    ]
    return document(Jobs(jobref=descriptions))


def _parameters(job: JobFacts) -> _Parameters:
    return _Parameters(
        parameter=[
            Parameter(id=xml_text(name), value=xml_text(text)) for name, text in job.parameters
        ]
    )


def _results(job: JobFacts, url: str) -> Results:
    if job.phase != "COMPLETED":
        return Results()
    reference = ResultReference(
        id="result", href=f"{url}/results/result", mime_type=job.media_type or None
    )
    return Results(results=[reference])


def _time(seconds: float | None) -> UTCTimestamp | None:
    return None if seconds is None else UTCTimestamp.fromtimestamp(seconds, UTC)


def document(model: BaseXmlModel, skip_empty: bool = False) -> bytes:
    """Return a document of vo-models as XML."""
    xml = model.to_xml(skip_empty=skip_empty, encoding="UTF-8", xml_declaration=True)
    return xml if isinstance(xml, bytes) else xml.encode()
