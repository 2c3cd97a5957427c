"""Pictures that would expand to too much: refused by their headers, before the pixels are read."""

from __future__ import annotations

import gzip
import io
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from PIL import Image

import starcat
from starcat.errors import ConfigError
from starcat.frames.images import contents, image_file
from starcat.frames.images.image_file import read_image, write_image

SIDE = 12_000


def zeros_of_fits(*, is_first: bool = True) -> bytes:
    """A FITS file in gzip of 144 million pixels in less than a megabyte."""
    header = fits.PrimaryHDU().header if is_first else fits.ImageHDU().header
    header["BITPIX"], header["NAXIS"] = 16, 2
    header.insert("NAXIS", ("NAXIS1", SIDE), after=True)
    header.insert("NAXIS1", ("NAXIS2", SIDE), after=True)
    text = header.tostring().encode()
    if not is_first:
        text = fits.PrimaryHDU().header.tostring().encode() + text
    packer = zlib.compressobj(9, wbits=31)
    data = packer.compress(text)
    for _ in range(2 * SIDE * SIDE // 2_880_000):
        data += packer.compress(bytes(2_880_000))
    return data + packer.flush()


def header_of_png(width: int, height: int) -> bytes:
    """The beginning of a PNG image, which promises any size."""
    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    chunk = b"IHDR" + head
    whole = io.BytesIO()
    Image.new("L", (4, 4)).save(whole, "PNG")
    return whole.getvalue()[:8] + struct.pack(">I", 13) + chunk + struct.pack(
        ">I", zlib.crc32(chunk)
    ) + whole.getvalue()[33:]  # fmt: skip


@pytest.mark.parametrize("is_first", [True, False])
def test_a_small_file_of_many_pixels_is_refused_by_its_header(is_first, tmp_path, monkeypatch):
    path = tmp_path / "a.fits.gz"
    path.write_bytes(zeros_of_fits(is_first=is_first))
    assert path.stat().st_size < 1_000_000
    read = []
    expand = gzip.GzipFile.read

    def counted(self, size=-1):
        part = expand(self, size)
        read.append(len(part))
        return part

    monkeypatch.setattr(gzip.GzipFile, "read", counted)
    words = "has 12000 x 12000 px, 144 million; pictures of at most 134 million are read"
    with pytest.raises(ConfigError, match=f"{path.name}: {words}"):
        starcat.read_frames(path)
    assert sum(read) < 20_000  # two headers, and no pixel


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the peak is read from /proc")
def test_refusing_a_large_picture_takes_little_memory(tmp_path):
    (tmp_path / "a.fits.gz").write_bytes(zeros_of_fits())
    program = (
        "import starcat\n"
        "try: starcat.read_frames('a.fits.gz')\n"
        "except starcat.StarcatError: pass\n"
        "[peak] = [line.split()[1] for line in open('/proc/self/status') if line[:5] == 'VmHWM']\n"
        "print(peak)"
    )
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, check=True, capture_output=True, text=True
    )
    assert int(run.stdout) < 300_000  # KiB


def test_every_kind_of_picture_has_the_limit(tmp_path, monkeypatch):
    """With a limit of 1000 pixels in place of 134 million."""
    for module in (contents, image_file):
        monkeypatch.setattr(module, "MAX_PIXELS", 1000)
    for side in (30, 40):
        image = np.arange(side * side, dtype=np.uint16).reshape(side, side)
        grey, stem = (image % 251).astype(np.uint8), tmp_path / f"a{side}"
        write_image(stem.with_suffix(".fits"), image)
        for suffix in (".png", ".tif", ".jpg"):
            write_image(stem.with_suffix(suffix), grey)
        Image.fromarray(grey).save(stem.with_suffix(".bmp"))
        fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(image)]).writeto(
            stem.with_suffix(".fits.fz")
        )
        for suffix in (".fits", ".png", ".tif", ".bmp", ".fits.fz"):
            packed = gzip.compress(stem.with_suffix(suffix).read_bytes())
            stem.with_suffix(f"{suffix}.gz").write_bytes(packed)
    suffixes = [path.name.partition(".")[2] for path in sorted(tmp_path.glob("a30.*"))]
    assert len(suffixes) == 11
    for suffix in suffixes:
        assert read_image(tmp_path / f"a30.{suffix}").shape == (30, 30), suffix
        with pytest.raises(ConfigError, match="has 40 x 40 px"):
            read_image(tmp_path / f"a40.{suffix}")
    heic = Path(__file__).parent / "two_stars.heic"
    with pytest.raises(ConfigError, match=r"two_stars\.heic: has \d+ x \d+ px"):
        read_image(heic)


def test_a_picture_of_pillow_beyond_its_own_limit_is_refused(tmp_path):
    for width, words in ((13_000, "has 13000 x 11000 px, 143 million"), (60_000, "134 million")):
        (tmp_path / "a.png").write_bytes(header_of_png(width, 11_000))
        with pytest.raises(ConfigError, match=words):
            read_image(tmp_path / "a.png")


def test_a_gzip_file_has_a_limit_whatever_it_holds(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "MAX_EXPANDED_PICTURE_BYTES", 5_000)
    monkeypatch.setattr(contents, "MAX_EXPANDED_FITS_BYTES", 50_000)
    write_image(tmp_path / "a.tif", np.zeros((64, 64), dtype=np.uint8))
    with_more = (tmp_path / "a.tif").read_bytes() + bytes(5_000)
    (tmp_path / "a.tif.gz").write_bytes(gzip.compress(with_more))
    with pytest.raises(ConfigError, match=r"a\.tif\.gz: has \d+ bytes and expands to more than 5,"):
        read_image(tmp_path / "a.tif.gz")
    write_image(tmp_path / "b.fits", np.zeros((120, 120), dtype=np.float32))
    (tmp_path / "b.fits.gz").write_bytes(gzip.compress((tmp_path / "b.fits").read_bytes()))
    with pytest.raises(ConfigError, match="expands to more than 50,000"):
        read_image(tmp_path / "b.fits.gz")
    cube = fits.CompImageHDU(np.zeros((40, 30, 30), dtype=np.int16))
    fits.HDUList([fits.PrimaryHDU(), cube]).writeto(tmp_path / "c.fits.fz")
    monkeypatch.setattr(image_file, "MAX_EXPANDED_FITS_BYTES", 50_000)
    with pytest.raises(ConfigError, match="expands to 72,000 bytes; at most 50,000 are read"):
        read_image(tmp_path / "c.fits.fz", plane=3)


def test_damaged_gzip_files_are_refused(tmp_path):
    write_image(tmp_path / "a.fits", np.zeros((64, 64), dtype=np.float32))
    packed = gzip.compress((tmp_path / "a.fits").read_bytes())
    for damaged in (packed[:-8], packed[:60], packed[:-4] + b"\0\0\0\1", b"\x1f\x8b\x08nothing"):
        (tmp_path / "a.fits.gz").write_bytes(damaged)
        with pytest.raises(ConfigError, match=r"a\.fits\.gz: damaged gzip file"):
            read_image(tmp_path / "a.fits.gz")
        with pytest.raises(ConfigError, match=r"a\.fits\.gz"):
            starcat.read_frames(tmp_path / "a.fits.gz")


def test_one_bad_file_of_many_is_named_with_the_way_around_it(tmp_path):
    for name, text in (("a", "x_px,y_px\n1,2\n"), ("b", ""), ("c", "x_px,y_px\n3,4\n")):
        (tmp_path / f"{name}.csv").write_text(text)
    with pytest.raises(ConfigError, match=r"b\.csv: the file is empty.*one of the 3 files.*leave"):
        starcat.read_frames(str(tmp_path / "*.csv"))
    with pytest.raises(ConfigError, match=r"b\.csv: the file is empty[^(]*$"):
        starcat.read_frames(tmp_path / "b.csv")
    (tmp_path / "b.csv").unlink()
    assert len(starcat.read_frames(str(tmp_path / "*.csv"))) == 2
    assert len(starcat.read_frames(tmp_path)) == 2


def test_the_content_of_a_picture_counts_and_not_its_name(tmp_path):
    image = np.arange(30 * 40, dtype=np.uint8).reshape(30, 40)
    for suffix in (".png", ".tif", ".jpg", ".fits"):
        write_image(tmp_path / f"a{suffix}", image)
        data = (tmp_path / f"a{suffix}").read_bytes()
        for name, content in (("a", data), ("a.csv", data), ("a.csv.gz", gzip.compress(data))):
            (tmp_path / name).write_bytes(content)
            assert contents.read_content(tmp_path / name).is_picture, (suffix, name)
    table = b"BMAG,x_px,y_px\n1,2,3\n"  # begins as BMP does
    for name, content in (("b.csv", table), ("b.csv.gz", gzip.compress(table))):
        (tmp_path / name).write_bytes(content)
        [frame] = starcat.read_frames(tmp_path / name)
        assert frame.centroids_px.tolist() == [[2.0, 3.0]]


def test_a_file_is_read_once(tmp_path, monkeypatch):
    read = []
    reader = contents.read_regular_file

    def counted(path, max_bytes):
        read.append(path.name)
        return reader(path, max_bytes)

    monkeypatch.setattr(contents, "read_regular_file", counted)
    write_image(tmp_path / "a.fits", np.zeros((30, 40), dtype=np.float32))
    (tmp_path / "b.csv").write_text("x_px,y_px\n1,2\n")
    starcat.read_frames(str(tmp_path / "*"))
    assert sorted(read) == ["a.fits", "b.csv"]


def test_a_file_of_centroids_has_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(contents, "MAX_BYTES", 1_000)
    (tmp_path / "a.csv").write_text("x_px,y_px\n" + "1,2\n" * 300)
    with pytest.raises(ConfigError, match=r"a\.csv: has more than 1,000 bytes of centroids"):
        starcat.read_frames(tmp_path / "a.csv")
