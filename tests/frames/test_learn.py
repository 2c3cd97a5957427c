"""Learning from flight: terms of a sensor, distrusted stars, and a patch release without them."""

from __future__ import annotations

import csv
import json
import tomllib
from dataclasses import replace

import flight
import numpy as np
import pytest
from drafts import chosen

import starcat as starcat_package
from starcat.database.reader import open_database_folder
from starcat.errors import CalibrationError
from starcat.frames.calibration.answers import Sightings, SkyStars, read_answers
from starcat.frames.calibration.learn import learn, learn_from_frames, observed_toml, sky_stars
from starcat.frames.images.solve_files import FrameAnswer
from starcat.geometry.camera import Camera
from starcat.matcher.matcher import Matcher
from starcat.pipeline.build import build
from starcat.pipeline.estimate import read_draft
from starcat.pipeline.simulation.simulate import Noise
from starcat.pipeline.specs.keys import spec_toml
from starcat.pipeline.specs.reading import read_spec, spec_from_dict

STARS = 2500


def told(verdicts):
    return {one.row: one.verdict for one in verdicts}


def sky(database, generator):
    """The stars of a database with colours of their own, a few without."""
    colour = generator.uniform(-0.3, 2.5, len(database.mag))
    colour[::50] = np.nan
    names = tuple(f"star {number}" for number in database.star_id)
    about = database.name, database.star_id, names, database.directions, database.mag
    return SkyStars(*about, colour)


def identified(database, frames, path):
    """A file of the answers to frames."""
    matcher = Matcher(database)
    with path.open("w") as file:
        for frame in frames:
            result = matcher.identify(frame.centroids_px, database.camera, mag=frame.mag)
            file.write(json.dumps(FrameAnswer(frame, result).content()) + "\n")
    return path


@pytest.fixture(scope="module")
def flown(sky_of, random_directions, tmp_path_factory):
    """A flight of 300 frames: the stars, the alterations, and the answers."""
    database = sky_of(random_directions(STARS, 5), Camera(2048, 2048, fov_x_deg=20.0))
    stars = sky(database, np.random.default_rng(8))
    taken = flight.fly(stars, database.camera, 300, 1)
    path = identified(database, taken.frames, tmp_path_factory.mktemp("flown") / "answers.ndjson")
    return stars, taken.altered, path


@pytest.fixture(scope="module")
def answers(flown):
    return read_answers([flown[2]], flown[0])


def test_300_frames_give_back_the_terms_and_every_altered_star_and_no_other(flown, answers):
    stars, altered, _ = flown
    assert (len(answers.names), answers.n_frames) == (300, 300)
    lesson = learn_from_frames(answers.sightings, stars, 300)
    assert lesson.terms.zero_point_mag == pytest.approx(flight.ZERO_POINT, abs=0.02)
    assert lesson.terms.colour_term == pytest.approx(flight.COLOUR_TERM, abs=0.02)
    assert told(lesson.distrusted) == altered
    for row, kind in altered.items():
        if kind == "too_faint":
            assert lesson.records.mag_residual[row] == pytest.approx(0.8, abs=0.2)
        if kind == "moved":
            assert np.hypot(*lesson.records.offset_arcsec[row]) == pytest.approx(30.0, abs=8.0)


def plain(seed, stars=800, per_star=8, frames=100, noise_mag=0.1, noise_arcsec=5.0):
    """Sightings of stars as they should be, and these stars."""
    generator = np.random.default_rng(seed)
    count = stars * per_star
    frame = np.sort(generator.integers(0, frames, count))
    star = generator.permutation(np.repeat(np.arange(stars), per_star))
    colour, mag = generator.uniform(0.0, 2.0, stars), generator.uniform(2.0, 6.0, stars)
    measured = mag[star] + 0.2 + 0.3 * colour[star] + generator.normal(0.0, noise_mag, count)
    known = SkyStars("x", np.arange(stars), ("",) * stars, np.zeros((stars, 3)), mag, colour)
    offset = generator.normal(0.0, noise_arcsec, (count, 2))
    return Sightings(frame, star, np.ones(count, dtype=bool), measured, offset), known


def unseen(seen, which):
    """The same with some stars not seen."""
    blank = np.where(which, np.nan, 1.0)
    return replace(
        seen,
        is_seen=seen.is_seen & ~which,
        mag=seen.mag * blank,
        offset_arcsec=seen.offset_arcsec * blank[:, None],
    )


@pytest.mark.parametrize("seed", range(3))
def test_no_star_is_named_by_chance_and_errors_are_as_stated(seed):
    seen, stars = plain(seed)
    lesson = learn_from_frames(seen, stars, 100)
    assert lesson.distrusted == ()
    terms = lesson.terms
    assert abs(terms.zero_point_mag - 0.2) < 4.0 * terms.zero_point_error_mag < 0.02
    assert abs(terms.colour_term - 0.3) < 4.0 * terms.colour_term_error < 0.02
    np.testing.assert_allclose(lesson.mag_noise.sigma, 0.1, rtol=0.15)
    np.testing.assert_allclose(lesson.offset_noise.sigma, 5.0, rtol=0.15)
    # Single wild measurements do not convict a star, many of one do: a double scatters in place.
    rows = np.array([np.flatnonzero(seen.star == star)[0] for star in range(0, 800, 20)])
    seen.mag[rows] += 3.0
    seen.offset_arcsec[rows] += 100.0
    lesson = learn_from_frames(seen, stars, 100)
    assert lesson.distrusted == ()
    assert lesson.terms.zero_point_mag == pytest.approx(0.2, abs=0.01)
    seen.offset_arcsec[seen.star == 5] *= 8.0
    assert told(learn_from_frames(seen, stars, 100).distrusted) == {5: "double"}


def test_an_offset_of_all_stars_does_not_convict_a_star():
    seen, stars = plain(12)
    own = np.random.default_rng(12)
    seen = replace(
        seen,
        mag=seen.mag + own.normal(0.0, 0.2, len(stars))[seen.star],
        offset_arcsec=seen.offset_arcsec + own.normal(0.0, 8.0, (len(stars), 2))[seen.star],
    )
    lesson = learn_from_frames(seen, stars, 100)
    assert lesson.distrusted == ()
    assert lesson.mag_noise.of_stars == pytest.approx(0.2, rel=0.15)
    assert lesson.offset_noise.of_stars == pytest.approx(8.0, rel=0.15)


def test_frames_of_their_own_exposures_need_an_offset_each():
    seen, stars = plain(13)
    offset = np.random.default_rng(13).normal(0.0, 0.7, 100)
    seen = replace(seen, mag=seen.mag + offset[seen.frame])
    terms = learn_from_frames(seen, stars, 100, by_frame=True).terms
    assert terms.colour_term == pytest.approx(0.3, abs=0.02)
    found = terms.zero_point_mag + terms.frame_offset_mag
    assert np.abs(found - 0.2 - offset).max() < 0.1
    assert terms.zero_point_error_mag > 0.05
    assert learn_from_frames(seen, stars, 100).terms.colour_term_error > terms.colour_term_error


def test_a_limit_neither_bends_the_terms_nor_makes_stars_missing():
    seen, stars = plain(14, per_star=12)
    seen = unseen(seen, seen.mag > 5.5)
    lesson = learn_from_frames(seen, stars, 100)
    assert lesson.distrusted == ()
    assert lesson.limit_mag == pytest.approx(5.4, abs=0.2)
    assert lesson.terms.zero_point_mag == pytest.approx(0.2, abs=0.02)


def test_frames_that_are_half_covered_make_no_star_missing():
    seen, stars = plain(15, per_star=12)
    covered = (seen.frame < 20) & (np.random.default_rng(15).random(len(seen)) < 0.5)
    assert learn_from_frames(unseen(seen, covered), stars, 100).distrusted == ()
    gone = seen.star == 33
    lesson = learn_from_frames(unseen(seen, covered | gone), stars, 100)
    assert told(lesson.distrusted) == {33: "missing"}
    assert lesson.records.n_seen[33] == 0
    assert lesson.records.n_missed[33] == lesson.records.n_expected[33] >= 8


def test_without_colours_there_is_a_zero_point_only():
    seen, stars = plain(17)
    terms = learn_from_frames(seen, replace(stars, colour=np.full(len(stars), np.nan)), 100).terms
    assert terms.colour_term is None
    assert terms.zero_point_mag == pytest.approx(0.5, abs=0.03)  # 0.3 times the mean colour more
    with pytest.raises(CalibrationError, match="12 stars of 100 identified frames"):
        learn_from_frames(*plain(18, stars=12), 100)


def test_the_command_writes_a_section_a_table_and_json(starcat, small_database, tmp_path):
    database = Matcher.open(small_database).database
    about = database.name, database.star_id, (), database.directions, database.mag
    stars = SkyStars(*about, np.zeros(len(database.mag)))
    frames = flight.fly(stars, database.camera, 120, 3, Noise(0.1, noise_mag=0.05)).frames
    content = [
        {"centroids_px": one.centroids_px.tolist(), "mag": one.mag.tolist()} for one in frames
    ]
    (tmp_path / "frames.json").write_text(json.dumps(content))
    identify = ["identify", small_database, tmp_path / "frames.json", "--ndjson"]
    path, section, table = (tmp_path / name for name in ("a.ndjson", "o.toml", "s.csv"))
    path.write_text(starcat(identify).out)
    command = ["learn", small_database, path, "-o", section, "--stars", table]
    run = starcat(command)
    assert run.code == 0, run.err
    assert "zero point" in run.out
    observed = tomllib.loads(section.read_text())["selection"]["observed"]
    assert observed["zero_point_mag"] == pytest.approx(0.2, abs=0.02)
    assert observed["database"] == "small-1.0.0"
    told_json = json.loads(starcat([*command, "--json", "--replace"]).out)
    named = {one["star_id"] for one in told_json["distrusted"]}
    assert named == set(map(str, observed["reject"]))
    spec = tmp_path / "small.toml"
    manifest = json.loads((small_database / "manifest.json").read_text())
    spec.write_text("# mine\n" + spec_toml(spec_from_dict(manifest["spec"], "spec")))
    patched = starcat(["learn", small_database, path, "--patch", spec, "-o", tmp_path / "p.toml"])
    assert f"go on with: starcat build {tmp_path / 'p.toml'}" in patched.err
    assert (tmp_path / "p.toml").read_text().startswith("# mine\n")
    made = read_spec(tmp_path / "p.toml")
    assert (made.name, made.version) == ("small", "1.0.1")
    assert made.selection.observed.zero_point_mag == observed["zero_point_mag"]
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len(rows) == len(told_json["stars"]) > 100
    assert {row["verdict"] for row in rows} >= {"too_faint", "missing"}
    found = starcat_package.learn(str(small_database), str(path))
    assert found.toml == section.read_text()
    assert len(found.table) == len(rows)
    assert starcat_package.learn(small_database, [path], min_frames=1000).lesson.distrusted == ()
    copy = tmp_path / "b.ndjson"
    copy.write_bytes(path.read_bytes())
    for again in (copy, path):
        refused = starcat(["learn", small_database, path, again])
        assert f"{again}: has the same content as {path}; give it once" in refused.err


def test_a_build_rejects_the_distrusted_stars(small_spec, sao_file):
    content = tomllib.loads(small_spec)
    assert "observed" not in spec_from_dict(content, "x").recorded()["selection"]
    content["selection"]["observed"] = {"reject": [1, 2], "zero_point_mag": 0.2}
    spec = spec_from_dict(content, "x")
    assert spec.recorded()["selection"]["observed"]["reject"] == [1, 2]
    rejected = chosen(read_draft(spec, {"sao": [sao_file]}).stars, spec).selected.rejected
    rows = rejected.to_pylist()
    assert {row["star_id"] for row in rows if row["reason"] == "distrusted"} == {1, 2}


FLOWN = """\
name = "flown"
version = "1.0.0"
epoch_jyear = 2026.0
catalog = { source = "gaia", read_limit_mag = 6.5 }
camera = { width_px = 2048, height_px = 2048, fov_x_deg = 20.0 }
boresights = { count = 1000, brightest = 6 }
self_test = { frames = 20, min_identified = 0.8 }
selection.faint_limit_mag = 5.5
"""


def flown_with(folder, seed, path):
    """The result of learning from a flight with a database, and the alterations by star_id."""
    stars, _ = sky_stars(open_database_folder(folder))
    matcher_stars = Matcher.open(folder).database
    table = open_database_folder(folder).stars
    own = np.array(table["catalog_mag"].to_pylist(), dtype=float)
    sky = replace(stars, mag=np.where(np.isnan(own), stars.mag, own))
    taken = flight.fly(sky, matcher_stars.camera, 500, seed)
    learnt = learn(folder, [identified(matcher_stars, taken.frames, path)])
    return learnt, taken.altered, {int(stars.star_id[row]) for row in taken.altered}


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_patch_releases_of_genuine_stars_have_the_magnitudes_of_the_sensor(tmp_path):
    (tmp_path / "spec.toml").write_text(FLOWN)
    first = build(read_spec(tmp_path / "spec.toml"), tmp_path / "dist").folder
    learnt, altered, numbers = flown_with(first, 2, tmp_path / "answers.ndjson")
    assert told(learnt.lesson.distrusted) == altered
    assert set(learnt.observed.reject) == numbers
    (tmp_path / "patch.toml").write_text(FLOWN.replace("1.0.0", "1.0.1") + observed_toml(learnt))
    patch = build(read_spec(tmp_path / "patch.toml"), tmp_path / "dist").folder
    table = open_database_folder(patch).stars
    assert not numbers & set(table["star_id"].to_pylist())
    mag, own, colour = (
        np.array(table[name].to_pylist(), dtype=float)
        for name in ("mag", "catalog_mag", "colour_mag")
    )
    observed, known = learnt.observed, np.isfinite(colour)
    expected = observed.colour_term * (colour - observed.reference_colour_mag)
    np.testing.assert_allclose((mag - own)[known], expected[known], atol=1e-9)
    assert (mag == own)[~known].all()
    # A flight with the patch confirms its colours, and adds to the section.
    again, altered, more = flown_with(patch, 3, tmp_path / "answers.ndjson")
    assert told(again.lesson.distrusted) == altered
    assert set(again.observed.reject) == numbers | more
    assert abs(again.lesson.terms.colour_term) < 0.01
    assert again.observed.colour_term == pytest.approx(flight.COLOUR_TERM, abs=0.02)
    assert again.observed.zero_point_mag == pytest.approx(flight.ZERO_POINT, abs=0.02)


def test_a_number_of_two_catalogs_is_written_with_its_catalog():
    names = ("one", "two", "one")
    stars = SkyStars(
        "x", np.array([5, 5, 6]), ("A 5", "B 5", "A 6"), np.zeros((3, 3)), *np.zeros((2, 3)), names
    )
    assert [stars.number_of(row) for row in range(3)] == ["one 5", "two 5", 6]
