"""Export a database as an onboard image or as C source, and verify images against databases."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from dataclasses import replace as changed
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from starcat.catalog.stars.star_table import directions_of, floats_of
from starcat.database.manifest import MANIFEST_NAME
from starcat.database.onboard.c_source import c_camera, c_header, c_source
from starcat.database.onboard.checking import (
    Shrunk,
    capacity_problems,
    database_problems,
    shrink,
    value_problems,
)
from starcat.database.onboard.image import Contents, MadeImage, check_method, make_image
from starcat.database.onboard.layout import BLOCK_BYTES, BYTE_ORDERS, FEATURES, ByteOrder, crc_of
from starcat.database.onboard.patching import (
    MAX_ADDED_BYTES,
    apply_patch,
    image_signatures,
    make_patch,
    sign_image,
    signature_problems,
)
from starcat.database.onboard.profiles import method_or_default, profile_named
from starcat.database.onboard.reading import OnboardImage, bytes_of_file, read_onboard_image
from starcat.database.products.tiling import FieldStars
from starcat.database.reader import DatabaseFolder, open_database_folder
from starcat.database.verify import Finding, Verification, check_database
from starcat.errors import ConfigError, OnboardImageError, OutputError, count_of
from starcat.geometry.camera import Camera
from starcat.geometry.footprint import Footprint
from starcat.pipeline.recipes import tile_guide_stars
from starcat.pipeline.simulation.in_flight import FlightRates, flight_rates, voting_bytes
from starcat.pipeline.specs.camera_file import read_camera
from starcat.pipeline.specs.reading import spec_from_dict, spec_of_database
from starcat.results import entry, in_record
from starcat.storage.atomic import whole_file
from starcat.storage.keys import raw_public, read_private, read_public


@dataclass(frozen=True, repr=False)
class ExportedImage:
    """An onboard image that was written.

    Attributes
    ----------
    image : MadeImage
        The bytes of the image, and figures of its contents.
    fitted : Shrunk
        Contents of the image, and what was left out.
    file_format : str
        ``onboard`` for an image, ``c`` for source code.
    byte_order : ByteOrder
        Byte order of the image.
    files : tuple[Path, ...]
        The image, or source and header; then the patch.
    sky : Contents
        The whole database.
    part : Footprint | None
        Part of the sphere that it is for; None: all of it.
    profile : str | None
        None: no profile, so everything that fits is kept.
    signed_by : tuple[str, ...]
        Public keys, hexadecimal.
    patch_bytes : int | None
        Size of the patch, if one was requested.
    """

    image: MadeImage = field(metadata=entry(is_spread=True))
    fitted: Shrunk = field(metadata=entry(is_spread=True))
    file_format: str = field(metadata=entry(key="format"))
    byte_order: ByteOrder = field(metadata=entry(key="endian"))
    files: tuple[Path, ...]
    sky: Contents = field(repr=False)
    part: Footprint | None = field(default=None, repr=False)
    profile: str | None = field(default=None, repr=False)
    signed_by: tuple[str, ...] = ()
    patch_bytes: int | None = None

    def __repr__(self) -> str:
        stars, size = len(self.image.star_rows), len(self.image.data)
        return f"<ExportedImage {self.files[0]}: {count_of(stars, 'star')}, {size:,} bytes>"

    @property
    @in_record()
    def crc(self) -> int:
        """CRC-32 of all data, which flight software needs for a new image."""
        return crc_of(self.image.data, self.byte_order)

    @property
    def voting_bytes(self) -> int:
        """Bytes of memory for the table of neighbours for votes, in addition to the image."""
        contents = self.fitted.contents
        return voting_bytes(contents.directions, contents.camera.radius_rad)

    @cached_property
    def rates(self) -> tuple[FlightRates, ...]:
        """Identification rates of the image for simulated frames; empty without the C library."""
        return flight_rates(self.fitted.contents, self.sky, part=self.part)

    @property
    @in_record(is_spread=True)
    def of_profile(self) -> dict[str, Any]:
        """Memory and rates of an image that was made by a profile; they take seconds."""
        if self.profile is None:
            return {}
        return {"profile": self.profile, "voting_bytes": self.voting_bytes, "rates": self.rates}


def export_image(
    database: Path,
    file_format: str,
    output: Path | None = None,
    *,
    profile: str | None = None,
    method: str | None = None,
    endian: str = "little",
    max_bytes: int | None = None,
    patch_from: Path | None = None,
    replace: bool = False,
    sign: Sequence[Path] = (),
    camera: Path | None = None,
) -> ExportedImage:
    """Write the onboard image of a database, signed with the keys in some files.

    A profile is a name of `PROFILES`; the default method is the profile's method. With
    `patch_from`, an older image, a patch from it to the new image is written next to the image.
    With `camera`, a camera file, a C header with this camera is written next to the image.
    """
    kept = profile_named("full" if profile is None else profile)
    method = method_or_default("full" if profile is None else profile, method)
    check_method(method)
    keys = [read_private(Path(path)) for path in sign]
    order = next((byte_order for byte_order in BYTE_ORDERS if byte_order == endian), None)
    if order is None:
        raise ConfigError(f"expected {' or '.join(BYTE_ORDERS)}", parameter="endian", value=endian)
    opened = open_database_folder(database)
    suffix = ".c" if file_format == "c" else ".img"
    target = output or Path(f"{_name(opened)}{suffix}")
    if file_format == "c" and target.suffix != ".c":
        raise ConfigError(
            "expected a name that ends with .c, for C source", parameter="output", value=str(target)
        )
    if file_format == "c" and patch_from is not None:
        raise ConfigError(
            "it has no effect on C source",
            parameter="patch_from",
            hint=("leave it out", "choose another {form}"),
        )
    own_camera = None if camera is None else read_camera(Path(camera))
    old = None if patch_from is None else read_onboard_image(Path(patch_from))
    if target.is_dir():
        raise OutputError("is a folder", where=target, hint="choose a file with {output}")
    _check_product(opened, method)
    contents = contents_of(check_database(database), method)
    if own_camera is not None:
        _check_camera(own_camera, contents.camera, Path(str(camera)))
    room = max_bytes and max_bytes - (MAX_ADDED_BYTES if keys else 0)
    fields = partial(_fields, opened)
    fitted = shrink(contents, _times_seen(opened, method), fields, room, kept)
    image = make_image(fitted.contents, order)
    image = changed(image, data=sign_image(image.data, order, keys))
    files = {target: image.data}
    if file_format == "c":
        files = _c_files(image, fitted.contents.name, target, order)
    patch = None if old is None else _checked_patch(old, read_onboard_image(image.data))
    if patch is not None:
        files[target.with_suffix(".patch")] = patch
    if own_camera is not None:
        text = c_camera(fitted.contents.name, own_camera)
        files[target.with_name(f"{target.stem}_camera.h")] = text.encode()
    _write(files, replace=replace)
    signed_by = tuple(
        signature.public_key.hex() for signature in image_signatures(image.data, order)
    )
    size = None if patch is None else len(patch)
    paths = tuple(files)
    part = spec_of_database(opened).selection.region.footprint
    return ExportedImage(
        image, fitted, file_format, order, paths, contents, part, profile, signed_by, size
    )


def _check_camera(camera: Camera, built_for: Camera, path: Path) -> None:
    size_px, expected_px = (
        (detector.width_px, detector.height_px) for detector in (camera, built_for)
    )
    if size_px != expected_px:
        raise ConfigError(
            f"a camera of {size_px[0]} x {size_px[1]} px; the database is for "
            f"{expected_px[0]} x {expected_px[1]} px",
            where=path,
            key="camera",
            hint="Give the camera that was calibrated with it",
        )


def _checked_patch(old: OnboardImage, new: OnboardImage) -> bytes:
    patch = make_patch(old, new)
    if apply_patch(old.data, patch) != new.data:
        raise OnboardImageError(f"the patch from {old.name} does not make {new.name}: report this")
    return patch


def contents_of(database: DatabaseFolder, method: str) -> Contents:
    """Return the contents for the image of a database."""
    _check_product(database, method)
    product, columns = FEATURES[method]
    stars, features = database.table("stars"), database.table(product)
    manifest = database.manifest
    spec = spec_from_dict(manifest["spec"], MANIFEST_NAME)
    return Contents(
        name=_name(database),
        epoch_jyear=float(manifest["epoch_jyear"]),
        camera=spec.camera.camera(),
        star_id=stars["star_id"].to_numpy(),
        directions=directions_of(stars),
        mag=floats_of(stars, "mag"),
        method=method,
        features=np.stack([features[name].to_numpy() for name in columns], axis=-1),
        manifest_sha256=hashlib.sha256((database.folder / MANIFEST_NAME).read_bytes()).digest(),
    )


def verify_image(
    path: Path, against: Path | None = None, trust: Path | None = None
) -> Verification:
    """Check an onboard image: its blocks, parts and signatures, and compare with its database."""
    key = None if trust is None else raw_public(read_public(trust))
    database = None if against is None else check_database(against)
    data = bytes_of_file(path)
    checks, findings = 1, list(_damage(data, path.name))
    if not findings:
        image = read_onboard_image(data)
        problems = [*value_problems(image), *capacity_problems(image)]
        problems += signature_problems(image, key)
        checks += 5 + len(image_signatures(data, image.byte_order)) + (key is not None)
        if database is not None:
            problems += database_problems(image, contents_of(database, image.method))
            checks += 7
        findings = [Finding(path.name, "", problem) for problem in problems]
    return Verification(path, checks, tuple(findings))


def _damage(data: bytes, file: str) -> Iterator[Finding]:
    try:
        read_onboard_image(data)
    except OnboardImageError as error:
        for block in error.bad_blocks:
            where = f"bytes {block * BLOCK_BYTES} to {(block + 1) * BLOCK_BYTES - 1}"
            yield Finding(file, "", f"block {block}: damaged ({where})")
        if not error.bad_blocks:
            yield Finding(file, "", str(error))


def _name(database: DatabaseFolder) -> str:
    return f"{database.manifest['name']}-{database.manifest['version']}"


def _check_product(database: DatabaseFolder, method: str) -> None:
    product, _ = FEATURES[method]
    if product not in database.products:
        raise ConfigError(
            f"{_name(database)} has no product {product!r}, which an image for {method!r} needs",
            hint=(
                f"set products.{product}.enabled = true in its spec and build it again",
                "choose another {method}",
            ),
        )


def _times_seen(database: DatabaseFolder, method: str) -> NDArray[np.int32] | None:
    """Return the number of boresights that see each triangle; None for pairs (not counted)."""
    if method != "triangle":
        return None
    seen: NDArray[np.int32] = database.table("triangles")["times_seen"].to_numpy()
    return seen


def _fields(database: DatabaseFolder) -> FieldStars:
    spec = spec_from_dict(database.manifest["spec"], MANIFEST_NAME)
    return tile_guide_stars(database.table("stars"), spec)


def _c_files(image: MadeImage, name: str, target: Path, byte_order: ByteOrder) -> dict[Path, bytes]:
    header = target.with_suffix(".h")
    source = c_source(name, image.data, byte_order, header.name)
    return {target: source.encode(), header: c_header(name, len(image.data)).encode()}


def _write(files: Mapping[Path, bytes], *, replace: bool) -> None:
    """Write all files or none; existing files may not differ unless ``replace`` is set."""
    for path, data in files.items():
        if path.exists() and not replace and not (path.is_file() and path.read_bytes() == data):
            raise OutputError(
                f"{path} already exists and differs",
                path=path,
                hint=("choose another {output}", "pass {replace:True}"),
            )
    for path, data in files.items():
        with whole_file(path) as unfinished:
            unfinished.write_bytes(data)
