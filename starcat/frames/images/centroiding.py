"""Spots of light in an image: found above the background and measured with sub-pixel accuracy.

The input is a grey image, the output is centroids and brightness, brightest first. Background,
detection, windowed centroids and apertures are computed by sep, Source Extractor as a library,
which the extra ``images`` installs. Stars that are streaks are measured at their middles
(`streaks.py`); blooming is not handled.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import convolve1d

from starcat.arrays import Array, Mask, Pixels, Rows
from starcat.database.products.blends import APERTURE_SIGMA, widths_px
from starcat.errors import ConfigError
from starcat.frames.images.background import (
    SkyLevels,
    load_sep,
    mask_hot_pixels,
    pixels_around,
    repair_hot_pixels,
    subtract_background,
    unmasked,
)
from starcat.frames.images.spots import (
    SIGMA_RANGE_PX,
    centroid_sigma_px,
    electrons_per_step,
    is_sharp,
    noise_at,
    sigma_of_stars,
    undo_border,
)
from starcat.frames.images.streaks import Streak, measured_streaks, refined, streak_of

_log = logging.getLogger(__name__)

# Size of sep's buffer for pixels above the threshold: this number plus the first of these parts of
# the image, or the second if the first is full. sep allocates about 40 bytes for each pixel.
_ROOM, _ROOM_PARTS = 300_000, (0.03, 0.3)
_ROOM_IS_FULL = "pixel buffer full"  # part of the error of sep
_MAX_PARTS = 4096  # parts that sep may divide an object into: a Moon with its glow has thousands
# If the buffer is too small, the threshold is raised by this factor, up to this many tries.
_RAISE, _TRIES = 1.5, 4
# A plateau: pixels that differ by no more than read noise, and by half a per cent.
_PLATEAU_NOISE, _PLATEAU_DEPTH, _PLATEAU_PIXELS = 6.0, 0.005, 3


@dataclass(frozen=True)
class Spots:
    """The spots of one image, brightest first."""

    # shape (N, 2): pixels (x right, y down, origin at the outer corner of the top-left pixel)
    centroids_px: Pixels
    flux: Array  # shape (N,): light above the background, in the units of the image
    mag: Array  # shape (N,): instrumental magnitude, -2.5 log10 flux: its zero point is unknown
    # shape (N,): standard error of a centroid on each axis, pixels
    sigma_px: Array
    psf_sigma_px: float  # standard deviation of a star's spot before the pixels sample it
    streak: Streak | None = None  # motion of the stars during the exposure

    def __len__(self) -> int:
        return len(self.flux)

    def at(self, rows: Any) -> Spots:
        """Return some of the spots: of row numbers, a mask or a slice."""
        columns = ("centroids_px", "flux", "mag", "sigma_px")
        return replace(self, **{name: getattr(self, name)[rows] for name in columns})


def find_spots(
    image: ArrayLike,
    *,
    threshold_sigma: float = 5.0,
    psf_sigma_px: float | None = None,
    most_spots: int | None = None,
    gain_e_per_adu: float | None = None,
    without_hot_pixels: bool = False,
) -> Spots:
    """Find the spots of an image and measure them.

    ``gain_e_per_adu``, the electrons of one step of the image, is for the errors of the
    centroids; by default it is judged from the noise of the sky. ``without_hot_pixels`` is for
    images with many of them, and costs stars that are as narrow as a pixel. Bertin and Arnouts
    1996, A&AS 117, 393. Barbary 2016, JOSS 1 (6), 58.
    """
    arguments = {"threshold_sigma": threshold_sigma, "psf_sigma_px": psf_sigma_px}
    arguments["gain_e_per_adu"] = gain_e_per_adu
    for name, value in {**arguments, "most_spots": most_spots}.items():
        if value is not None and not 0.0 < value < np.inf:
            raise ConfigError("expected a positive number", parameter=name, value=value)
    # The intermediate result has no name, so that its memory is freed: it is as large as `levels`.
    if without_hot_pixels:
        levels = mask_hot_pixels(subtract_background(image))
    else:
        levels = subtract_background(image)
    gain = gain_e_per_adu or electrons_per_step(levels)
    sigma = psf_sigma_px
    if sigma is None:
        levels = repair_hot_pixels(levels, SIGMA_RANGE_PX[0])
        first = detect(levels, 1.0, threshold_sigma)
        first = first[~_is_saturated(levels, first)]
        streak = streak_of(first, levels.raw.shape)
        if streak is not None:
            return _streaked(levels, streak, threshold_sigma, gain, most_spots)
        sigma = sigma_of_stars(levels, np.stack([first["x"], first["y"]], axis=1), first["peak"])
    levels = repair_hot_pixels(levels, sigma)
    detections = detect(levels, float(sigma), threshold_sigma)
    if psf_sigma_px is None:
        places = np.stack([detections["x"], detections["y"]], axis=1)
        detections = detections[~is_sharp(levels, places, float(sigma))]
    return _measured(levels, detections, float(sigma), gain, most_spots)


def _streaked(
    levels: SkyLevels, streak: Streak, threshold: float, gain: float, most: int | None
) -> Spots:
    for is_final in (False, True):
        filtered, noise = streak.filtered(levels)
        detections = extract(filtered, threshold, noise, levels.mask)
        if not is_final:
            first = detections[np.argsort(-detections["peak"], kind="stable")]
            places = np.stack([first["xpeak"], first["ypeak"]], axis=1).astype(np.float64)
            streak = refined(levels, streak, places)
    centroids, flux, sigma_px = measured_streaks(levels, filtered, detections, streak, gain)
    return _in_order(centroids, flux, sigma_px, streak.psf_sigma_px, most, streak)


def _measured(
    levels: SkyLevels, detections: NDArray[Any], sigma: float, gain: float, most: int | None
) -> Spots:
    widths = widths_px(sigma)
    seen, window = widths.spot, widths.window
    centroids = _windowed(levels, detections, window)
    x, y = (centroids - 0.5).T
    radius = APERTURE_SIGMA * seen
    part, _, _ = load_sep().sum_circle(levels.above, x, y, radius, mask=levels.mask, subpix=0)
    flux, growth = part / (1.0 - np.exp(-0.5 * APERTURE_SIGMA**2)), np.ones(len(part))
    for axis, length_px in enumerate(levels.raw.shape[::-1]):
        place = centroids[:, axis]
        is_far = place > 0.5 * length_px
        depth = np.where(is_far, length_px - place, place)
        depth, larger, share = undo_border(depth, sigma, window)
        centroids[:, axis] = np.where(is_far, length_px - depth, depth)
        flux, growth = flux / share, np.maximum(growth, larger)
    sigma_px = growth * centroid_sigma_px(flux, noise_at(levels, centroids), seen, gain, window)
    return _in_order(centroids, flux, sigma_px, sigma, most)


def _in_order(
    centroids: Array,
    flux: Array,
    sigma_px: Array,
    psf_sigma_px: float,
    most: int | None,
    streak: Streak | None = None,
) -> Spots:
    order = brightest_first(flux, centroids)[: np.count_nonzero(flux > 0.0)][:most]
    mag = -2.5 * np.log10(flux[order])
    return Spots(centroids[order], flux[order], mag, sigma_px[order], psf_sigma_px, streak)


def brightest_first(flux: Array, centroids_px: Pixels) -> NDArray[np.int64]:
    """Return the order of spots."""
    return np.lexsort((centroids_px[:, 1], centroids_px[:, 0], -flux))


def _is_saturated(levels: SkyLevels, detections: NDArray[Any]) -> Mask:
    """Return which spots have a plateau at the image's maximum."""
    around = pixels_around(levels.raw, detections["xpeak"], detections["ypeak"])
    read_noise = _PLATEAU_NOISE * float(np.median(levels.noise))
    depth = min(read_noise, _PLATEAU_DEPTH * float(levels.above.max()))
    at_limit = around >= float(unmasked(levels.raw, levels.mask).max()) - depth
    return np.asarray(at_limit.sum(axis=(1, 2)) >= _PLATEAU_PIXELS)


def _windowed(levels: SkyLevels, detections: NDArray[Any], window: float) -> Array:
    """Return windowed centroids; a barycentre if the window drifts to a neighbouring spot.

    The window of a spot that the border cuts drifts, too: towards the middle of the spot.
    """
    start = np.stack([detections["x"], detections["y"]], axis=1)
    x, y, _ = load_sep().winpos(levels.above, *start.T, window, mask=levels.mask, subpix=0)
    centroids = np.stack([x, y], axis=1)
    merged, cut = load_sep().OBJ_MERGED, load_sep().OBJ_TRUNC
    is_blended = (detections["flag"] & (merged | cut)) == merged
    drifts = is_blended & (np.hypot(*(centroids - start).T) > 0.5 * window)
    # sep counts from the centre of the first pixel.
    return np.asarray(np.where(drifts[:, None], start, centroids) + 0.5, dtype=np.float64)


def centres_of_mass(light: Array, places: Pixels, box_px: int) -> Pixels:
    """Return the centres of mass in boxes around the brightest pixels within 1 px of places.

    ``light`` has no background, shape (rows, columns); pixels outside of it are dark.
    """
    half = box_px // 2
    dark = np.pad(light, half + 1)
    middle = np.floor(places).astype(np.int64) + half + 1  # column and row

    def around(centre: Rows, reach: int) -> Array:
        steps = np.arange(-reach, reach + 1)
        rows = np.clip(centre[:, 1, None] + steps, 0, dark.shape[0] - 1)
        columns = np.clip(centre[:, 0, None] + steps, 0, dark.shape[1] - 1)
        return np.asarray(dark[rows[:, :, None], columns[:, None, :]])

    brightest = around(middle, 1).reshape(len(places), -1).argmax(axis=1)
    down, right = np.divmod(brightest, 3)
    middle = middle + np.stack([right, down], axis=1) - 1
    box, steps = around(middle, half), np.arange(-half, half + 1)
    total = box.sum(axis=(1, 2))
    moved = [np.einsum("ijk,k->i", box, steps), np.einsum("ijk,j->i", box, steps)]
    return np.asarray(middle - half - 1 + 0.5 + np.stack(moved, axis=1) / total[:, None])


def detect(levels: SkyLevels, sigma: float, threshold: float) -> NDArray[Any]:
    """Return the spots that stand out after smoothing with a star's shape.

    If the noise is white, the part of it that the filter leaves is known. If it is not
    (`SkyLevels.is_rough`: coarse digits, a clipped background, JPEG, clouds), the noise is
    measured in the filtered image.
    """
    reach = np.arange(-int(np.ceil(2.5 * sigma)), int(np.ceil(2.5 * sigma)) + 1)
    profile = np.exp(-0.5 * (reach / sigma) ** 2)
    profile /= profile.sum()
    kernel: Array | None = np.outer(profile, profile)
    image, noise, least = levels.above, levels.noise, threshold * float((profile**2).sum())
    if levels.is_rough:
        image, noise = _filtered(levels, profile)
        least, kernel = threshold, None
    for attempt in range(_TRIES):
        try:
            return extract(image, least * _RAISE**attempt, noise, levels.mask, kernel)
        except MemoryError:  # not a fault of the image
            raise
        except Exception as error:  # sep raises nothing more special when a buffer is full
            _log.info("at %.3g sigma: %s", threshold * _RAISE**attempt, error)
    further = np.ceil(threshold * _RAISE**_TRIES)
    raise ConfigError(
        f"the image has too much in it to separate stars from the sky: even at "
        f"{threshold * _RAISE ** (_TRIES - 1):.1f} times the noise too many pixels stand out",
        hint=(
            "check that it is a star image",
            "state how wide a star is ({psf_sigma_px:1.5})",
            f"raise the threshold further ({{threshold:{further:.0f}}})",
        ),
    )


def extract(
    image: NDArray[np.float32],
    least: float,
    noise: NDArray[np.float32],
    mask: Mask,
    kernel: Array | None = None,
) -> NDArray[Any]:
    """Call sep.

    Filter "conv" with the threshold in units of the smoothed noise, and no cleaning: sep's
    matched filter followed by its cleaning loses real stars (docs/decisions.md).
    """
    sep = load_sep()
    before = sep.get_extract_pixstack(), sep.get_sub_object_limit()
    sep.set_sub_object_limit(_MAX_PARTS)
    try:
        for part in _ROOM_PARTS:
            sep.set_extract_pixstack(_ROOM + int(part * image.size))
            try:
                detections = sep.extract(
                    image, least, err=noise, mask=mask, minarea=1, clean=False,
                    filter_kernel=kernel, filter_type="conv",
                )  # fmt: skip
                break
            except Exception as error:  # sep raises nothing more special
                if part == _ROOM_PARTS[-1] or _ROOM_IS_FULL not in str(error):
                    raise
        return np.asarray(detections)
    finally:
        sep.set_extract_pixstack(before[0])
        sep.set_sub_object_limit(before[1])


def _filtered(levels: SkyLevels, profile: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the filtered image above its own background, and its own noise."""
    image = convolve1d(levels.above, profile, axis=0, mode="nearest")
    image = convolve1d(image, profile, axis=1, mode="nearest")
    box = {"bw": min(levels.box_px, image.shape[1]), "bh": min(levels.box_px, image.shape[0])}
    background = load_sep().Background(image, mask=levels.mask, **box)
    noise = background.rms(dtype=np.float32)
    part = np.float32((profile**2).sum())
    for row, sky_noise in zip(noise, levels.noise, strict=True):
        np.maximum(row, part * sky_noise, out=row)
    image -= background.back(dtype=np.float32)
    return image, noise
