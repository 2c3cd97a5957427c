"""Signed onboard images: written, read as docs/onboard-format.md says, and forged."""

from __future__ import annotations

import hashlib
import re
import shutil
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest

from starcat.database.onboard.layout import check_blocks
from starcat.database.onboard.patching import MAX_ADDED_BYTES
from starcat.database.onboard.reading import read_onboard_image
from starcat.matcher.c_engine import is_compiled
from starcat.ship.exchange.onboard import export_image, verify_image
from starcat.storage.keys import new_key


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("keys")
    for name in ("flight", "second", "other"):
        new_key(folder / name)
    return folder


@pytest.fixture(scope="module")
def signed(keys, small_database, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("signed") / "db.img"
    export_image(small_database, "onboard", path, sign=[keys / "flight.key"])
    return path


def section_9(data: bytes, order: str = "<") -> tuple[int, int]:
    """Places of the signatures, read as the page describes and without starcat."""
    (count,) = struct.unpack_from(order + "I", data, 60)
    entries = [struct.unpack_from(order + "4I", data, 256 + 16 * n) for n in range(count)]
    ((_, offset, size, element),) = [entry for entry in entries if entry[0] == 9]
    assert element == 96
    return offset, size


@pytest.mark.parametrize(("endian", "order"), [("little", "<"), ("big", ">")])
def test_openssl_finds_the_signature_good(endian, order, keys, small_database, tmp_path):
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    path = tmp_path / "db.img"
    signers = [keys / "flight.key", keys / "second.key"]
    export_image(small_database, "onboard", path, endian=endian, sign=signers)
    data = path.read_bytes()
    offset, size = section_9(data, order)
    assert size == 2 * 96
    message = b"starcat-image-1\0" + hashlib.sha512(data[:offset]).digest()
    (tmp_path / "message").write_bytes(message)
    for n, name in enumerate(("flight", "second")):
        (tmp_path / "signature").write_bytes(data[offset + 96 * n + 32 : offset + 96 * (n + 1)])
        command = ["openssl", "pkeyutl", "-verify", "-pubin", "-inkey", keys / f"{name}.pub"]
        files = ["-rawin", "-in", tmp_path / "message", "-sigfile", tmp_path / "signature"]
        ran = subprocess.run([*command, *files], capture_output=True, text=True, check=False)
        assert "Verified Successfully" in ran.stdout, ran.stderr


def test_a_signed_image_is_the_unsigned_one_with_a_section_more(
    signed, keys, small_database, tmp_path
):
    plain = tmp_path / "plain.img"
    export_image(small_database, "onboard", plain)
    one, other = read_onboard_image(plain), read_onboard_image(signed)
    assert (one.version, other.version) == ("1.0", "1.1")
    assert len(other.data) - len(one.data) in range(MAX_ADDED_BYTES + 1)
    assert one.manifest_sha256 == other.manifest_sha256
    for name, section in one.sections.items():
        assert np.array_equal(section, other.sections[name])
    (finding,) = verify_image(plain, trust=keys / "flight.pub").findings
    assert "signed by nobody, not by the key" in str(finding)


@pytest.mark.skipif(not is_compiled(), reason="the C library was not compiled")
def test_the_library_that_flies_opens_a_signed_image(signed):
    from starcat.matcher import c_engine

    ffi, lib = c_engine._onboard.ffi, c_engine._onboard.lib
    data = signed.read_bytes()
    words = np.frombuffer(data, dtype=np.uint64).copy()
    image = ffi.new("starcat_image *")
    assert lib.starcat_open_image(image, ffi.from_buffer(words), len(data), 0) == lib.STARCAT_OK
    assert image.n_stars == len(read_onboard_image(signed).star_id)


def test_inspect_and_verify_say_who_signed(signed, keys, starcat):
    ran = starcat(["inspect", signed])
    assert re.search(r"signed by +[0-9a-f]{64}", ran.out)
    assert starcat(["verify", signed, "--trust", keys / "flight.pub"]).code == 0
    ran = starcat(["verify", signed, "--trust", keys / "other.pub"])
    assert ran.code == 5
    assert re.search(r"signed by [0-9a-f]{16}, not by the key [0-9a-f]{16}", ran.out)


def test_a_limit_on_the_bytes_holds_for_signed_images(keys, small_database, tmp_path):
    path = tmp_path / "db.img"
    export_image(small_database, "onboard", path, max_bytes=100_000, sign=[keys / "flight.key"])
    assert 100_000 - 2 * MAX_ADDED_BYTES < path.stat().st_size <= 100_000
    assert not verify_image(path, small_database, keys / "flight.pub").findings


@pytest.mark.parametrize("place", ["header", "name", "table", "directions", "last star", "padding"])
def test_a_changed_byte_under_new_checks_is_found(place, signed, keys, tmp_path):
    data = bytearray(signed.read_bytes())
    offset, _ = section_9(bytes(data))
    at = {"header": 81, "name": 162, "table": 256 + 16 * 12 + 4, "directions": 512}
    data[at.get(place, offset - (1 if place == "padding" else 40))] ^= 1
    size = struct.unpack_from("<I", data, 24)[0]
    path = tmp_path / "forged.img"
    path.write_bytes(bytes(data[:size]) + check_blocks(bytes(data[:size]), "little"))
    found = verify_image(path, trust=keys / "flight.pub").findings
    assert "the signature of the image by the key" in str(found[-1])
    assert "does not fit" in str(found[-1])
