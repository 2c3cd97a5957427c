"""Catalogs: what a spec may choose its stars from."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, Field

from starcat_service.access import Reader
from starcat_service.catalogs import Offered
from starcat_service.service import TheService

router = APIRouter(prefix="/catalogs", tags=["catalogs"])


class ReadFacts(BaseModel):
    """A catalog as it was read for an estimate."""

    band: str = Field(description="Of the magnitudes.", examples=["G"])
    epoch_jyear: float = Field(description="Julian year that the stars were moved to.")
    stars: int = Field(description="Stars that can be chosen from.")
    brightest_mag: float | None = Field(None, description="Of the stars with a magnitude.")
    faintest_mag: float | None = Field(None, description="Of the stars with a magnitude.")


class CatalogFacts(BaseModel):
    """A catalog that a spec may name."""

    name: str = Field(description="For ``catalog.source``.", examples=["gaia"])
    title: str = Field(examples=["The Hipparcos Catalogue, main file"])
    is_here: bool = Field(description="Whether its files are, so that a build can read it.")
    bands: list[str] = Field(
        description="For ``catalog.band``, the default first.", examples=[["V", "Hp"]]
    )
    epoch_jyear: float | None = Field(
        None, description="Of the positions in its files, where all have the same."
    )
    frame: str = Field(description="Axes of the positions in its files.", examples=["ICRS"])
    records: int | None = Field(None, description="Records of the whole archive.")
    citation: str = Field(description="How to cite it.")
    licence: str = Field(description="Terms that it comes under.")
    read: list[ReadFacts] = Field(description="Figures known from earlier estimates.")
    hint: str | None = Field(None, description="What to do where it is not here.")


class CatalogsAnswer(BaseModel):
    """The catalogs that a spec may name, those that are here first."""

    catalogs: list[CatalogFacts]


@router.get("", summary="All catalogs")
def all_catalogs(service: TheService, reader: Reader) -> CatalogsAnswer:
    """Return the catalogs that a spec may name, and whether their files are here."""
    return CatalogsAnswer(catalogs=[_facts(one) for one in service.catalogs.offered()])


def _facts(offered: Offered) -> CatalogFacts:
    source = offered.source
    return CatalogFacts(
        name=source.name,
        title=source.title,
        is_here=offered.is_here,
        bands=list(source.bands),
        epoch_jyear=source.epoch_jyear,
        frame=source.frame,
        records=source.rows,
        citation=source.citation,
        licence=source.licence,
        read=[ReadFacts.model_validate(one, from_attributes=True) for one in offered.read],
        hint=None
        if offered.is_here
        else f"the operator can get it with 'starcat fetch {source.name}', or set "
        "$STARCAT_CATALOGS to the folder that has its files",
    )
