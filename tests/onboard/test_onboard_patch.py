"""Patches from one onboard image to the next."""

from __future__ import annotations

import json
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from compilers import c_compiler
from hypothesis import given, settings
from hypothesis import strategies as st

from starcat.database.onboard.image import Contents, make_image
from starcat.database.onboard.layout import BYTE_ORDERS
from starcat.database.onboard.patching import HEADER, apply_patch, make_patch
from starcat.database.onboard.reading import OnboardImage, read_onboard_image
from starcat.errors import ConfigError, OnboardImageError
from tests.onboard.test_onboard_image import sky

ONBOARD = Path(__file__).parents[2] / "onboard"


def image_of(contents: Contents, byte_order: str = "little") -> OnboardImage:
    return read_onboard_image(make_image(contents, byte_order).data)


def without(contents: Contents, stars: list[int]) -> Contents:
    """Return the contents without some stars and their features."""
    stays = np.ones(len(contents.star_id), dtype=bool)
    stays[stars] = False
    place = np.cumsum(stays) - 1
    features = contents.features[stays[contents.features].all(axis=1)]
    return replace(
        contents,
        star_id=contents.star_id[stays],
        directions=contents.directions[stays],
        mag=contents.mag[stays],
        features=place[features],
    )


@settings(max_examples=40)
@given(
    st.integers(4, 60),
    st.integers(0, 99),
    st.sampled_from(["triangle", "pyramid"]),
    st.sampled_from(BYTE_ORDERS),
    st.lists(st.integers(0, 3)),
    st.lists(st.integers(0, 3)),
    st.sampled_from([0.0, 0.25]),
)
def test_any_image_becomes_any_other(count, seed, method, byte_order, lost, gained, fainter_mag):
    every = sky(count, seed, method, 12)
    old = image_of(without(every, gained), byte_order)
    new = image_of(without(replace(every, mag=every.mag + fainter_mag), lost), byte_order)
    patch = make_patch(old, new)
    assert apply_patch(old.data, patch) == new.data
    size = np.frombuffer(patch[36:40], HEADER["patch_bytes"].newbyteorder(byte_order))
    assert size.tolist() == [len(patch)]


def test_a_patch_is_for_one_image_and_says_when_it_is_damaged():
    old, new = image_of(sky(60, 1)), image_of(without(sky(60, 1), [3]))
    patch = make_patch(old, new)
    for refused in (new.data, old.data[:-8] + bytes(8)):
        with pytest.raises(OnboardImageError, match="for another image"):
            apply_patch(refused, patch)
    with pytest.raises(OnboardImageError, match="not a patch"):
        apply_patch(old.data, new.data)
    literal = patch.index(b"sky-1.0.0")
    for damaged in (patch[:literal] + b"S" + patch[literal + 1 :], patch[:-1]):
        with pytest.raises(OnboardImageError, match="the patch is damaged"):
            apply_patch(old.data, damaged)
    with pytest.raises(OnboardImageError, match="reads format 2"):
        apply_patch(old.data, patch[:12] + (1).to_bytes(4, "little") + patch[16:])


def test_images_of_other_kinds_have_no_patch():
    contents = sky(20, 1, n_features=0)
    pyramid, big = image_of(replace(contents, method="pyramid")), image_of(contents, "big")
    for old, words in ((pyramid, "method=pyramid"), (big, "endian=big")):
        with pytest.raises(ConfigError, match=words):
            make_patch(old, image_of(contents))


def test_export_writes_the_patch_beside_the_image(small_database, tmp_path, starcat):
    paths = [tmp_path / "old.img", tmp_path / "new.img"]
    command = ["export", small_database, "--to", "onboard", "-o"]
    assert starcat([*command, paths[0], "--max-bytes", "40000"]).code == 0
    ran = starcat([*command, paths[1], "--patch-from", paths[0], "--json"])
    assert ran.code == 0, ran.err
    said = json.loads(ran.out)
    patch = (tmp_path / "new.patch").read_bytes()
    assert said["patch_bytes"] == len(patch)
    assert said["files"] == [str(paths[1]), str(tmp_path / "new.patch")]
    assert said["crc"] == read_onboard_image(paths[1]).crc
    assert apply_patch(paths[0].read_bytes(), patch) == paths[1].read_bytes()
    ran = starcat(["export", small_database, "--to", "c", "--patch-from", paths[0]])
    assert (ran.code, "--patch-from: it has no effect on C source" in ran.err) == (2, True)


@pytest.mark.slow
@pytest.mark.parametrize("method", ["triangle", "pyramid"])
def test_flight_software_makes_the_same_image_of_a_patch_below_a_tenth(method, tmp_path):
    sources = [ONBOARD / "examples/patch.c", *sorted((ONBOARD / "src").glob("*.c"))]
    program = tmp_path / "patch"
    command = [c_compiler(), f"-I{ONBOARD / 'include'}", *sources, "-lm", "-o", program]
    subprocess.run(command, check=True)
    contents = sky(3000, 2, method, n_features=40_000)
    old, new = image_of(contents), image_of(without(contents, list(range(0, 3000, 500))))
    patch = make_patch(old, new)
    assert len(patch) < 0.1 * len(new.data)
    for name, data in {"old": old.data, "patch": patch}.items():
        (tmp_path / f"{name}.bin").write_bytes(data)
    files = [tmp_path / f"{name}.bin" for name in ("old", "patch", "made")]
    ran = subprocess.run([program, *files], capture_output=True, text=True)
    assert (ran.returncode, ran.stdout) == (0, "sky-1.0.0 in place 1\n"), ran.stderr
    assert files[2].read_bytes() == new.data
    ran = subprocess.run([program, files[2], files[1], files[2]], capture_output=True, text=True)
    assert (ran.returncode, "cannot be applied, status -4" in ran.stderr) == (1, True)
