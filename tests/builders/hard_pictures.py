"""Rendered pictures that are hard to measure, of the embedded sky: twenty of each kind.

Every picture has 1024 x 1024 px over 12 deg and shows all stars to G = 10; the guide stars of the
preset gaia-12deg reach G = 6.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from starcat.catalog.archives.gaia import embedded_sky
from starcat.catalog.ingest import ingest_catalog
from starcat.catalog.stars.star_table import floats_of
from starcat.frames.images.image_file import write_image
from starcat.frames.images.render import Optics, render_image, star_electrons
from starcat.frames.images.solve_files import answer_file
from starcat.geometry.attitude import matrix_from_quaternion, random_attitudes
from starcat.geometry.camera import Camera
from starcat.geometry.sphere import directions_from_radec
from starcat.matcher.matcher import Matcher

Array = NDArray[np.float64]
Rng = np.random.Generator

RIGHT_PX = 3.0
"""A right attitude puts no corner of the frame farther from its place."""


@dataclass(frozen=True)
class Scene:
    """The sky behind the stars, and the part of it that a file keeps."""

    # electrons of the gradient in the brightest corner or at the brightest edge; it is a tenth of
    # that on the opposite side
    town_light_e: float = 0.0
    town_light_deg: float = 90.0  # direction in which it becomes brighter: 0 to the right, 90 down
    moon_px: tuple[float, float] | None = None  # middle of the Moon; it may be outside of the frame
    moon_radius_px: float = 22.0  # radius of its disk, which fills the well
    glow_e: float = 0.0  # electrons of its glow at the edge of the disk
    glow_px: float = 60.0  # distance from the Moon's middle at which the glow is half as bright
    nebula_e: float = 0.0  # standard deviation of nebulous light, electrons
    nebula_px: float = 20.0  # size of its structure
    black_adu: float = 0.0  # step of the detector that is 0 in the file: darker values are lost
    adu_per_step: float = 1.0  # steps of the detector in a step of the file
    bits: int = 16  # 8 or 16: values above the largest number are lost


def scene_light(scene: Scene, camera_size: tuple[int, int], full_well_e: float, seed: int) -> Array:
    """Return the mean number of electrons that a scene adds to the background."""
    width, height = camera_size
    y, x = np.mgrid[:height, :width] + 0.5
    light = np.zeros((height, width))
    if scene.town_light_e:
        direction = np.radians(scene.town_light_deg)
        along = np.cos(direction) * (x - 0.5 * width) + np.sin(direction) * (y - 0.5 * height)
        part = (along - along.min()) / (along.max() - along.min())
        light += scene.town_light_e * 10.0 ** (part - 1.0)
    if scene.moon_px is not None:
        distance = np.hypot(x - scene.moon_px[0], y - scene.moon_px[1])
        light += scene.glow_e / (1.0 + (distance / scene.glow_px) ** 2)
        light[distance < scene.moon_radius_px] += 2.0 * full_well_e
    if scene.nebula_e:
        noise = np.random.default_rng(seed).normal(size=(height, width))
        cloud = gaussian_filter(noise, scene.nebula_px, mode="wrap")
        light += np.maximum(scene.nebula_e * (cloud / cloud.std() + 1.0), 0.0)
    return light


def in_file_steps(adu: np.ndarray, scene: Scene) -> np.ndarray:
    """Return an image of a detector as the file of a camera has it."""
    steps = np.rint((adu.astype(np.float64) - scene.black_adu) / scene.adu_per_step)
    return np.clip(steps, 0, 2**scene.bits - 1).astype(np.uint8 if scene.bits == 8 else np.uint16)


@dataclass(frozen=True)
class Picture:
    """The camera and file of a picture; JPEG quality if it is a JPEG file."""

    optics: Optics
    scene: Scene
    quality: int | None = None
    turn_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the camera during the exposure
    haze_mag: float = 0.0  # what haze takes of the stars; a part of that is spread around them
    mesh_px: float = 0.0  # distance of the spots that a mesh before the lens adds to each star


def _optics(rng: Rng, widest_px: float = 2.0, **changes: float | int) -> Optics:
    return Optics(**{"psf_sigma_px": rng.uniform(0.7, widest_px), **changes})


def _eight_bits(rng: Rng, coarsest_e: float = 20.0, **changes: object) -> Scene:
    return Scene(
        **{"bits": 8, "black_adu": 100.0, "adu_per_step": rng.uniform(4.0, coarsest_e), **changes}
    )


def _jpeg(rng: Rng) -> Picture:
    return Picture(_optics(rng), _eight_bits(rng, 12.0), 60)


def _clipped(rng: Rng) -> Picture:
    # 100 of bias and 20 of background; their noise is 9.
    return Picture(_optics(rng), _eight_bits(rng, black_adu=120.0 + 9.0 * rng.uniform(0.0, 3.0)))


def _gradient(rng: Rng) -> Picture:
    light, toward = 10.0 ** rng.uniform(2.0, 3.3), rng.uniform(0.0, 360.0)
    bits = int(rng.choice([8, 16]))
    step = 12.0 if bits == 8 else 1.0
    scene = Scene(light, toward, bits=bits, adu_per_step=step, black_adu=0.0 if bits == 16 else 100)
    return Picture(_optics(rng), scene)


def _moon(rng: Rng) -> Picture:
    place = rng.uniform(-80.0, 1104.0, 2)
    glow = 10.0 ** rng.uniform(2.7, 4.0)
    moon = Scene(moon_px=(place[0], place[1]), glow_e=glow, glow_px=rng.uniform(40.0, 120.0))
    return Picture(_optics(rng), moon)


def _spots(rng: Rng) -> Picture:
    optics = _optics(rng, 4.0)
    return Picture(optics, _eight_bits(rng, 8.0) if rng.uniform() < 0.5 else Scene())


KINDS: dict[str, Callable[[Rng], Picture]] = {
    "8 bits": lambda rng: Picture(_optics(rng), _eight_bits(rng)),
    "JPEG 60": _jpeg,
    "clipped": _clipped,
    "gradient": _gradient,
    "Moon": _moon,
    "hot pixels": lambda rng: Picture(
        _optics(rng, hot_pixels=int(10.0 ** rng.uniform(2.5, 4.0))), Scene()
    ),
    "0.7 to 4 px": _spots,
}
"""The kinds of the acceptance."""

MORE_KINDS: dict[str, Callable[[Rng], Picture]] = {
    "nebula": lambda rng: Picture(
        _optics(rng),
        _eight_bits(rng, nebula_e=rng.uniform(50.0, 300.0), nebula_px=rng.uniform(6.0, 40.0)),
    ),
    "JPEG of nebula": lambda rng: Picture(
        _optics(rng),
        _eight_bits(rng, 10.0, nebula_e=rng.uniform(30.0, 100.0), nebula_px=rng.uniform(6, 40)),
        60,
    ),
    "clean": lambda rng: Picture(_optics(rng), Scene()),
}


ZERO_POINT_E_S, SKY_E_S = 6e6, 200.0  # per second, with the default optics, which expose 0.1 s


def _exposed(rng: Rng, exposure_s: float, **changes: float | int) -> Optics:
    light = {"zero_point_e": ZERO_POINT_E_S * exposure_s, "background_e": SKY_E_S * exposure_s}
    return _optics(rng, **{**light, **changes})


def streaked(rng: Rng, rate_deg_s: float, exposure_s: float) -> Picture:
    """Take a picture while the camera turns about a random axis."""
    axis = rng.normal(size=3)
    turn = rate_deg_s * exposure_s * axis / np.linalg.norm(axis)
    return Picture(_exposed(rng, exposure_s), Scene(), turn_deg=(turn[0], turn[1], turn[2]))


def _streaks(rng: Rng) -> Picture:
    rate, exposure = (10.0 ** rng.uniform(*np.log10(ends)) for ends in ((0.1, 3.0), (0.05, 1.0)))
    return streaked(rng, rate, exposure)


def _haze(rng: Rng) -> Picture:
    lost = rng.uniform(0.5, 2.5)
    scene = Scene(town_light_e=10.0 ** rng.uniform(2.0, 3.3), town_light_deg=rng.uniform(0, 360))
    return Picture(_optics(rng), scene, haze_mag=lost)


def _moonlight(rng: Rng) -> Picture:
    away, toward = rng.uniform(700.0, 2500.0), rng.uniform(0.0, 2.0 * np.pi)
    place = 512.0 + away * np.array([np.cos(toward), np.sin(toward)])
    scene = Scene(moon_px=(place[0], place[1]), glow_e=10.0 ** rng.uniform(3.5, 4.5), glow_px=400.0)
    return Picture(_exposed(rng, 0.1, background_e=10.0 ** rng.uniform(2.5, 3.7)), scene)


def _mesh(rng: Rng) -> Picture:
    return Picture(_optics(rng), Scene(), mesh_px=rng.uniform(4.0, 20.0))


def _faint_among_hot(rng: Rng) -> Picture:
    optics = _optics(
        rng, hot_pixels=int(10.0 ** rng.uniform(3.3, 4.3)), zero_point_e=rng.uniform(5e4, 1.5e5)
    )
    return Picture(optics, Scene())


NIGHT_KINDS: dict[str, Callable[[Rng], Picture]] = {
    "streaks": _streaks,
    "haze": _haze,
    "moonlight": _moonlight,
    "mesh": _mesh,
    "faint among hot pixels": _faint_among_hot,
}
"""What nights have, and cameras that turn."""

MESH_OPEN = 0.75
"""Part of a mesh's period, along each axis, that lets light through."""


def mesh_spots(centroids_px: Array, mag: Array, pitch_px: float) -> tuple[Array, Array]:
    """Return the orders of diffraction behind a square mesh, turned by 20 deg, as spots."""
    orders = np.arange(-3, 4)
    part = (MESH_OPEN * np.sinc(MESH_OPEN * orders)) ** 2
    m, n = (grid.ravel() for grid in np.meshgrid(orders, orders))
    turned = np.radians(20.0)
    x, y = m * np.cos(turned) - n * np.sin(turned), m * np.sin(turned) + n * np.cos(turned)
    places = centroids_px[:, None] + pitch_px * np.stack([x, y], axis=1)
    fainter = -2.5 * np.log10(np.outer(part, part).ravel())
    spots, mags = places.reshape(-1, 2), (mag[:, None] + fainter).ravel()
    seen = mags < FAINTEST_MAG
    return spots[seen], mags[seen]


FAINTEST_MAG = 9.0
"""Of stars that are drawn many times: at all times of an exposure, or in all orders of a mesh."""

HALO_PART, HALO_PX = 0.5, 25.0
"""Share of the scattered light of a star that forms a halo around it, and the halo's radius."""


def _drawn(
    picture: Picture, body: Array, mag: Array, camera: Camera
) -> tuple[Array, Array, Array | None]:
    """Return places and magnitudes of the spots of light of a picture, and haze around them."""
    places = camera.pixels_from_directions(body)
    if picture.haze_mag:
        size, lost = (camera.width_px, camera.height_px), 1.0 - 10.0 ** (-0.4 * picture.haze_mag)
        stars = star_electrons(places, mag, size, picture.optics)
        return places, mag + picture.haze_mag, gaussian_filter(HALO_PART * lost * stars, HALO_PX)
    bright = mag < FAINTEST_MAG
    if picture.mesh_px:
        return *mesh_spots(places[bright], mag[bright], picture.mesh_px), None
    turn = np.radians(picture.turn_deg)
    if not turn.any():
        return places, mag, None
    # The attitude of a picture is its attitude at the middle of the exposure.
    count = int(np.ceil(2.0 * np.linalg.norm(turn) * camera.focal_length_px)) + 25
    parts = [
        camera.pixels_from_directions(Rotation.from_rotvec(part * turn).apply(body[bright]))
        for part in (np.arange(count) + 0.5) / count - 0.5
    ]
    return np.concatenate(parts), np.tile(mag[bright] + 2.5 * np.log10(count), count), None


@cache
def sky() -> tuple[Array, Array]:
    """Directions and magnitudes of all stars of the embedded sky."""
    stars = ingest_catalog("gaia", [embedded_sky()], neighbours=False).stars
    ra, dec = floats_of(stars, "ra_deg"), floats_of(stars, "dec_deg")
    return directions_from_radec(ra, dec), floats_of(stars, "mag")


@dataclass(frozen=True)
class Taken:
    """A picture in a file, and the truth about it."""

    kind: str
    number: int
    path: Path
    matrix: Array
    picture: Picture
    centroids_px: Array
    mag: Array


def take(kind: str, number: int, camera: Camera, folder: Path) -> Taken:
    """Render one picture and write it."""
    kinds = KINDS | MORE_KINDS | NIGHT_KINDS
    rng = np.random.default_rng([2026, list(kinds).index(kind), number])
    return take_picture(kinds[kind](rng), kind, number, rng, camera, folder)


def take_picture(
    picture: Picture, kind: str, number: int, rng: Rng, camera: Camera, folder: Path
) -> Taken:
    """Render a picture at a random attitude and write it."""
    matrix = random_attitudes(1, rng)[0]
    directions, mag = sky()
    body = directions @ matrix.T
    near = np.flatnonzero(body[:, 2] > np.cos(0.6 * camera.diagonal_rad))
    places = camera.pixels_from_directions(body[near])
    size, seed = (camera.width_px, camera.height_px), int(rng.integers(2**31))
    light = scene_light(picture.scene, size, picture.optics.full_well_e, seed)
    spots, spot_mag, around = _drawn(picture, body[near], mag[near], camera)
    if around is not None:
        light += around
    adu = render_image(spots, spot_mag, size, picture.optics, seed, light)
    image = in_file_steps(adu, picture.scene)
    suffix = ".png" if picture.quality is None else ".jpg"
    path = folder / f"{kind} {number}{suffix}".replace(" ", "_")
    write_image(path, image, **({} if picture.quality is None else {"quality": picture.quality}))
    return Taken(kind, number, path, matrix, picture, places, mag[near])


def worst_px(taken: Taken, q_body_from_icrs: Array, camera: Camera) -> float:
    """How far an attitude puts a corner of the frame from its place, pixels."""
    width, height = camera.width_px, camera.height_px
    corners = np.array([(0, 0), (width, 0), (0, height), (width, height)], dtype=np.float64)
    icrs = camera.directions_from_pixels(corners) @ taken.matrix
    there = camera.pixels_from_directions(icrs @ matrix_from_quaternion(q_body_from_icrs).T)
    return float(np.hypot(*(there - corners).T).max())


def verdict(matcher: Matcher, taken: Taken) -> str:
    """``right``, ``wrong`` or the status, as the command would find it without an option."""
    camera = matcher.database.camera
    [answer] = answer_file(taken.path, matcher)
    result = answer.result
    if result.status != "identified":
        return result.status
    return "right" if worst_px(taken, result.q_body_from_icrs, camera) < RIGHT_PX else "wrong"


def verdicts(
    matcher: Matcher, folder: Path, count: int, kinds: list[str]
) -> Iterator[tuple[Taken, str]]:
    """Take and identify pictures of each kind, and delete them."""
    for kind in kinds:
        for number in range(count):
            taken = take(kind, number, matcher.database.camera, folder)
            yield taken, verdict(matcher, taken)
            taken.path.unlink()
