"""Image files: FITS, PNG, TIFF and JPEG to and from one array of grey values, row 0 at the top.

HEIC, as telephones write it, and BMP are read but not written.

A dark frame, dead pixels and a mosaic of colours are removed from such an array, and copies of
files are written with a WCS that gives the place of each pixel in the sky.

The kind of a file is detected from its first bytes, not its name. Colour becomes luminance, also in
FITS files with three planes. Pillow reads the kinds whose bits it all keeps; imagecodecs reads
16-bit colour, and pi-heif HEIC; the extra ``images`` installs them. Stacks of other numbers of
planes are refused, unless one of them is chosen. Raw pictures of cameras, recognized by their
suffix, are read by rawpy, which the extra ``raw`` installs.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from starcat.arrays import Array
from starcat.errors import ConfigError
from starcat.frames.images.contents import (
    FITS,
    MAX_EXPANDED_FITS_BYTES,
    MAX_PIXELS,
    RAW_PICTURE,
    FileContent,
    check_pixels,
    read_content,
)
from starcat.matcher.result import MatchResult
from starcat.storage.atomic import write_file
from starcat.storage.file_formats import unread_format
from starcat.version import install_command

if TYPE_CHECKING:
    from astropy.io.fits import HDUList, Header, PrimaryHDU

Grey = NDArray[np.float32] | Array

_log = logging.getLogger(__name__)

_IMAGE = "an image"  # what a file has to be, for messages
_OF_PILLOW = ("PNG", "TIFF", "JPEG", "BMP")
# Kind of file that is written for each suffix.
WRITTEN_KINDS = {
    ".fits": "FITS", ".fit": "FITS", ".fts": "FITS", ".png": "PNG", ".tif": "TIFF", ".tiff": "TIFF",
    ".jpg": "JPEG", ".jpeg": "JPEG",
}  # fmt: skip
# Files that may say when they were taken.
KNOWS_TIME = (".fits", ".fit", ".fts", ".jpg", ".jpeg", ".tif", ".tiff", ".png")
_LUMINANCE = np.array([0.299, 0.587, 0.114])  # weights of red, green and blue: ITU-R BT.601
_BINOMIAL = np.array([0.25, 0.5, 0.25])

_WCS_SUFFIXES = (".fits", ".fit", ".fts")
# Keywords that a world coordinate system of a header is made of.
_OF_A_WCS = re.compile(
    r"(WCSAXES|WCSNAME|C(TYPE|UNIT|RVAL|RPIX|DELT|ROTA)\d|(PC|CD)\d_\d|P[VS]\d_\d+|LONPOLE|LATPOLE"
    r"|RADE(SYS|CSYS)|EQUINOX|MJDREF[IF]?|[AB]P?_(ORDER|DMAX|\d_\d))"
)


def read_image(path: Path, *, flip: bool | None = None, plane: int | None = None) -> Grey:
    """Read the grey values of an image.

    The FITS standard does not define which row is the top one. Programs that write arrays put the
    top row first, which is what is assumed here; viewers show the first row at the bottom. A
    frame that is read upside down is a mirror image, and no mirror image is ever identified.
    """
    return image_of_content(read_content(path, _IMAGE), flip=flip, plane=plane)


def image_of_content(
    content: FileContent, *, flip: bool | None = None, plane: int | None = None
) -> Grey:
    """Return the grey values of the content of an image, as `read_image` does."""
    path, data, kind = content.path, content.data, content.kind
    if kind is None:
        unread = unread_format(path, data)
        if unread is not None:
            raise ConfigError(
                f"is {unread}, which is not supported",
                where=path,
                hint="convert it to FITS, PNG, TIFF, JPEG, HEIC or BMP",
            )
        raise ConfigError(
            "neither FITS nor PNG, TIFF, JPEG, HEIC or BMP",
            where=path,
            hint="convert it to one of these",
        )
    try:
        if kind == "FITS":
            values, upside_down = _read_fits(data, path, plane)
        elif kind == RAW_PICTURE:
            values, upside_down = _grey_of_raw(data), False
        elif kind == "HEIC":
            values, upside_down = _grey_of_heic(data), False
        else:
            with warnings.catch_warnings(action="ignore"):  # about tags, and about its size
                values, upside_down = _grey_of_picture(data, kind), False
    except ConfigError as error:
        error.at(path)
        raise
    except MemoryError:  # not a fault of the file
        raise
    except Exception as error:  # damaged bytes make either library raise whatever it happens to
        raise ConfigError(f"cannot be read as {kind} ({error})", where=path) from error
    if upside_down if flip is None else flip:
        values = values[::-1]
    if values.dtype.itemsize <= (4 if values.dtype.kind == "f" else 2):
        return np.ascontiguousarray(values, dtype=np.float32)
    return np.ascontiguousarray(values, dtype=np.float64)


def _read_fits(data: bytes, path: Path, plane: int | None) -> tuple[NDArray[Any], bool]:
    """Return the plane of a FITS file, and whether its header puts the first row at the bottom."""
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)  # about headers, as cameras write them
        with fits.open(io.BytesIO(data), memmap=False) as parts:
            shapes = [part.shape if part.is_image else () for part in parts]
            number = _part_of_fits(shapes, plane)
            _log.info("%s: HDU %d of %d (%s)", path, number, len(parts), _shapes_text(shapes))
            check_pixels(shapes[number])
            _check_planes(parts[number])
            values = np.asarray(parts[number].data)
            bottom_up = _is_bottom_up(parts[number].header)
    planes = values.reshape(-1, *values.shape[-2:])
    if plane is not None:
        return planes[plane], bottom_up
    grey = planes[0] if len(planes) == 1 else _luminance(planes)
    return grey, bottom_up


def _check_planes(part: Any) -> None:
    """Refuse a compressed cube whose planes together take too much memory."""
    from astropy.io import fits

    size = abs(int(part.header["BITPIX"])) // 8 * int(np.prod(part.shape, dtype=object))
    if isinstance(part, fits.CompImageHDU) and size > MAX_EXPANDED_FITS_BYTES:
        raise ConfigError(
            f"expands to {size:,} bytes; at most {MAX_EXPANDED_FITS_BYTES:,} are read",
            hint="Cut it",
        )


def _is_bottom_up(header: Header) -> bool:
    return str(header.get("ROWORDER", "")).strip().upper() == "BOTTOM-UP"


def _part_of_fits(shapes: list[tuple[int, ...]], plane: int | None) -> int:
    """Return the HDU to be read: the first of one plane, else the first of three."""
    counts = [
        int(np.prod(shape[:-2])) if len(shape) >= 2 and min(shape) > 0 else 0 for shape in shapes
    ]
    images = [number for number, count in enumerate(counts) if count]
    if plane is not None:
        matches = [number for number in images if 0 <= plane < counts[number]]
        if not matches:
            raise ConfigError(f"{_shapes_text(shapes)}; there is no plane {plane} (from 0)")
        return max(matches, key=lambda number: counts[number] > 1)
    for count in (1, 3):
        for number in images:
            if counts[number] == count:
                return number
    raise ConfigError(
        f"{_shapes_text(shapes)}; expected an image of two dimensions, or three planes of colour",
        hint="choose one plane of a cube, such as {plane:0}",
    )


def _shapes_text(shapes: list[tuple[int, ...]]) -> str:
    return "; ".join(
        f"HDU {number} {'x'.join(map(str, shape)) or 'no image'}"
        for number, shape in enumerate(shapes)
    )


def _grey_of_picture(data: bytes, kind: str) -> NDArray[Any]:
    from PIL import Image, UnidentifiedImageError

    try:
        picture = Image.open(io.BytesIO(data), formats=_OF_PILLOW)
    except UnidentifiedImageError as error:
        raise ConfigError(
            f"begins as {kind}, but is damaged, or a variety that Pillow does not know"
        ) from error
    except Image.DecompressionBombError as error:  # a header with twice Pillow's own limit
        raise ConfigError(
            f"has more than {MAX_PIXELS / 1e6:.0f} million pixels", hint="cut it, or reduce it"
        ) from error
    with picture:
        check_pixels((picture.height, picture.width))
        if getattr(picture, "n_frames", 1) > 1:
            raise ConfigError(f"holds {getattr(picture, 'n_frames', 1)} images; expected one")
        bits, is_negative = _bits(data, picture)
        is_grey = picture.mode in ("L", "I", "F") or picture.mode.startswith("I;16")
        if bits > 8 and not is_grey:
            return _grey_of_many_bits(data, str(picture.format))
        if is_grey:
            values = np.asarray(picture)
            return 65_535 - values if is_negative else values
        # Whole numbers, so that the step of the digits can be found: grey as colour stays as it is.
        # Pillow has the weights of `_LUMINANCE`, and takes a byte a pixel for the result.
        return np.asarray(picture.convert("RGB").convert("L"))


def _grey_of_heic(data: bytes) -> NDArray[Any]:
    try:
        from pi_heif import open_heif
    except ImportError as error:
        raise ConfigError(
            f"HEIC needs the package pi-heif ({error})",
            hint=f"{install_command('images')}, or convert the picture to PNG",
        ) from error
    # Its memory is freed with the picture, whatever arrays still refer to it.
    picture = open_heif(io.BytesIO(data), convert_hdr_to_8bit=False)
    check_pixels(picture.size[::-1])
    values = np.asarray(picture)
    if values.ndim == 2:
        return values.copy()
    return np.rint(_luminance(np.moveaxis(values, 2, 0)))


def _grey_of_raw(data: bytes) -> NDArray[Any]:
    """Return the light of a raw picture: its mosaic of colours above the black level, smoothed."""
    try:
        import rawpy
    except ImportError as error:
        raise ConfigError(
            f"raw pictures of cameras need the package rawpy ({error})",
            hint=f"{install_command('raw')}, or convert the picture to TIFF",
        ) from error
    with rawpy.imread(io.BytesIO(data)) as raw:
        check_pixels((raw.sizes.raw_height, raw.sizes.raw_width))
        values = raw.raw_image_visible.astype(np.float32)
        if values.ndim == 3:  # from a sensor without a mosaic
            return _luminance(np.moveaxis(values, 2, 0))
        values -= np.array(raw.black_level_per_channel, dtype=np.float32)[raw.raw_colors_visible]
    return grey_of_mosaic(values).astype(np.float32)


def _luminance(planes: NDArray[Any]) -> NDArray[np.float32]:
    """Return the grey values of red, green and blue planes, row by row to save memory."""
    grey = np.empty(planes.shape[1:], dtype=np.float32)
    for row, values in enumerate(np.moveaxis(planes[:3], 1, 0)):
        grey[row] = _LUMINANCE @ values
    return grey


def _grey_of_many_bits(data: bytes, kind: str) -> NDArray[Any]:
    """Return the grey values of a colour image of 16 bits, which Pillow would read as 8."""
    try:
        from imagecodecs import png_decode, tiff_decode
    except ImportError as error:
        raise ConfigError(
            f"colour of 16 bits needs the package imagecodecs ({error})",
            hint=install_command("images"),
        ) from error
    values = np.asarray((png_decode if kind == "PNG" else tiff_decode)(data))
    if values.ndim == 3 and values.shape[0] in (3, 4) and values.shape[2] > 4:
        values = np.moveaxis(values, 0, 2)  # each colour by itself
    if values.ndim == 3 and values.shape[2] in (1, 2):
        return np.asarray(values[..., 0])  # beside it is transparency
    if values.ndim != 3 or values.shape[2] not in (3, 4):
        raise ConfigError(f"an image of shape {values.shape}; expected grey or three colours")
    return _luminance(np.moveaxis(values, 2, 0))


def _bits(data: bytes, picture: Any) -> tuple[int, bool]:
    """Return the bits of a value in the file, and whether 16 of them count from white down."""
    if picture.format == "PNG":
        return data[24], False
    if picture.format in ("JPEG", "BMP"):
        return 8, False
    bits = max(picture.tag_v2.get(258, (1,)))  # BitsPerSample
    # Pillow turns 8-bit values around where white is zero, but not 16-bit ones.
    return bits, picture.tag_v2.get(262) == 0 and picture.mode.startswith("I;16")


def time_in_file(path: Path) -> datetime | None:
    """Return the middle of the exposure from a FITS header or EXIF, as UTC; None without one."""
    data = read_content(path, _IMAGE).data
    try:
        moment = _time_of_fits(data) if data.startswith(FITS) else _time_of_exif(data)
    except ConfigError as error:
        error.at(path)
        raise
    except Exception as error:  # damaged bytes make either library raise whatever it happens to
        _log.info("%s: no time can be read (%s)", path, error)
        return None
    return moment


def _time_of_fits(data: bytes) -> datetime | None:
    from astropy.io import fits

    with fits.open(io.BytesIO(data), memmap=False) as parts:
        headers = [part.header for part in parts if "DATE-OBS" in part.header]
        if not headers:
            return None
        return _middle(_start_of_fits(headers[0]), headers[0].get("EXPTIME", 0.0))


_CLOCK_KEYS = ("TIME-OBS", "UTC-OBS", "UT", "UTC", "UTSTART")  # beside a DATE-OBS without hours


def _start_of_fits(header: Any) -> datetime:
    """Return the start of an exposure: DATE-OBS, with the time of day of another key if need be."""
    date = str(header["DATE-OBS"]).strip()
    if "T" not in date and " " not in date:
        clocks = (str(header.get(key, "")).strip() for key in _CLOCK_KEYS)
        clock = next((text for text in clocks if ":" in text), None)
        if clock is None:
            raise ConfigError(
                f"DATE-OBS is {date!r}, a date without a time of day, and the header has none of "
                f"{', '.join(_CLOCK_KEYS)} such as 21:00:00",
                hint="state the time of each frame ({times})",
            )
        date = f"{date}T{clock}"
    return datetime.fromisoformat(date)


def _time_of_exif(data: bytes) -> datetime | None:
    from PIL import Image

    with Image.open(io.BytesIO(data), formats=("PNG", "TIFF", "JPEG")) as picture:
        exif = picture.getexif().get_ifd(0x8769)
    if 0x9003 not in exif:  # DateTimeOriginal
        return None
    text = f"{exif[0x9003]}.{str(exif.get(0x9291, '')).strip() or '0'}"  # SubSecTimeOriginal
    start = datetime.strptime(text, "%Y:%m:%d %H:%M:%S.%f")
    zone = str(exif.get(0x9011, "")).strip()  # OffsetTimeOriginal
    if zone:
        start = datetime.fromisoformat(start.isoformat() + zone)
    return _middle(start, exif.get(0x829A, 0.0))  # ExposureTime


def _middle(start: datetime, exposure_s: Any) -> datetime:
    start = start.replace(tzinfo=UTC) if start.tzinfo is None else start.astimezone(UTC)
    return start + timedelta(seconds=0.5 * float(exposure_s))


def write_image(path: Path, image: NDArray[Any], *, quality: int = 95) -> None:
    """Write an image, the same bytes for the same values."""
    kind = WRITTEN_KINDS.get(path.suffix.lower())
    if kind is None:
        raise ConfigError(f"unknown kind of image; expected {', '.join(WRITTEN_KINDS)}", where=path)
    if image.ndim != 2 or not image.size:
        raise ValueError(f"image of shape {image.shape}; expected two dimensions")
    buffer = io.BytesIO()
    if kind == "FITS":
        _fits_of(image).writeto(buffer)
    else:
        from PIL import Image

        taken = ("uint8",) if kind == "JPEG" else ("uint8", "uint16")
        if image.dtype.name not in taken:
            raise ValueError(f"image of {image.dtype}; {kind} takes {' and '.join(taken)}")
        # The noise of an image takes five times as long at zlib's own level, for no smaller a file.
        options = {"JPEG": {"quality": quality}, "PNG": {"compress_level": 3}}.get(kind, {})
        Image.fromarray(np.ascontiguousarray(image)).save(buffer, format=kind, **options)
    write_file(path, buffer.getvalue())


def without_dark(image: NDArray[Any], dark: NDArray[Any]) -> NDArray[Any]:
    """Return an image without the dark current of its pixels."""
    _check_size(image, dark, "dark frame")
    return np.asarray(np.asarray(image, dtype=np.float64) - dark)


def without_dead_zones(image: NDArray[Any], mask: NDArray[Any]) -> NDArray[Any]:
    """Return an image in which dead pixels have no value."""
    _check_size(image, mask, "mask")
    is_dead = np.asarray(mask) != 0
    if is_dead.all():
        raise ConfigError("the mask leaves no pixel; expected zeros where stars are looked for")
    return np.asarray(np.where(is_dead, np.nan, image), dtype=np.float64)


def grey_of_mosaic(image: NDArray[Any]) -> NDArray[Any]:
    """Return the light of a mosaic of colour filters, at the mosaic's own resolution."""
    grey = np.asarray(image, dtype=np.float64)
    for axis in (0, 1):
        grey = scipy.ndimage.convolve1d(grey, _BINOMIAL, axis=axis, mode="mirror")
    return np.asarray(grey)


def _check_size(image: NDArray[Any], other: NDArray[Any], what: str) -> None:
    if image.shape != other.shape:
        (height, width), (tall, wide) = image.shape, other.shape
        raise ConfigError(
            f"the {what} has {wide} x {tall} px, the image {width} x {height}; expected the same"
        )


def check_wcs_name(path: Path | None) -> None:
    """Refuse a name that is not of a FITS file, before the work for it is done."""
    if path is not None and path.suffix.lower() not in _WCS_SUFFIXES:
        raise ConfigError(
            "expected a FITS file, whose name ends with .fits", parameter="wcs", value=str(path)
        )


def write_wcs(
    path: Path, source: Path, image: NDArray[Any], result: MatchResult, *, flip: bool | None = None
) -> None:
    """Write a FITS copy of a picture with the world coordinates of its answer."""
    from astropy.utils.exceptions import AstropyWarning

    data = read_content(source, _IMAGE).data
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)  # about headers, as cameras write them
        if data.startswith(FITS):
            _copy_fits(data, result, flip, buffer)
        else:
            part = _fits_of(image)
            _add_wcs(part.header, result, bottom_up=False)
            part.writeto(buffer)
    write_file(path, buffer.getvalue())


def wcs_header(result: MatchResult, source: Path, *, flip: bool | None = None) -> bytes:
    """Return a FITS header alone, with the world coordinates that were found for a frame."""
    from astropy.io import fits

    camera, header = result.camera, fits.PrimaryHDU().header
    header["NAXIS"], header["NAXIS1"], header["NAXIS2"] = 2, 0, 0  # two axes, and no data
    if camera is not None:
        header["IMAGEW"] = (camera.width_px, "width of the frame, pixels")
        header["IMAGEH"] = (camera.height_px, "height of the frame, pixels")
    bottom_up = bool(flip)
    data = read_content(source, _IMAGE).data
    if data.startswith(FITS) and flip is None:
        with fits.open(io.BytesIO(data), memmap=False) as parts:
            bottom_up = _is_bottom_up(_image_part(parts).header)
    _add_wcs(header, result, bottom_up)
    return str(header.tostring()).encode("ascii")


def _image_part(parts: HDUList) -> Any:
    """Return the first part of a FITS file that is an image."""
    return next(
        part for part in parts if part.is_image and len(part.shape) >= 2 and min(part.shape) > 0
    )


def _copy_fits(data: bytes, result: MatchResult, flip: bool | None, buffer: io.BytesIO) -> None:
    from astropy.io import fits

    # Values stay as they are stored, whatever the scale of the file.
    with fits.open(io.BytesIO(data), memmap=False, do_not_scale_image_data=True) as parts:
        part = _image_part(parts)
        bottom_up = _is_bottom_up(part.header) if flip is None else flip
        for key in [key for key in part.header if _OF_A_WCS.fullmatch(key)]:
            del part.header[key]
        _add_wcs(part.header, result, bottom_up)
        parts.writeto(buffer, output_verify="silentfix+ignore")


def _fits_of(image: NDArray[Any]) -> PrimaryHDU:
    from astropy.io import fits

    part = fits.PrimaryHDU(np.ascontiguousarray(image))
    part.header["ROWORDER"] = ("TOP-DOWN", "the first row is the top one")
    return part


def _add_wcs(header: Header, result: MatchResult, bottom_up: bool) -> None:
    """Add the keywords of a WCS, including SIP, which is not in the standard."""
    for card in result.wcs(bottom_up=bottom_up).to_header(relax=True).cards:
        if not card.keyword.startswith("MJDREF"):  # there is no time of observation
            header.append(card, end=True)
