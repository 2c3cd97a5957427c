"""What the REST interface says of databases."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, Field

from starcat.service.library import Database


class DatabaseFacts(BaseModel):
    """What a database was made from, and what it holds."""

    id: str = Field(
        description="Beginning of the digest of what it was made from.",
        examples=["0123456789abcdef"],
    )
    name: str = Field(examples=["gaia-12deg"])
    version: str = Field(examples=["1.0.0"])
    title: str = Field(description="Name of its folder.", examples=["gaia-12deg-1.0.0"])
    description: str = Field(description="What the spec says of it.")
    frame: str = Field(description="Axes of all positions.", examples=["ICRS"])
    epoch_jyear: float = Field(description="Epoch of all positions, Julian year.")
    catalog: str = Field(description="The star catalog.", examples=["gaia"])
    stars: int = Field(description="Guide stars.")
    bytes: int = Field(description="Size of all files together, without the manifest.")
    products: dict[str, int] = Field(description="Rows of each product.")
    manifest_sha256: str = Field(description="Digest that the manifest carries of itself.")
    spec: dict[str, Any] = Field(description="The spec, with all defaults.")
    software: dict[str, str] = Field(description="Versions of what built it.")


class Databases(BaseModel):
    """All databases there are."""

    databases: list[DatabaseFacts]


class DatabaseFile(BaseModel):
    """A file of a database."""

    path: str = Field(description="Within its folder.", examples=["stars.parquet"])
    bytes: int = Field(description="Size.")
    sha256: str = Field(description="Digest of the content; also its ETag.")
    content_type: str = Field(examples=["application/vnd.apache.parquet"])


class CoverageFields(BaseModel):
    """Stars, pairs and triangles by field: lists of the same length."""

    boresight: list[int] = Field(description="Number of the boresight.")
    ra_deg: list[float] = Field(description="Right ascension of the boresight, degrees.")
    dec_deg: list[float] = Field(description="Declination, degrees.")
    stars: list[int]
    pairs: list[int]
    triangles: list[int]


class CoverageAnswer(BaseModel):
    """How many stars, pairs and triangles the fields of a database hold."""

    summary: dict[str, Any] = Field(description="As 'starcat coverage --json' prints it.")
    fields: CoverageFields


def facts_of(database: Database) -> DatabaseFacts:
    """Return what is said of a database."""
    manifest = database.manifest
    products = {name: int(facts["rows"]) for name, facts in manifest["products"].items()}
    return DatabaseFacts(
        id=database.id,
        name=database.name,
        version=database.version,
        title=database.title,
        description=str(manifest["spec"].get("description", "")),
        frame=manifest["frame"],
        epoch_jyear=manifest["epoch_jyear"],
        catalog=manifest["spec"]["catalog"]["source"],
        stars=products.get("stars", 0),
        bytes=sum(int(facts["bytes"]) for facts in manifest["files"].values()),
        products=products,
        manifest_sha256=str(manifest.get("manifest_sha256", "")),
        spec=manifest["spec"],
        software=manifest["software"],
    )
