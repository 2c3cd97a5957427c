"""Downloads of a database: the image for flight software, and the spec."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

import tomlkit
from fastapi import Query
from fastapi.responses import Response

from starcat.database.onboard import BYTE_ORDERS, FEATURES, PROFILES
from starcat_service.access import Reader
from starcat_service.library import ListedDatabase
from starcat_service.pages.rendering import page_router
from starcat_service.service import Service, TheService
from starcat_service.transfers import BYTES, TYPES, open_attachment, scratch_folder

router = page_router()

Method = Literal["triangle", "pyramid"]
Endian = Literal["little", "big"]
ProfileName = Literal["full", "small"]
FULL_NAME: ProfileName = "full"


def image_choices(database: ListedDatabase) -> dict[str, list[tuple[str, str]]]:
    """Return the methods, the byte orders and the profiles that an image of a database can have."""
    methods = [name for name, (product, _) in FEATURES.items() if product in database.products]
    return {
        "methods": [(name, f"{name}s") for name in methods],
        "orders": [(name, f"{name}-endian") for name in BYTE_ORDERS],
        "profiles": [
            (name, f"{name}, with {profile.methods[0]}s")
            for name, profile in PROFILES.items()
            if name != FULL_NAME and profile.methods[0] in methods
        ],
    }


@router.get("/databases/{database_id}/image")
async def flight_image_page(
    service: TheService,
    _: Reader,
    database_id: str,
    method: Annotated[Method | None, Query()] = None,
    endian: Annotated[Endian, Query()] = "little",
    profile: Annotated[ProfileName, Query()] = FULL_NAME,
) -> Response:
    """Return the image for flight software, the same bytes that ``starcat export`` writes."""
    database = service.library.database(database_id)
    options = {"method": method, "endian": endian, "profile": profile}
    return await service.sandbox.run(_image, service, database, options)


def _image(
    service: Service, database: ListedDatabase, options: Mapping[str, str | None]
) -> Response:
    name = "" if options["profile"] == FULL_NAME else f"-{options['profile']}"
    with scratch_folder(service.paths) as folder:
        target = folder / "image.img"
        arguments = {"database": str(database.folder), "target": str(target)}
        service.sandbox.call("flight_image", {**arguments, **options})
        return open_attachment(target, f"{database.title}{name}.img", BYTES)


@router.get("/databases/{database_id}/spec.toml")
def spec(service: TheService, _: Reader, database_id: str) -> Response:
    """Return the spec from which a database was built, with all defaults."""
    database = service.library.database(database_id)
    headers = {"Content-Disposition": f'attachment; filename="{database.title}.toml"'}
    text = tomlkit.dumps(_without_none(database.spec))
    return Response(text, media_type=TYPES[".toml"], headers=headers)


def _without_none(content: Any) -> Any:
    """Return a content without values that are not given, which TOML cannot express."""
    if isinstance(content, dict):
        return {key: _without_none(value) for key, value in content.items() if value is not None}
    return content
