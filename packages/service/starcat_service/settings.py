"""Settings of an operator: ``service.toml`` under the root, and options of the command."""

from __future__ import annotations

import ipaddress
import tomllib
from enum import IntEnum
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from starcat.errors import ConfigError, SourceError, suggest
from starcat.failures import validation_message
from starcat.storage import read_regular_file

FILE_NAME = "service.toml"
MAX_FILE_BYTES = 1 << 20

RoleName = Literal["none", "reader", "builder", "publisher"]


class Role(IntEnum):
    """What a user may do; each role includes the roles below it."""

    NONE = 0
    READER = 1
    BUILDER = 2
    PUBLISHER = 3

    @classmethod
    def named(cls, name: str) -> Role:
        """Return the role of a name such as ``reader``."""
        return cls[name.upper()]


class ServiceSettings(BaseModel):
    """All settings of an operator; docs/howto-serve.md prints the descriptions."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    root: Path = Field(description="Folder with all data of the service.")
    host: str = Field("127.0.0.1", description="Address to listen at.")
    port: int = Field(8000, ge=0, le=65535, description="Port; 0 for any that is free.")
    public_url: str | None = Field(
        None,
        pattern=r"^https?://[^/?#@\s]+/?$",
        description="Public address, if a proxy stands before the service: https://HOST[:PORT].",
    )
    anonymous: RoleName | None = Field(
        None,
        description="What a user without a token may do; by default read on a loopback address "
        "without a public_url, nothing on any other.",
    )
    workers: int = Field(
        1, ge=0, le=64, description="Jobs that run at the same time, here or on the cluster."
    )
    scheduler: str | None = Field(
        None, description="tcp://HOST:PORT of a Dask cluster that does the jobs; else this machine."
    )
    job_time_s: float = Field(3600.0, gt=0, description="Seconds that a job may take.")
    job_memory_gib: float = Field(4.0, gt=0, description="Memory that a job may take, GiB.")
    jobs_waiting: int = Field(20, ge=1, description="Jobs that one user may have waiting.")
    disk_gib: float = Field(
        20.0,
        gt=0,
        description="Disk that one user's databases and results of TAP may take, GiB; the oldest "
        "results are removed for new ones.",
    )
    free_gib: float = Field(
        1.0,
        ge=0,
        description="Disk that is left free, GiB: what would take it is refused or ended.",
    )
    query_time_s: float = Field(
        60.0,
        gt=0,
        description="Seconds that a query or an upload may take; three times as long if a busy "
        "machine gives it little processor time.",
    )
    query_memory_gib: float = Field(1.0, gt=0, description="Memory that a query may take, GiB.")
    worker_silence_s: float = Field(
        60.0, gt=0, description="Seconds until a worker of the cluster that is silent is lost."
    )
    queries: int = Field(
        2, ge=1, le=64, description="Uploads that are read at the same time; of queries, six more."
    )
    max_rows: int = Field(10_000_000, ge=1, description="Rows of an answer at most.")
    rows_mib: float = Field(
        16.0,
        gt=0,
        description="Size of an answer in rows (JSON) at most, MiB; larger answers are files.",
    )
    upload_mib: float = Field(64.0, gt=0, description="Size of an upload at most, MiB.")
    upload_time_s: float = Field(60.0, gt=0, description="Seconds that an upload may take.")
    requests_per_minute: int = Field(
        6000, ge=1, description="Requests of one address or token in a minute."
    )
    plate_solver: str | None = Field(
        None,
        max_length=200,
        description="Database, by id or title, that is tried first for clients of "
        "nova.astrometry.net; by default the newest one that fits the scale of the picture.",
    )
    signing_key: Path | None = Field(
        None,
        description="File of the key, of 'starcat keys new', that publications are signed with; "
        "outside of the root.",
    )
    keep_jobs_days: float = Field(90.0, gt=0, description="Days until ended jobs are deleted.")
    keep_results_days: float = Field(
        7.0, gt=0, description="Days until results of TAP are deleted."
    )
    session_hours: float = Field(12.0, gt=0, description="Hours that a sign-in lasts.")
    shutdown_s: float = Field(
        8.0,
        ge=0,
        description="Seconds that requests and jobs have to end when the service stops. The "
        "process ends after 10 s, or 2 s after a longer shutdown_s, whatever still runs.",
    )

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can reach the service."""
        if self.host == "localhost":
            return True
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return False

    @property
    def is_private(self) -> bool:
        """Whether only this machine should reach it: there is no proxy either."""
        return self.is_loopback and self.public_url is None

    @property
    def is_secure(self) -> bool:
        """Whether users reach it by https."""
        return self.public_url is not None and self.public_url.lower().startswith("https:")

    @property
    def anonymous_role(self) -> Role:
        """What a user without a token may do."""
        return Role.named(self.anonymous or ("reader" if self.is_private else "none"))


def read_settings(root: Path, **options: object) -> ServiceSettings:
    """Read the settings of a service."""
    path = root / FILE_NAME
    content: dict[str, object] = {}
    if path.exists():
        try:
            content = tomllib.loads(read_regular_file(path, MAX_FILE_BYTES).decode("utf-8-sig"))
        except (SourceError, ValueError, RecursionError) as error:
            raise ConfigError(f"{path}: not a readable TOML file: {error}") from error
    content |= {name: value for name, value in options.items() if value is not None}
    if "queue_url" in content:
        raise ConfigError(
            f"{path}: queue_url: jobs of other machines no longer go through Redis",
            key="queue_url",
            value=content["queue_url"],
            hint='start a Dask cluster there, and write scheduler = "tcp://HOST:8786" instead',
        )
    try:
        settings = ServiceSettings.model_validate({**content, "root": root.resolve()})
    except ValidationError as error:
        key, message = validation_message(error, show_input=True)
        keys = ", ".join(ServiceSettings.model_fields)
        hint = f"; {suggest(key, ServiceSettings.model_fields)}known: {keys}"
        advice = "" if key.partition(".")[0] in ServiceSettings.model_fields else hint
        raise ConfigError(f"{path}: {key}: {message}{advice}", key=key) from None
    _check_signing_key(settings, path)
    return settings


def _check_signing_key(settings: ServiceSettings, path: Path) -> None:
    """Refuse a key that is among the files of the service, or that is not a key."""
    if settings.signing_key is None:
        return
    from starcat.storage import read_private

    if settings.signing_key.resolve().is_relative_to(settings.root):
        raise ConfigError(
            f"{path}: signing_key: {settings.signing_key} is in the root, whose copies would have "
            "it too",
            key="signing_key",
            value=str(settings.signing_key),
            hint="move the key to a folder that only the service can read",
        )
    read_private(settings.signing_key)
