"""The camera of the frames of a file: the database's, or as the options state it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from starcat.errors import ConfigError
from starcat.frames.images.measure import LocalInputs
from starcat.geometry.camera import Camera
from starcat.matcher.blind import check_range_served, fields_served
from starcat.matcher.database import MatcherDatabase
from starcat.matcher.options import IdentifyOptions

CAMERA_NAME = "camera.toml"  # name of the text of a camera file in messages


def stated_camera(
    shape: tuple[int, ...] | None,
    database: MatcherDatabase,
    options: IdentifyOptions,
    local: LocalInputs,
) -> tuple[Camera, IdentifyOptions]:
    """Return the camera of frames, and the options that remain when it is known.

    Parameters
    ----------
    shape : tuple of int, or None
        Height and width of the image; None for centroids.
    database : MatcherDatabase
        The database, whose camera is used unless another one is stated.
    options : IdentifyOptions
        Camera, field of view and size as stated. One field of view becomes a part of the camera. A
        range of them remains: the part that the database serves if ``local.may_narrow``.
    local : LocalInputs
        A camera in place of the text of the options.

    Raises
    ------
    ConfigError, ProductError
        If the image has another size than stated, or the database does not serve the range.
    """
    camera = local.camera or database.camera
    if options.camera is not None:
        # Reading a camera needs the spec, whose import takes longer than a frame.
        from starcat.pipeline.specs.camera_file import parse_camera

        # A text without a size is of a camera whose images are as large as this one.
        size_px = (camera.width_px, camera.height_px)
        if shape is not None:
            size_px = (shape[1], shape[0])
        camera = parse_camera(options.camera, Path(CAMERA_NAME), size_px)
    fov_deg = options.fov_deg
    if fov_deg is None:
        return camera, options
    camera = _of_size(shape, options.size_px, camera)
    if options.is_one_field:
        flat = Camera(camera.width_px, camera.height_px, fov_x_deg=fov_deg[0])
        camera = camera.with_focal_length(flat.focal_length_px)
        return camera, replace(options, fov_deg=None, size_px=None)
    if local.may_narrow:
        return camera, replace(options, fov_deg=fields_served(database, camera, fov_deg))
    check_range_served(database, camera, fov_deg)
    return camera, options


def _of_size(
    shape: tuple[int, ...] | None, size_px: tuple[int, int] | None, camera: Camera
) -> Camera:
    """Return the camera of an image of some shape, or of centroids."""
    width, height = size_px or (camera.width_px, camera.height_px)
    if shape is not None:
        height, width = shape
        if size_px not in (None, (width, height)):
            raise ConfigError(
                f"the image has {width} x {height} px",
                parameter="size_px",
                value=size_px,
                hint="leave it out",
            )
    if (width, height) == (camera.width_px, camera.height_px):
        return camera
    return Camera(width, height, fov_x_deg=camera.fov_x_deg)
