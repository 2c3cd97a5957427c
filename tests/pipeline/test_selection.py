"""Selection on skies of a few stars: every star is kept or has the one reason it should have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from drafts import spec_with
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from starcat.catalog.stars.star_table import directions_of, floats_of, table_from_columns
from starcat.catalog.stars.verdict import Quality, count_by_reason
from starcat.geometry.sphere import directions_from_radec, radec_from_directions, separation
from starcat.pipeline.guide_stars import companion_notes
from starcat.pipeline.selection import rules as rules_room
from starcat.pipeline.selection.rules.doubles import Doubles
from starcat.pipeline.selection.rules.variables import Variables
from starcat.pipeline.selection.ruleset import ALL_REASONS, RULES, Selection, table_of_rule
from starcat.pipeline.selection.selecting import Selected, select_guide_stars
from starcat.storage.schema import product_schema

ALONE = 10.0  # degrees between stars that have nothing to do with each other


def sky_of(directions: NDArray[np.float64], mag: Sequence[float], **columns: Any) -> pa.Table:
    ra, dec = radec_from_directions(directions)
    numbers, mags = np.arange(1, len(mag) + 1), np.array(mag, dtype=float)
    given_columns = {"star_id": numbers, "ra_deg": ra, "dec_deg": dec, "mag": mags}
    given_columns |= {"quality_flags": 0, **dict(zip("xyz", directions.T, strict=True))}
    given_columns |= {name: np.array(values) for name, values in columns.items()}
    return table_from_columns("stars", given_columns, len(mag))


def sky(ra_deg: Sequence[float], mag: Sequence[float], **columns: Any) -> pa.Table:
    """Stars on the equator, numbered from 1."""
    return sky_of(directions_from_radec(ra_deg, np.zeros(len(ra_deg))), mag, **columns)


def alone(mag: Sequence[float], **columns: Any) -> pa.Table:
    """Stars on the equator, far from one another."""
    return sky(ALONE * np.arange(len(mag)), mag, **columns)


def rules(faint: float = 6.0, *, bright: float = -30.0, max_stars: int | None = None,
          variables: Variables | None = None, **doubles: Any) -> Selection:  # fmt: skip
    limits = {"bright_limit_mag": bright, "faint_limit_mag": faint, "max_stars": max_stars}
    rule = {"doubles": Doubles(**doubles), "variables": variables or Variables()}
    return Selection(**limits, **rule)


def verdicts(selected: Selected) -> dict[int, str]:
    kept = dict.fromkeys(selected.guide_stars["star_id"].to_pylist(), "kept")
    number, reason = (selected.rejected[name].to_pylist() for name in ("star_id", "reason"))
    return dict(sorted((kept | dict(zip(number, reason, strict=True))).items()))


def judge(stars: pa.Table, selection: Selection) -> list[str]:
    """The verdicts in the order of the stars."""
    return list(verdicts(select_guide_stars(stars, selection)).values())


@pytest.mark.parametrize(
    ("mag", "verdict"),
    [
        (2.0, "kept"), (6.0, "kept"), (np.nextafter(6.0, 7.0), "too_faint"),
        (np.nextafter(2.0, 1.0), "too_bright"), (np.nan, "no_magnitude"),
    ],
)  # fmt: skip
def test_both_limits_are_kept_themselves(mag, verdict):
    assert judge(alone([mag]), rules(6.0, bright=2.0)) == [verdict]


# Doubles

MERGE = {"action": "merge"}
SAME = [5.0, 5.0, 5.0001]  # right ascensions


def limits_around(angle_rad: float) -> tuple[float, float]:
    """Two neighbouring floats, in degrees, below and at (or above) an angle."""
    limit = float(np.degrees(angle_rad))
    while np.radians(limit) >= angle_rad:
        limit = float(np.nextafter(limit, 0.0))
    return limit, float(np.nextafter(limit, 1.0))


def test_the_separation_itself_is_too_close():
    stars = sky([20.0, 20.05], [3.0, 4.0])
    angle = float(separation(*directions_of(stars)))
    below, at = limits_around(angle)
    assert judge(stars, rules(min_separation_deg=below)) == ["kept", "kept"]
    assert judge(stars, rules(min_separation_deg=at)) == ["double", "double"]


@pytest.mark.parametrize("dec", [0.0, 60.0, 89.99, -90.0])
def test_separation_is_on_the_sphere_and_across_zero_hours(dec):
    close = directions_from_radec([359.99, 0.01], [dec, dec])
    expected = "double" if 0.02 * np.cos(np.radians(dec)) <= 0.015 else "kept"
    stars = sky_of(close, [3.0, 3.0])
    assert judge(stars, rules(min_separation_deg=0.015)) == [expected] * 2


@pytest.mark.parametrize(
    ("ra_deg", "mag", "options", "expected"),
    [
        # A faint companion does not count, but a bright one does.
        ([0.0, 0.01], [3.0, 5.0], {"max_delta_mag": None}, ["double", "double"]),
        ([0.0, 0.01], [3.0, 5.0], {"max_delta_mag": 2.0}, ["double", "double"]),
        ([0.0, 0.01], [3.0, 5.0], {"max_delta_mag": 1.9}, ["kept", "double"]),
        ([0.0, 0.01], [3.0, 5.0], {"max_delta_mag": 0.0}, ["kept", "double"]),
        # Companions have their own limit, which can be fainter or brighter than the limit of stars.
        ([0.0, 0.01], [5.0, 6.5], {"companion_limit_mag": None}, ["kept", "too_faint"]),
        ([0.0, 0.01], [5.0, 6.5], {"companion_limit_mag": 6.4}, ["kept", "too_faint"]),
        ([0.0, 0.01], [5.0, 6.5], {"companion_limit_mag": 6.5}, ["double", "too_faint"]),
        ([0.0, 0.01], [5.0, 6.5], {"companion_limit_mag": 9.0}, ["double", "too_faint"]),
        ([0.0, 0.01], [5.0, 5.5], {"companion_limit_mag": 5.2}, ["kept", "kept"]),
        # A bright star that is rejected is still a companion; a star without magnitude is not.
        ([0.0, 0.01], [1.0, 4.0], {"bright": 2.0}, ["too_bright", "double"]),
        ([0.0, 0.01], [4.0, np.nan], {}, ["kept", "no_magnitude"]),
        # A separation of zero takes only stars at the same place.
        (SAME, [3.0, 4.0, 4.5], {"min_separation_deg": 0.0}, ["double", "double", "kept"]),
        (SAME, [3.0, 4.0, 4.5], {"min_separation_deg": 0.0, **MERGE}, ["kept", "merged", "kept"]),
        # Two groups do not mix, and stars too different or without magnitude are not merged.
        ([0, 5, 0.01, 5.01], [5, 4, 4.5, 4.5], MERGE, ["merged", "kept", "kept", "merged"]),
        ([0.0, 0.01], [3.0, 5.0], {"max_delta_mag": 1.9, **MERGE}, ["kept", "kept"]),
        ([0.0, 0.01], [3.0, 5.0], {"max_delta_mag": 2.0, **MERGE}, ["kept", "merged"]),
        ([0.0, 0.01], [3.0, np.nan], MERGE, ["kept", "no_magnitude"]),
        # A merged star is compared with the limits as one: 4.25 here, 5.75 there.
        ([0.0, 0.01], [5.0, 5.0], {"bright": 4.5, **MERGE}, ["too_bright", "merged"]),
        ([0.0, 0.01], [6.5, 6.5], {"companion_limit_mag": 7.0, **MERGE}, ["kept", "merged"]),
        ([0.0, 0.01], [6.5, 6.5], MERGE, ["too_faint", "too_faint"]),
    ],
)
def test_close_stars(ra_deg, mag, options, expected):
    assert judge(sky(ra_deg, mag), rules(**options)) == expected


# Merging


def merged(ra_deg: Sequence[float], mag: Sequence[float], **options: Any) -> Selected:
    return select_guide_stars(sky(ra_deg, mag), rules(action="merge", **options))


def test_two_equal_stars_become_one_between_them():
    selected = merged([359.99, 0.01], [5.0, 5.0])
    (star,) = selected.guide_stars.to_pylist()
    assert star["star_id"] == 1
    assert star["mag"] == pytest.approx(5.0 - 2.5 * np.log10(2.0))
    assert (star["x"], star["y"], star["z"]) == pytest.approx((1.0, 0.0, 0.0), abs=1e-15)
    assert star["ra_deg"] % 360.0 == pytest.approx(0.0, abs=1e-12)
    assert star["quality_flags"] == Quality.MERGED | Quality.PHOTOCENTRE
    assert verdicts(selected) == {1: "kept", 2: "merged"}
    assert selected.rejected["mag"].to_pylist() == [5.0]


def test_the_photocentre_is_nearer_to_the_brighter_star_whose_number_stays():
    mag = 4.0 + 2.5 * np.log10(3.0)  # a third of the light
    selected = merged([10.04, 10.0], [mag, 4.0])
    (star,) = selected.guide_stars.to_pylist()
    assert star["star_id"] == 2
    assert star["ra_deg"] == pytest.approx(10.01, abs=1e-8)
    assert star["dec_deg"] == pytest.approx(0.0, abs=1e-12)
    assert star["mag"] == pytest.approx(4.0 - 2.5 * np.log10(4.0 / 3.0))


def test_a_chain_of_three_is_one_star():
    selected = merged([0.0, 0.04, 0.08, 1.0], [5.0, 5.0, 5.0, 5.0], min_separation_deg=0.05)
    assert verdicts(selected) == {1: "kept", 2: "merged", 3: "merged", 4: "kept"}
    assert count_by_reason(selected.rejected, reasons=ALL_REASONS) == {"merged": 2}
    assert selected.guide_stars["mag"][0].as_py() == pytest.approx(5.0 - 2.5 * np.log10(3.0))
    assert selected.guide_stars["ra_deg"].to_pylist() == pytest.approx([0.04, 1.0], abs=1e-9)
    assert selected.guide_stars["quality_flags"].to_pylist()[1] == 0


CLOSE, WIDE, UNKNOWN = 10.0, 1000.0, np.nan  # arcsec; the limit is 0.047 deg = 169.2 arcsec


@pytest.mark.parametrize(
    ("flags", "flagged", "apart", "delta", "is_kept"),
    [
        ("keep", True, CLOSE, 0.0, True),
        ("ignore", True, CLOSE, 0.0, True),
        ("strict", True, WIDE, 9.0, False),
        ("strict", True, UNKNOWN, UNKNOWN, False),
        ("strict", False, CLOSE, 0.0, True),
        ("unresolved", True, CLOSE, 1.5, False),
        ("unresolved", True, CLOSE, 2.0, False),
        ("unresolved", True, CLOSE, 2.1, True),
        ("unresolved", True, WIDE, 1.5, True),
        ("unresolved", True, UNKNOWN, 1.5, False),
        ("unresolved", True, 169.1, 1.5, False),
        ("unresolved", True, 169.3, 1.5, True),
        ("unresolved", True, CLOSE, UNKNOWN, True),
        ("unresolved", False, CLOSE, 0.0, True),
    ],
)
def test_flagged_doubles(flags, flagged, apart, delta, is_kept):
    places = {"companion_separation_arcsec": [apart], "companion_delta_mag": [delta]}
    stars = alone([4.0], is_flagged_double=[flagged], **places)
    rule = {"action": "keep", "flags": "strict"} if flags == "keep" else {"flags": flags}
    found = judge(stars, rules(max_delta_mag=2.0, **rule))
    assert found == ["kept" if is_kept else "flagged_double"]


def test_without_a_largest_difference_any_that_is_stated_counts():
    columns = {"is_flagged_double": [True] * 2, "companion_delta_mag": [9.0, np.nan]}
    assert judge(alone([4.0, 4.0], **columns), rules()) == ["flagged_double", "kept"]


@pytest.mark.parametrize(
    ("rule", "flagged", "amplitude", "verdict"),
    [
        # The largest amplitude is kept itself.
        ({"max_amplitude_mag": 0.6}, True, 0.6, "kept"),
        ({"max_amplitude_mag": 0.6}, True, np.nextafter(0.6, 1.0), "variable"),
        ({"max_amplitude_mag": 0.6}, True, 0.0, "kept"),
        ({"max_amplitude_mag": None}, True, 9.0, "kept"),
        ({"max_amplitude_mag": 0.0}, True, 0.0, "kept"),
        ({"max_amplitude_mag": 0.0}, True, 0.01, "variable"),
        *(
            ({"flags": flags}, flagged, amplitude, verdict)
            for flags, flagged, amplitude, verdict in [
                ("ignore", True, np.nan, "kept"), ("ignore", True, 0.9, "variable"),
                ("known", True, np.nan, "flagged_variable"), ("known", True, 0.1, "kept"),
                ("known", True, 0.9, "variable"), ("known", False, np.nan, "kept"),
                ("strict", True, np.nan, "flagged_variable"),
                ("strict", True, 0.1, "flagged_variable"), ("strict", True, 0.9, "variable"),
                ("strict", False, 0.1, "kept"), ("strict", False, 0.9, "variable"),
            ]
        ),
    ],
)  # fmt: skip
def test_variables(rule, flagged, amplitude, verdict):
    stars = alone([4.0], amplitude_mag=[amplitude], is_flagged_variable=[flagged])
    assert judge(stars, rules(variables=Variables(**rule))) == [verdict]


@pytest.mark.parametrize(
    ("mag", "max_stars", "expected"),
    [
        # Of equal stars the lowest numbers stay.
        ([5, 3, 5, 5, 2], 3, ["kept", "kept", "beyond_count", "beyond_count", "kept"]),
        ([5] * 5, 5, ["kept"] * 5),
        ([5] * 5, 6, ["kept"] * 5),
    ],
)
def test_the_brightest_stay(mag, max_stars, expected):
    assert judge(alone(mag), rules(max_stars=max_stars)) == expected


def test_the_first_reason_that_applies_is_the_verdict():
    """Each star passes one rule more than the star before it."""
    ra = np.array([0, 0, 1, 1, 2, 2, 3, 4, 5, 6, 7]) * ALONE
    ra[[1, 3, 5]] += 0.01
    stars = sky(
        ra,
        [np.nan, np.nan, 1.0, 1.0, 6.5, 5.0, 4.0, 4.0, 4.0, 4.0, 3.0],
        is_flagged_double=[True] * 7 + [False] * 4,
        companion_delta_mag=[0.0] * 11,
        amplitude_mag=[2.0] * 8 + [0.1, np.nan, np.nan],
        is_flagged_variable=[True] * 9 + [False] * 2,
    )
    strict = {"flags": "strict", "variables": Variables(flags="strict")}
    selection = rules(bright=2.0, max_stars=1, companion_limit_mag=7.0, **strict)
    assert judge(stars, selection) == [
        *["no_magnitude"] * 2, *["too_bright"] * 2, "too_faint", "double", "flagged_double",
        "variable", "flagged_variable", "beyond_count", "kept",
    ]  # fmt: skip


def test_steps_count_down_to_the_guide_stars():
    ra = [0.0, 0.01, 10.0, 20.0, 30.0, 40.0]
    amplitude = [np.nan, np.nan, np.nan, 1.0, np.nan, np.nan]
    stars = sky(ra, [5.0, 5.0, 6.5, 4.0, 4.0, 4.5], amplitude_mag=amplitude)
    selected = select_guide_stars(stars, rules(max_stars=1))
    counted = [(step.name, len(step.directions)) for step in selected.steps]
    assert counted == [("magnitude", 5), ("doubles", 3), ("variables", 2), ("count", 1)]
    np.testing.assert_array_equal(
        selected.steps[-1].directions, directions_of(selected.guide_stars)
    )
    without = select_guide_stars(stars, rules())
    assert [step.name for step in without.steps] == ["magnitude", "doubles", "variables"]


def test_stars_that_are_kept_are_kept_as_they_are():
    stars = alone([5.0, 7.0, 4.0])
    selected = select_guide_stars(stars, rules())
    assert selected.guide_stars.equals(stars.take([0, 2]))


@st.composite
def crowded_skies(draw: st.DrawFn) -> tuple[pa.Table, Selection]:
    """Up to 20 stars on a grid of 0.02 degrees, and rules for them."""
    count = draw(st.integers(0, 20))

    def column(values: st.SearchStrategy[Any]) -> NDArray[Any]:
        return np.array(draw(st.lists(values, min_size=count, max_size=count)))

    place = column(st.integers(0, 8)) * 0.02
    mag = column(st.sampled_from([np.nan, 1.0, 3.0, 4.0, 5.5, 6.0, 6.5, 8.0])).astype(float)
    stars = sky(
        place.astype(float),
        mag,
        is_flagged_double=column(st.booleans()).astype(bool),
        companion_delta_mag=column(st.sampled_from([np.nan, 0.0, 3.0])).astype(float),
        amplitude_mag=column(st.sampled_from([np.nan, 0.1, 0.9])).astype(float),
        is_flagged_variable=column(st.booleans()).astype(bool),
    )
    selection = rules(
        6.0,
        bright=draw(st.sampled_from([-30.0, 2.0])),
        max_stars=draw(st.sampled_from([None, 1, 3])),
        variables=Variables(flags=draw(st.sampled_from(["ignore", "known", "strict"]))),
        min_separation_deg=draw(st.sampled_from([0.0, 0.015, 0.03])),
        max_delta_mag=draw(st.sampled_from([None, 1.0])),
        companion_limit_mag=draw(st.sampled_from([None, 7.0])),
        action=draw(st.sampled_from(["remove", "merge", "keep"])),
        flags=draw(st.sampled_from(["ignore", "unresolved", "strict"])),
    )
    return stars, selection


@given(crowded_skies())
def test_every_star_is_kept_or_rejected_and_never_both(case):
    stars, selection = case
    selected = select_guide_stars(stars, selection)
    kept = selected.guide_stars["star_id"].to_pylist()
    rejected = selected.rejected["star_id"].to_pylist()
    assert sorted(kept + rejected) == stars["star_id"].to_pylist()
    assert kept == sorted(kept)
    assert rejected == sorted(rejected)
    assert selected.rejected["reason"].null_count == 0
    mag = floats_of(selected.guide_stars, "mag")
    assert ((mag >= selection.bright_limit_mag) & (mag <= selection.faint_limit_mag)).all()
    assert selection.max_stars is None or len(kept) <= selection.max_stars


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("action", ["remove", "merge"])
def test_a_turned_sky_has_the_same_verdicts(seed, action):
    generator = np.random.default_rng(seed)
    ra, dec = generator.uniform(-0.3, 0.3, (2, 60))
    place = directions_from_radec(ra % 360.0, dec)
    mag = generator.uniform(2.0, 7.0, 60)
    turn = Rotation.random(rng=generator)
    selection = rules(action=action, max_delta_mag=3.0, max_stars=20)
    before = select_guide_stars(sky_of(place, mag), selection)
    after = select_guide_stars(sky_of(turn.apply(place), mag), selection)
    assert verdicts(after) == verdicts(before)
    assert len(set(verdicts(before).values())) >= 3
    turned = turn.apply(directions_of(before.guide_stars))
    np.testing.assert_allclose(directions_of(after.guide_stars), turned, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        floats_of(after.guide_stars, "mag"), floats_of(before.guide_stars, "mag"), atol=1e-13
    )


# Notes --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "column", "words"),
    [
        ({"max_drift_arcsec": 1.0}, "drift_arcsec", "selection.max_drift_arcsec"),
        (
            {"variables": Variables(max_amplitude_mag=0.2)},
            "amplitude_mag",
            "selection.variables.max_amplitude_mag",
        ),
        ({"variables": Variables(flags="known")}, "is_flagged_variable", "variables.flags"),
        ({"doubles": Doubles(flags="strict")}, "is_flagged_double", "doubles.flags"),
    ],
)
def test_a_limit_on_a_column_without_values_is_noted(change, column, words):
    selection = rules().model_copy(update=change)
    [note] = select_guide_stars(alone([3.0, 4.0]), selection).notes
    assert words in note
    assert f"rejects nothing: no star of the catalogs has {column}" in note
    value = True if column.startswith("is_") else 0.01
    some = alone([3.0, 4.0], **{column: [value, value]})
    assert select_guide_stars(some, selection).notes == ()


def test_limits_that_a_spec_does_not_state_are_not_noted():
    assert select_guide_stars(alone([3.0, 4.0]), rules()).notes == ()
    ignoring = rules(flags="ignore", variables=Variables(max_amplitude_mag=None))
    assert select_guide_stars(alone([3.0, 4.0]), ignoring).notes == ()


def test_the_keys_of_every_rule_are_keys_of_the_selection():
    for rule in RULES:
        if (table := table_of_rule(rule)) != "":
            assert Selection.model_fields[table].annotation is rule.KEYS, rule.__name__
        elif hasattr(rule, "KEYS"):
            assert issubclass(Selection, rule.KEYS), rule.__name__
    listed = {path.stem for path in Path(rules_room.__file__).parent.glob("[!_]*.py")}
    assert listed == {rule.__name__.rpartition(".")[2] for rule in RULES}


def test_columns_of_rules_are_keys_and_columns_that_exist():
    for rule in RULES:
        for key, columns in getattr(rule, "COLUMNS", {}).items():
            assert key in rule.KEYS.model_fields
            assert set(columns) <= set(product_schema("stars").arrow_schema.names)


def shared(text: str, apart_arcsec: float, fainter_mag: float, **doubles: Any) -> tuple[str, ...]:
    """The note of a star of 5.5 mag with a companion; a pixel has 4 arcmin."""
    spec = spec_with(text, selection={"faint_limit_mag": 6.0, "doubles": doubles})
    stars = alone([5.5], nearest_separation_arcsec=[apart_arcsec], nearest_delta_mag=[fainter_mag])
    return companion_notes(stars, spec)


def test_companions_below_the_limit_in_the_same_pixel_are_noted(small_spec):
    [note] = shared(small_spec, 30.0, 1.23)
    assert note.startswith("guide stars that share a pixel (")
    assert "of the light: 1. The camera sees" in note
    assert "fainter than selection.faint_limit_mag 6 " in note
    assert "selection.doubles.companion_limit_mag = 6.8 (and max_delta_mag = 2.4" in note
    [note] = shared(small_spec, 30.0, 1.23, companion_limit_mag=6.5, max_delta_mag=2.0)
    assert "fainter than selection.doubles.companion_limit_mag 6.5 " in note
    assert note.endswith("selection.doubles.companion_limit_mag = 6.8 makes them doubles")


@pytest.mark.parametrize(
    ("apart_arcsec", "fainter_mag", "doubles"),
    [
        (30.0, 0.4, {}),  # the rule sees it
        (30.0, 2.5, {}),  # less than a tenth of the light
        (3600.0, 1.0, {}),  # another pixel
        (30.0, 1.0, {"min_separation_deg": 0.005}),
        (30.0, 1.0, {"action": "keep"}),
        (30.0, 1.0, {"companion_limit_mag": 7.0}),
        (30.0, 1.0, {"max_delta_mag": 0.5}),
    ],
)
def test_other_companions_are_not_noted(small_spec, apart_arcsec, fainter_mag, doubles):
    assert shared(small_spec, apart_arcsec, fainter_mag, **doubles) == ()
