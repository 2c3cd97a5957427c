"""Databases in the files of other solvers: read back by their formats, and solved with."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from itertools import combinations, count
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS
from rendered import picture_of
from scipy.spatial.transform import Rotation

from starcat.database.reader import open_database_folder
from starcat.errors import ConfigError, OutputError
from starcat.geometry.attitude import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    radec_roll_from_matrix,
)
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.matcher.database import open_database
from starcat.pipeline.simulation.simulate import Noise, simulate_frames
from starcat.ship.exchange.formats import SOLVER_FORMATS
from starcat.ship.exchange.solvers import astap, lost
from starcat.ship.exchange.solvers.programs import write_astrometry_net
from starcat.ship.exchange.solvers.sky import SolverSky, sky_of
from starcat.ship.exchange.solvers.write import ExportedSolver, export_solver
from starcat.storage.atomic import file_sha256

PROGRAMS = {"astrometry-net": "build-astrometry-index"}
"""What writes the files of a solver, where we do not."""


@pytest.fixture(scope="module")
def sky(small_database) -> SolverSky:
    """What the files of the small database are made of."""
    return sky_of(open_database_folder(small_database))


@pytest.fixture(scope="module")
def exported(small_database, tmp_path_factory):
    """Export the small database, each solver's once."""
    made = {}

    def exported_of(solver: str) -> Path:
        program = PROGRAMS.get(solver)
        if program and shutil.which(program) is None:
            pytest.skip(f"{program} is not installed")
        if solver not in made:
            folder = tmp_path_factory.mktemp("solver") / solver
            made[solver] = export(small_database, solver, folder)
        return made[solver].folder / made[solver].main

    return exported_of


def export(database: Path, solver: str, folder: Path) -> ExportedSolver:
    """Export a database whose fields are wider than ASTAP's search takes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(astap, "WIDEST_DEG", 90.0)
        return export_solver(database, solver, folder)


@pytest.mark.parametrize("solver", SOLVER_FORMATS)
def test_a_folder_says_what_its_files_are_of(solver, exported, sky, small_database):
    main = exported(solver)
    facts = json.loads((main.parent / "provenance.json").read_text())
    assert facts["manifest_sha256"] == file_sha256(small_database / "manifest.json")
    assert (facts["stars"], facts["epoch_jyear"]) == (len(sky.mag), sky.epoch_jyear)
    for name, digest in facts["sha256"].items():
        assert file_sha256(main.parent / name) == digest
    with (main.parent / "stars.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["star_id"]) for row in rows] == sky.star_id.tolist()
    assert [float(row["mag"]) for row in rows] == sorted(sky.mag.tolist())


def test_an_export_replaces_only_its_own_files(small_database, tmp_path):
    final = tmp_path / "solver"
    export_solver(small_database, "tetra3", final)
    (final / "stars.csv").unlink()
    (final / "stars.csv").write_text("changed")
    export_solver(small_database, "tetra3", final, replace=True)
    assert (final / "stars.csv").read_text() != "changed"
    (final / "notes.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"starcat did not write: notes\.txt"):
        export_solver(small_database, "tetra3", final, replace=True)
    assert [path.name for path in tmp_path.iterdir()] == ["solver"]


@pytest.mark.parametrize("solver", ["tetra3", "lost", "astap"])
def test_what_we_write_is_the_same_every_time(solver, exported, small_database, tmp_path):
    first = exported(solver).parent
    again = export(small_database, solver, tmp_path / "again").folder
    names = sorted(path.relative_to(first) for path in first.rglob("*") if path.is_file())
    assert names == sorted(path.relative_to(again) for path in again.rglob("*") if path.is_file())
    for name in names:
        assert (first / name).read_bytes() == (again / name).read_bytes(), name


@pytest.mark.parametrize("solver", ["tetra3", "cedar-solve"])
class TestTetra:
    """The npz file of tetra3 and cedar-solve."""

    def test_its_stars_are_those_of_the_database(self, solver, exported, sky):
        with np.load(exported(solver)) as file:
            ids, table = file["star_catalog_IDs"].astype(np.int64), file["star_table"]
            assert float(file["props_packed"]["epoch_proper_motion"]) == sky.epoch_jyear
        order, own = np.argsort(sky.star_id), np.argsort(ids)
        assert ids[own].tolist() == sky.star_id[order].tolist()
        assert separation(table[own, 2:5].astype(float), sky.directions[order]).max() < 1e-6

    def test_a_pattern_is_found_by_its_shape(self, solver, exported):
        """By whole numbers of any size and one step after the other, as its authors say it."""
        with np.load(exported(solver)) as file:
            table, catalog = file["star_table"].astype(float), file["pattern_catalog"]
            largest_mrad, facts = file["pattern_largest_edge"], file["props_packed"]
        filled = np.flatnonzero(catalog.any(axis=1))
        assert len(filled) == int(facts["num_patterns"])
        for row in np.random.default_rng(1).choice(filled, 300):
            u = table[catalog[row], 2:5]
            sides = sorted(2 * np.arcsin(np.linalg.norm(a - b) / 2) for a, b in combinations(u, 2))
            bins = int(facts["pattern_bins"])
            key = sum(int(side / sides[-1] * bins) * bins**n for n, side in enumerate(sides[:-1]))
            start = key * 2654435761 % 2**64 % len(catalog)
            tried = []
            for step in count():
                tried.append((start + step * step) % len(catalog))
                if not catalog[tried[-1]].any():
                    break
            assert row in tried
            assert largest_mrad[row] == pytest.approx(1000 * sides[-1], rel=1e-3)
            assert sides[-1] <= np.radians(float(facts["max_fov"])) * (1 + 1e-6)
            apart = np.linalg.norm(u - u.mean(axis=0), axis=1)
            assert (np.diff(apart) >= 0).all()

    def test_every_field_has_a_pattern_of_its_brightest(self, solver, exported, sky):
        with np.load(exported(solver)) as file:
            catalog = file["pattern_catalog"]
        known = {frozenset(four) for four in catalog[catalog.any(axis=1)].tolist()}
        half = np.radians(sky.fov_deg[0]) / 2
        generator, seen = np.random.default_rng(2), 0
        for centre in generator.normal(size=(200, 3)):
            at = np.flatnonzero(separation(sky.directions, centre / np.linalg.norm(centre)) < half)
            fours = combinations(at[:8].tolist(), 4)
            if len(at) >= 4:
                seen += any(frozenset(four) in known for four in fours)
            else:
                seen += 1
        assert seen >= 198


class TestLost:
    """LOST's database, read as its sources describe it."""

    def test_its_stars_are_those_of_the_database(self, exported, sky):
        data = _lost_parts(exported("lost"))[0xF9A283BC]
        size, flags = int.from_bytes(data[:2], "little"), data[2]
        assert (size, flags) == (len(sky.mag), 3)
        for row in range(size):
            at = 8 + 32 * row
            assert np.frombuffer(data, "<f8", 3, at).tolist() == sky.directions[row].tolist()
            hundredths = np.frombuffer(data, "<f4", 1, at + 24)[0]
            assert hundredths == pytest.approx(100 * sky.mag[row], abs=0.5)
            assert np.frombuffer(data, "<i2", 1, at + 28)[0] == row + 1
        assert len(data) == 8 + 32 * size - 2

    def test_a_range_of_the_k_vector_holds_the_pairs_of_that_range(self, exported, sky):
        data = _lost_parts(exported("lost"))[0x2536F009]
        pairs, bins = np.frombuffer(data, "<i4", 1, 0)[0], np.frombuffer(data, "<i4", 1, 24)[0]
        least, most = np.frombuffer(data, "<f8", 2, 8)
        counts = np.frombuffer(data, "<i4", bins + 1, 28)
        rows = np.frombuffer(data, "<i2", 2 * pairs, 28 + 4 * (bins + 1)).reshape(-1, 2)
        assert len(data) == 28 + 4 * (bins + 1) + 4 * pairs
        angle = separation(sky.directions[rows[:, 0]], sky.directions[rows[:, 1]])
        assert (np.diff(angle) >= -1e-15).all()
        every = separation(sky.directions[:, None], sky.directions[None])
        i, j = np.triu_indices(len(sky.mag), 1)
        assert pairs == ((every[i, j] >= least) & (every[i, j] <= most)).sum()
        bounds = least + np.arange(bins + 1) * (most - least) / bins
        assert np.abs(counts - np.searchsorted(angle, bounds, side="right")).max() <= 1
        assert counts[-1] == pairs


def _lost_parts(path: Path) -> dict[int, bytes]:
    data, at, parts = path.read_bytes(), 0, {}
    while True:
        at += -at % 4
        number = int.from_bytes(data[at : at + 4], "little")
        if number == 0:
            assert at + 4 == len(data)
            return parts
        assert data[at + 4 : at + 8] == bytes(4)  # no flag: double precision
        size = int.from_bytes(data[at + 8 : at + 12], "little")
        at += 12 + -(at + 12) % 8
        parts[number] = data[at : at + size]
        at += size


@pytest.mark.parametrize("areas", [astap.WIDE, astap.NARROW])
class TestAstap:
    """ASTAP's files, decoded as its sources describe them."""

    def test_every_star_is_in_the_file_of_its_area(self, areas, sky, tmp_path, monkeypatch):
        monkeypatch.setattr(astap, "WIDE" if areas is astap.NARROW else "NARROW", areas)
        monkeypatch.setattr(astap, "WIDEST_DEG", 90.0)
        astap.write_astap(sky, tmp_path / "db")
        files = sorted((tmp_path / "db").iterdir())
        assert len(files) == int(areas.suffix)
        found = []
        for path in files:
            ring, cell = int(path.stem[-4:-2]), int(path.stem[-2:])
            stars = _astap_stars(path)
            found += stars
            for ra_deg, dec_deg, _ in stars:
                assert areas.bounds_deg[ring - 1] - 1e-5 <= dec_deg
                assert dec_deg <= areas.bounds_deg[ring] + 1e-5
                width = 360.0 / areas.cells[ring - 1]
                assert (cell - 1) * width - 1e-4 <= ra_deg <= cell * width + 1e-4
            tenths = [mag for _, _, mag in stars]
            assert tenths == sorted(tenths)
        assert len(found) == len(sky.mag)
        ra_deg, dec_deg, mag = np.array(found).T
        near = separation(directions_from_radec(ra_deg, dec_deg)[:, None], sky.directions[None])
        nearest = near.argmin(axis=1)
        assert np.degrees(near.min(axis=1)).max() * 3600 < 0.08
        assert sorted(nearest.tolist()) == list(range(len(sky.mag)))
        assert np.abs(mag - np.clip(sky.mag[nearest], -1.6, None)).max() <= 0.05 + 1e-9


def _astap_stars(path: Path) -> list[tuple[float, float, float]]:
    data, stars = path.read_bytes(), []
    assert data[109] == 5
    high = mag = 0
    for at in range(110, len(data), 5):
        ra, low = int.from_bytes(data[at : at + 3], "little"), data[at + 3 : at + 5]
        if ra == 0xFFFFFF:
            high, mag = low[0] - 128, low[1] - 16
        else:
            dec = high * 65536 + int.from_bytes(low, "little")
            stars.append((ra * 360 / 0xFFFFFF, dec * 90 / 0x7FFFFF, mag / 10))
    return stars


def test_what_a_solver_cannot_take_is_refused(sky, tmp_path, monkeypatch):
    monkeypatch.setattr(lost, "MAX_STARS", len(sky.mag) - 1)
    with pytest.raises(ConfigError, match=r"brighter selection\.faint_limit_mag"):
        lost.write_lost(sky, tmp_path / "db.dat")
    monkeypatch.setattr(astap, "WIDEST_DEG", 5.0)
    with pytest.raises(ConfigError, match="choose another form"):
        astap.write_astap(sky, tmp_path / "db")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match=r"apt install astrometry\.net"):
        write_astrometry_net(sky, tmp_path / "db")


def test_tetra3rs_solves_with_it(exported, small_database):
    import tetra3rs

    database = tetra3rs.SolverDatabase.load_from_file(str(exported("tetra3rs")))
    known = open_database(small_database)
    camera = known.camera
    noise, right = Noise(noise_px=0.3), 0
    frames = list(simulate_frames(known.directions, camera, 20, noise, 3, known.mag))
    for frame in frames:
        px = frame.centroids_px - 0.5 * np.array([camera.width_px, camera.height_px])
        given = np.column_stack([px, 10.0 ** (-0.4 * frame.mag)])
        found = database.solve_from_centroids(
            given,
            fov_estimate_deg=camera.fov_x_deg,
            image_shape=(camera.height_px, camera.width_px),
        )
        if found:
            truth = radec_roll_from_matrix(frame.matrix)
            at = directions_from_radec([found.ra_deg], [found.dec_deg])
            assert separation(at, directions_from_radec([truth[0]], [truth[1]]))[0] < 1e-3
            # The conversions that howto-peers.md states.
            w, x, y, z = found.quaternion
            own = quaternion_from_matrix(frame.matrix)
            assert abs(own @ np.array([-x, -y, -z, w])) == pytest.approx(1.0, abs=1e-5)
            turn = np.mod(truth[2] - (180.0 - found.roll_deg) + 180.0, 360.0) - 180.0
            assert abs(turn) < 0.3
            right += 1
    assert right >= 18


def test_the_attitude_of_lost_is_converted_as_the_page_says():
    """Numbers that LOST printed, in a public report."""
    i, j, k, r = 0.00786371, 0.5304, -0.0768838, 0.844218
    q = 0.5 * np.array([j + k - i - r, r + k - i - j, -(i + j + k + r), r + j - i - k])
    assert q == pytest.approx([-0.199283, 0.114535, -0.652799, 0.721819], abs=1e-6)
    ra, dec, roll = radec_roll_from_matrix(matrix_from_quaternion(q))
    assert (ra, dec) == pytest.approx((17.9868, 63.4233), abs=1e-4)
    assert roll == pytest.approx(360.0 - 12.238, abs=1e-3)
    # LOST's camera has x along the boresight, y left and z up.
    lost = Rotation.from_quat([i, j, k, r]).as_matrix()
    axes = np.array([-lost[1], -lost[2], lost[0]])
    assert matrix_from_quaternion(q) == pytest.approx(axes, abs=1e-5)


@pytest.mark.slow
@pytest.mark.timeout(400)
@pytest.mark.filterwarnings("ignore::astropy.wcs.FITSFixedWarning")
@pytest.mark.parametrize("program", ["solve-field", "astap_cli"])
def test_plate_solvers_solve_pictures_with_it(program, tmp_path, excerpts):
    """Four rendered fields of 6 deg, nothing known but their size."""
    if shutil.which(program) is None:
        pytest.skip(f"{program} is not installed")
    from starcat.pipeline.build import build
    from starcat.pipeline.specs.reading import preset

    spec = preset("sao-12deg", {"camera.fov_x_deg": 6.0, "selection.faint_limit_mag": 6.9})
    folder = build(spec, tmp_path, inputs={"sao": [excerpts]}).folder
    solver = {"solve-field": "astrometry-net", "astap_cli": "astap"}[program]
    made = export_solver(folder, solver, tmp_path / "solver")
    known = open_database(folder)
    right = 0
    for n, frame in enumerate(
        simulate_frames(known.directions, known.camera, 8, Noise(noise_px=0.1), 5, known.mag)
    ):
        if len(frame.mag) < 10:
            continue
        picture = tmp_path / f"{n}.fits"
        picture.write_bytes(picture_of(frame, known.camera))
        middle = [[0.5 * known.camera.width_px + 0.5, 0.5 * known.camera.height_px + 0.5]]
        at = _solved(program, made.folder / made.main, picture, middle)
        truth = radec_roll_from_matrix(frame.matrix)
        error = separation(at, directions_from_radec([truth[0]], [truth[1]]))[0]
        right += error < np.radians(0.01)
    assert right >= 4


def _solved(program: str, main: Path, picture: Path, middle: list[list[float]]) -> np.ndarray:
    if program == "astap_cli":
        given = ["-f", picture, "-fov", "6", "-r", "180", "-z", "1", "-d", f"{main}/", "-wcs"]
    else:
        config = picture.with_suffix(".cfg")
        config.write_text(f"inparallel\nadd_path {main}\nautoindex\n")
        scale = ["--scale-units", "degwidth", "--scale-low", "5", "--scale-high", "7"]
        given = ["--no-plots", "--cpulimit", "20", "--config", config, *scale, picture]
    subprocess.run([program, *map(str, given)], capture_output=True, check=False, timeout=60)
    solved = picture.with_suffix(".wcs")
    if not solved.exists():
        return directions_from_radec([0.0], [0.0]) * np.nan
    ra_deg, dec_deg = WCS(fits.getheader(solved), naxis=2).all_pix2world(middle, 1)[0]
    return directions_from_radec([ra_deg], [dec_deg])
