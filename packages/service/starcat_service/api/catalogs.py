"""Catalogs: star sources for specs, and the star tables that jobs have read."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Path
from pydantic import BaseModel, Field

from starcat_service.access import Publisher, Reader
from starcat_service.catalogs import Offered
from starcat_service.library import StoredCatalog
from starcat_service.removal import remove_catalog
from starcat_service.service import TheService

router = APIRouter(prefix="/catalogs", tags=["catalogs"])


class CatalogsAnswer(BaseModel):
    """The catalogs that a spec can name, available ones first."""

    catalogs: list[Offered]
    stored: list[StoredCatalog] = Field(description="Star tables that jobs have read.")


@router.get("", summary="All catalogs")
def all_catalogs(service: TheService, reader: Reader) -> CatalogsAnswer:
    """Return the catalogs that a spec can name, and whether their files are on this machine."""
    stored = service.library.stored_catalogs()
    return CatalogsAnswer(catalogs=service.catalogs.offered(), stored=stored)


@router.delete("/stored/{name}", status_code=204, summary="Remove a star table")
def remove(
    name: Annotated[str, Path(examples=["gaia-0123456789abcdef.parquet"])],
    service: TheService,
    publisher: Publisher,
) -> None:
    """Remove a star table that a job has read; a job can read it again."""
    remove_catalog(service, name)
