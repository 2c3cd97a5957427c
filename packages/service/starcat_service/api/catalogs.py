"""Catalogs: what a spec may choose its stars from."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel

from starcat_service.access import Reader
from starcat_service.catalogs import Offered
from starcat_service.service import TheService

router = APIRouter(prefix="/catalogs", tags=["catalogs"])


class CatalogsAnswer(BaseModel):
    """The catalogs that a spec may name, those that are here first."""

    catalogs: list[Offered]


@router.get("", summary="All catalogs")
def all_catalogs(service: TheService, reader: Reader) -> CatalogsAnswer:
    """Return the catalogs that a spec may name, and whether their files are here."""
    return CatalogsAnswer(catalogs=service.catalogs.offered())
