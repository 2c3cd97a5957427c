"""Tables of one's own: eight formats, names, units and frames by maps alone; what is refused."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
from own_tables import CASES, COUNT, NO_MAG, NO_MOTION, Case, Sky, make_sky

from starcat.catalog.archives.mapped import identity
from starcat.catalog.ingest import Ingested
from starcat.catalog.source import give_map, known_maps, mapped
from starcat.catalog.stars import floats_of
from starcat.catalog.table_draft import draft_map
from starcat.geometry.sphere import directions_from_radec, separation
from starcat.store.reading import read_catalog


@pytest.fixture(scope="module")
def sky() -> Sky:
    return make_sky()


@pytest.fixture(scope="module", params=CASES, ids=[case.name for case in CASES])
def case(request: pytest.FixtureRequest) -> Case:
    return request.param


@pytest.fixture(scope="module")
def read(case: Case, sky: Sky, tmp_path_factory: pytest.TempPathFactory) -> Ingested:
    folder = tmp_path_factory.mktemp(case.name)
    table = case.make(sky, folder)
    name = "gaia_dr3_hats"
    with known_maps([]):
        if case.toml:
            (folder / "map.toml").write_text(case.toml)
            name = give_map(folder / "map.toml").name
        return read_catalog(name, [table], neighbours=False)


@pytest.fixture(scope="module")
def order(sky: Sky, read: Ingested) -> np.ndarray:
    """Row of the sky of each star that was read."""
    first = {int(one): n for n, one in reversed(list(enumerate(sky.ids)))}
    known = dict(first.items())
    known |= {identity(f"P{key}"): n for key, n in first.items()}
    known |= {identity(f"SURVEY J{key}+12"): n for key, n in first.items()}
    return np.array([known[one] for one in read.stars["star_id"].to_pylist()])


class TestEveryFormat:
    """What a table gives, whatever its format, names, units and frame."""

    def test_every_row_is_kept_or_rejected(self, case: Case, read: Ingested):
        lacking = {} if case.name == "hats" else {"no_position": 1}
        assert read.rejected_by_reason == {**lacking, "duplicate_record": 1}
        assert read.rows_read == COUNT == len(read.stars) + len(read.rejected)
        assert not read.problems

    def test_positions(self, case: Case, sky: Sky, read: Ingested, order: np.ndarray):
        ra, dec, _, _ = sky.at(case.epoch_jyear)
        found = directions_from_radec(
            floats_of(read.stars, "ra_deg"), floats_of(read.stars, "dec_deg")
        )
        apart = np.degrees(separation(found, directions_from_radec(ra, dec)[order])) * 3600.0
        assert apart.max() < case.arcsec
        np.testing.assert_allclose(
            floats_of(read.stars, "epoch_jyear"), case.epoch_jyear, atol=1e-9
        )

    def test_motions(self, case: Case, sky: Sky, read: Ingested, order: np.ndarray):
        _, _, pm_ra, pm_dec = sky.at(case.epoch_jyear)
        found = [floats_of(read.stars, f"pm_{axis}_mas_yr") for axis in ("ra_cosdec", "dec")]
        unknown = np.isnan(found[0])
        assert set(order[unknown]) == (({NO_MOTION}) if case.has_motion else set(order))
        for values, expected in zip(found, (pm_ra, pm_dec), strict=True):
            np.testing.assert_allclose(
                values[~unknown], expected[order][~unknown], atol=case.mas_yr
            )

    def test_magnitudes(self, read: Ingested, sky: Sky, order: np.ndarray):
        mag = floats_of(read.stars, "mag")
        assert set(order[np.isnan(mag)]) == {NO_MAG}
        known = ~np.isnan(mag)
        np.testing.assert_allclose(mag[known], sky.v[order][known], atol=6e-4)

    def test_flags(self, case: Case, read: Ingested, sky: Sky, order: np.ndarray):
        for kind, expected in (("double", sky.is_double), ("variable", sky.is_variable)):
            found = read.stars[f"is_flagged_{kind}"].to_numpy()
            wanted = f"{kind} =" in case.toml or case.name == "hats"
            assert (found == (expected[order] if wanted else False)).all()
            assert (pc.is_valid(read.stars[f"{kind}_flag"]).to_numpy() == found).all()


def test_drafts_get_the_columns_right(sky: Sky, tmp_path: Path):
    right = total = 0
    for case in CASES:
        (tmp_path / case.name).mkdir()
        draft = draft_map(case.make(sky, tmp_path / case.name))
        assert mapped(tomllib.loads(draft.as_toml())).table is not None
        hits = sum(draft.used.get(column) == key for column, key in case.meant.items())
        assert hits >= 0.8 * len(case.meant), case.name
        right, total = right + hits, total + len(case.meant)
    assert right >= 0.95 * total
