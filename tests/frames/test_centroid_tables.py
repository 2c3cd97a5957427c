"""Centroid files that need a library: FITS tables, VOTable and Parquet, by content and not name."""

from __future__ import annotations

import gzip
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from astropy.table import Table

import starcat
from starcat.errors import ConfigError
from starcat.frames.images.image_file import write_image
from starcat.frames.images.measure import measure_file

PX = np.array([[455.5, 327.25], [125.0, 266.75], [3.5, 4.5]])
FLUX = np.array([100.0, 1.0, 10.0])


def astrometry_net() -> fits.HDUList:
    """A list of sources as `image2xy` writes it."""
    columns = [
        fits.Column(name, "E", array=values)
        for name, values in (("X", PX[:, 0] + 0.5), ("Y", PX[:, 1] + 0.5), ("FLUX", FLUX))
    ]
    return fits.HDUList([fits.PrimaryHDU(), fits.BinTableHDU.from_columns(columns)])


def sextractor() -> fits.HDUList:
    """A catalog as SExtractor writes FITS_LDAC, with a column of two apertures."""
    header = fits.Column("Field Header Card", "80A", array=np.array(["SIMPLE  =    T"]))
    columns = [
        fits.Column("NUMBER", "J", array=np.arange(3)),
        fits.Column("X_IMAGE", "D", "pixel", array=PX[:, 0] + 0.5),
        fits.Column("Y_IMAGE", "D", "pixel", array=PX[:, 1] + 0.5),
        fits.Column("FLUX_APER", "2E", "count", array=np.ones((3, 2))),
        fits.Column("FLUX_AUTO", "E", "count", array=FLUX),
    ]
    parts = [fits.PrimaryHDU()]
    for name, of_part in (("LDAC_IMHEAD", [header]), ("LDAC_OBJECTS", columns)):
        parts.append(fits.BinTableHDU.from_columns(of_part, name=name))
    return fits.HDUList(parts)


def check(path: Path) -> tuple[str, ...]:
    """Compare a file with the centroids above; return its remarks."""
    measured = measure_file(path)
    [frame] = measured.frames
    assert measured.shape is None
    assert frame.name == path.stem
    np.testing.assert_allclose(frame.centroids_px, PX, atol=1e-5)
    np.testing.assert_allclose(frame.mag, [-5.0, 0.0, -2.5], atol=1e-6)
    return frame.remarks


@pytest.mark.parametrize("name", ["a.xyls", "a.axy", "a.fits", "a.fit", "a.dat", "a.fits.gz"])
def test_a_fits_table_is_read_whatever_its_name(name: str, tmp_path: Path) -> None:
    astrometry_net().writeto(tmp_path / "b.fits")
    data = (tmp_path / "b.fits").read_bytes()
    path = tmp_path / name
    path.write_bytes(gzip.compress(data) if name.endswith("gz") else data)
    [remark] = check(path)
    assert "X and Y were read as astrometry.net writes them" in remark


@pytest.mark.parametrize("name", ["a.ldac", "a.cat", "a.fits"])
def test_a_catalog_of_sextractor_is_read(name: str, tmp_path: Path) -> None:
    sextractor().writeto(tmp_path / name, output_verify="ignore")
    [remark] = check(tmp_path / name)
    assert remark.startswith("not used: NUMBER, FLUX_APER; used are X_IMAGE, Y_IMAGE, FLUX_AUTO")


def test_tables_of_astropy_and_arrow_are_read(tmp_path: Path) -> None:
    table = Table({"x_px": PX[:, 0], "y_px": PX[:, 1], "flux": FLUX, "note": ["a", "b", "c"]})
    for name, form in (("a.ecsv", "ascii.ecsv"), ("a.vot", "votable"), ("a.xml", "votable")):
        table.write(tmp_path / name, format=form)
        assert check(tmp_path / name) == ("not used: note; used are x_px, y_px, flux",)
    pq.write_table(pa.table({name: list(table[name]) for name in table.colnames}),
                   tmp_path / "a.parquet")  # fmt: skip
    assert check(tmp_path / "a.parquet") == ("not used: note; used are x_px, y_px, flux",)


def test_a_column_of_frames_separates_frames_of_a_table(tmp_path: Path) -> None:
    columns = {"x_px": PX[:, 0], "y_px": PX[:, 1], "frame": [7, 8, 7]}
    pq.write_table(pa.table(columns), tmp_path / "a.parquet")
    first, second = starcat.read_frames(tmp_path / "a.parquet")
    assert (first.name, second.name) == ("7", "8")
    assert first.centroids_px.tolist() == PX[[0, 2]].tolist()


def test_an_image_remains_an_image(tmp_path: Path) -> None:
    """Also with a table beside it, compressed in tiles, or under an unusual name."""
    image = np.random.default_rng(1).normal(100.0, 1.0, (64, 48)).astype(np.float32)
    write_image(tmp_path / "a.fits", image)
    parts = fits.HDUList([fits.PrimaryHDU(image), astrometry_net()[1]])
    parts.writeto(tmp_path / "b.fits")
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(image)]).writeto(tmp_path / "c.fits.fz")
    (tmp_path / "d.new").write_bytes((tmp_path / "a.fits").read_bytes())
    (tmp_path / "e.fits.gz").write_bytes(gzip.compress((tmp_path / "a.fits").read_bytes()))
    for name in ("a.fits", "b.fits", "c.fits.fz", "d.new", "e.fits.gz"):
        assert measure_file(tmp_path / name).shape == (64, 48), name


def test_what_is_wrong_with_a_table_is_said(tmp_path: Path) -> None:
    stars = fits.BinTableHDU.from_columns([fits.Column("RA", "D", array=[1.0])])
    fits.HDUList([fits.PrimaryHDU(), stars]).writeto(tmp_path / "a.fits")
    with pytest.raises(ConfigError, match="a table with the columns RA; expected the columns x_px"):
        measure_file(tmp_path / "a.fits")
    (tmp_path / "a.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(ConfigError, match=r"a\.parquet: cannot be read as Parquet"):
        measure_file(tmp_path / "a.parquet")
    texts = Table({"x_px": ["a", "b"], "y_px": [1.0, 2.0]})
    texts.write(tmp_path / "b.vot", format="votable")
    with pytest.raises(ConfigError, match=r"b\.vot: x_px: not an array of real numbers"):
        measure_file(tmp_path / "b.vot")
    (tmp_path / "a.vot").write_bytes(b"<?xml version='1.0'?><VOTABLE>")
    with pytest.raises(ConfigError, match=r"a\.vot: cannot be read as VOTable"):
        measure_file(tmp_path / "a.vot")
    count = pa.array(np.zeros(20_000_000, dtype=np.int8))
    pq.write_table(pa.table({"x_px": count, "y_px": count}), tmp_path / "b.parquet")
    assert (tmp_path / "b.parquet").stat().st_size < 200_000
    with pytest.raises(ConfigError, match="20,000,000 rows"):
        measure_file(tmp_path / "b.parquet")
