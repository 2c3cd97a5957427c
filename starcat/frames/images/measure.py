"""Files of frames to centroids: centroids are read, the stars of a picture are detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from numpy.typing import NDArray

from starcat.errors import ConfigError
from starcat.frames.images.centroid_tables import frames_of_content
from starcat.frames.images.contents import FileContent, read_content
from starcat.geometry.camera import Camera
from starcat.matcher.centroids import MeasuredFrame, read_stdin
from starcat.matcher.options import IdentifyOptions

if TYPE_CHECKING:
    from starcat.frames.images.centroiding import Spots
    from starcat.frames.sky.observer import Observer

STDIN = Path("-")


@dataclass(frozen=True)
class LocalInputs:
    """Inputs in addition to the options, only for users who run starcat on their own machine."""

    camera: Camera | None = None  # replaces the text of a camera file
    dark: Path | None = None  # an image with the lid on, which is subtracted
    mask: Path | None = None  # an image; pixels that are not zero are ignored
    observer: Observer | None = None
    track: bool = False  # the frames are a sequence
    # The expected attitude or boresight, and its error; replaces the quaternion of the options.
    prior: tuple[Any, Any] | None = None
    may_narrow: bool = False  # of a range of fields, only the part that the database serves is used


@dataclass(frozen=True, eq=False)
class MeasuredFile:
    """The centroids of a file, and the image (height, width) that they were found in, if any.

    If the file is one of many, the image is not kept, but its shape is.
    """

    frames: Sequence[MeasuredFrame]
    image: NDArray[Any] | None = None
    shape: tuple[int, ...] | None = None  # shape of the image; None for a file of centroids
    spots: Spots | None = None  # centroids with their errors; None for a file of centroids

    def brightest(self, count: int) -> MeasuredFile:
        """Return an image with fewer of its spots, the brightest."""
        frames, spots = self.frames, self.spots
        if spots is not None:
            spots = spots.at(slice(count))
            frames = [MeasuredFrame(frames[0].name, spots.centroids_px, spots.mag)]
        return replace(self, frames=frames, spots=spots)


@dataclass(frozen=True, eq=False)
class FrameFile:
    """A file that is read: its frames, or the image in which their centroids are to be found."""

    path: Path
    frames: Sequence[MeasuredFrame] = ()
    image: NDArray[Any] | None = None

    @property
    def shape(self) -> tuple[int, ...] | None:
        """Shape of the image (height, width); None for a file of centroids."""
        return None if self.image is None else self.image.shape

    def measured(
        self, options: IdentifyOptions, *, without_hot_pixels: bool = False
    ) -> MeasuredFile:
        """Return the centroids; those of an image are found."""
        if self.image is None:
            return MeasuredFile(self.frames)
        from starcat.frames.images.centroiding import find_spots

        try:
            spots = find_spots(
                self.image,
                threshold_sigma=options.threshold,
                psf_sigma_px=options.psf_sigma_px,
                most_spots=options.most_spots,
                without_hot_pixels=without_hot_pixels,
            )
        except ConfigError as error:
            error.at(self.path)
            raise
        frame = MeasuredFrame(self.path.stem, spots.centroids_px, spots.mag)
        return MeasuredFile([frame], self.image, self.image.shape, spots)


def measure_file(
    path: Path, options: IdentifyOptions | None = None, local: LocalInputs | None = None
) -> MeasuredFile:
    """Read the centroids of a file, or ``-`` for stdin, or find them in an image."""
    options = options or IdentifyOptions()
    return read_frame_file(path, options, local or LocalInputs()).measured(options)


def read_frame_file(path: Path, options: IdentifyOptions, local: LocalInputs) -> FrameFile:
    """Read a file of centroids, or ``-`` for stdin, or an image."""
    if path == STDIN:
        # Its frames are only ever gone through.
        return FrameFile(path, cast(Sequence[MeasuredFrame], read_stdin()))
    content = read_content(path)
    if not content.is_picture:
        return FrameFile(path, frames_of_content(content))
    return FrameFile(path, image=_image(content, options, local))


def _image(content: FileContent, options: IdentifyOptions, local: LocalInputs) -> NDArray[Any]:
    """Return an image without its dark frame, mosaic and dead pixels, as far as they are stated."""
    # What detects the stars is loaded before the image takes memory, because OpenBLAS tries for
    # minutes to start without memory.
    import starcat.frames.images.centroiding  # noqa: F401
    from starcat.frames.images.image_file import (
        grey_of_mosaic,
        image_of_content,
        read_image,
        without_dark,
        without_dead_zones,
    )

    flip = options.flip
    image: NDArray[Any] = image_of_content(content, flip=flip, plane=options.plane)
    dark, mask = (
        None if file is None else read_image(file, flip=flip) for file in (local.dark, local.mask)
    )
    try:
        if dark is not None:
            image = without_dark(image, dark)
        if options.bayer:
            image = grey_of_mosaic(image)
        if mask is not None:
            image = without_dead_zones(image, mask)
    except ConfigError as error:  # the message does not know the picture
        error.at(content.path)
        raise
    return image
