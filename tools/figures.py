"""Draw the pictures of docs/ as small files: ``make pictures``.

``flow.svg`` is the flow of data, ``frame.svg`` a simulated frame with the triangle that identified
it, ``time.svg`` the time of a frame and the frames identified against the noise of centroids,
and ``coverage.svg`` the map of the build's own report. ``identified.png``, ``plan.svg`` and
``calibration.svg`` are what commands draw. ``service_new.png`` and ``service_identify.png`` are
pages of the service, if there is a browser. ``benchmarks/false_matches.py --plot`` draws the bound.

A name or several (``python tools/figures.py plan calibration``) draw these alone.
"""

from __future__ import annotations

import io
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from itertools import combinations
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import starcat
from starcat_lab.report.plots import save_small_svg

FIGURES = Path(__file__).parents[1] / "docs" / "figures"

BOXES = {
    "catalogs": (0, 1, "catalogs", "SAO, Gaia, your own"),
    "table": (1, 1, "star table", "units, reasons"),
    "guide": (2, 1, "guide stars", "limits, doubles"),
    "products": (3, 1, "products", "pairs, triangles, ..."),
    "database": (4, 1, "database", "tested, with manifest"),
    "matcher": (5, 0, "matcher", "attitude of a frame"),
    "image": (5, 1, "onboard image", "C99 library, flight"),
    "sql": (5, 2, "SQL", "questions, TAP"),
    "registry": (5, 3, "registry", "published versions"),
}
ARROWS = (
    *("catalogs table", "table guide", "guide products", "products database"),
    *("database matcher", "database image", "database sql", "database registry"),
)
WIDTH, HEIGHT, GAP, ROW = 128, 46, 36, 66


def draw_flow(path: Path) -> None:
    """Draw boxes and arrows."""
    corner = {name: (10 + (WIDTH + GAP) * x, 10 + ROW * y) for name, (x, y, *_) in BOXES.items()}
    parts = []
    for arrow in ARROWS:
        start, end = (corner[name] for name in arrow.split())
        x, y = start[0] + WIDTH, start[1] + HEIGHT / 2
        to_x, to_y = end[0] - 3, end[1] + HEIGHT / 2
        bend = (x + to_x) / 2
        curve = f"M{x} {y}C{bend} {y} {bend} {to_y} {to_x} {to_y}"
        parts.append(f'<path class="a" marker-end="url(#h)" d="{curve}"/>')
    for name, (_, _, title, words) in BOXES.items():
        x, y = corner[name]
        parts.append(f'<rect x="{x}" y="{y}" width="{WIDTH}" height="{HEIGHT}" rx="6"/>')
        parts.append(f'<text class="b" x="{x + WIDTH / 2}" y="{y + 20}">{title}</text>')
        parts.append(f'<text x="{x + WIDTH / 2}" y="{y + 36}">{words}</text>')
    size = f"{20 + 6 * WIDTH + 5 * GAP} {20 + 3 * ROW + HEIGHT}"
    style = (
        "text{font:11px sans-serif;text-anchor:middle;fill:#33414b}"
        ".b{font-weight:bold;font-size:13px}"
        "rect{fill:#eef3f6;stroke:#2c6e9e}.a{fill:none;stroke:#2c6e9e;stroke-width:1.5}"
        "@media (prefers-color-scheme: dark){text{fill:#dbe3e9}rect{fill:#1d262c}}"
    )
    head = '<marker id="h" markerWidth="8" markerHeight="8" refX="6" refY="3" orient="auto">'
    head += '<path d="M0 0L7 3L0 6z" fill="#2c6e9e"/></marker>'
    body = "\n".join(parts)
    path.write_text(
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}">\n<style>{style}</style>\n'
        f"<defs>{head}</defs>\n{body}\n</svg>\n"
    )


def draw_frame(folder: Path, path: Path) -> None:
    """Draw a frame, its stars and the triangles of its brightest stars."""
    matcher = starcat.Matcher.open(folder)
    [frame] = starcat.simulate(folder, seed=11, false_stars=4)
    result = matcher.identify(frame)
    known, px = result.star_index >= 0, frame.centroids_px
    figure = Figure(figsize=(5.2, 5.2), layout="constrained")
    axes = figure.subplots()
    rows = np.flatnonzero(known)[np.argsort(frame.mag[known])][:5]
    for corners in combinations(rows, 3):
        closed = px[[*corners, corners[0]]]
        axes.plot(*closed.T, color="#b9c4cc", lw=0.7, zorder=1)
    first = px[[*rows[:3], rows[0]]]
    axes.plot(*first.T, color="#d1495b", lw=1.8, zorder=2, label="one triangle")
    size = 6.0 * 10.0 ** (-0.16 * (frame.mag - 6.5))
    axes.scatter(*px[known].T, size[known], color="#2c6e9e", zorder=3, label="identified star")
    axes.scatter(*px[~known].T, 40, color="#555555", marker="x", zorder=3, label="false star")
    camera = matcher.database.camera
    axes.set(xlim=(0, camera.width_px), ylim=(camera.height_px, 0), aspect="equal")
    axes.set(xlabel="x, px", ylabel="y, px")
    axes.legend(loc="lower left", fontsize="small")
    save_small_svg(figure, path)


def draw_time(folder: Path, path: Path) -> None:
    """Measure 300 hard frames at each noise, with the C library."""
    levels = (0.1, 0.25, 0.5, 1.0, 1.5, 2.0, 3.0)
    milliseconds, shares = [], []
    for noise in levels:
        matcher = starcat.Matcher.open(folder, noise_px=noise, noise_mag=0.3)
        frames = starcat.simulate(
            folder, 300, noise_px=noise, noise_mag=0.3, drop_probability=0.1, false_stars=3, seed=3
        )
        seconds, right = [], 0
        for frame in frames:
            begin = time.process_time_ns()
            result = matcher.identify(frame)
            seconds.append(1e-6 * (time.process_time_ns() - begin))
            right += result.ok
        milliseconds.append(np.percentile(seconds, [50, 95]))
        shares.append(right / 3.0)
    figure = Figure(figsize=(6.0, 3.4), layout="constrained")
    axes = figure.subplots()
    half, most = np.transpose(milliseconds)
    axes.plot(levels, half, "o-", color="#2c6e9e", label="median time, ms")
    axes.plot(levels, most, "s--", color="#2c6e9e", label="95 % of the frames, ms")
    axes.set(yscale="log", xlabel="noise of a centroid on each axis, px", ylabel="time, ms")
    right = axes.twinx()
    right.plot(levels, shares, "^-", color="#d1495b", label="identified, %")
    right.set(ylim=(0, 103), ylabel="identified, %")
    figure.legend(loc="outside upper center", ncols=3, fontsize="small")
    save_small_svg(figure, path)


def run_starcat(scratch: Path, *arguments: object) -> None:
    """Run a command of starcat in a folder."""
    command = [sys.executable, "-m", "starcat", *map(str, arguments)]
    subprocess.run(command, cwd=scratch, check=True, stdout=subprocess.DEVNULL)


def save_small_png(picture: bytes, path: Path) -> None:
    """Write a picture with a palette of 16 colours: a tenth of the bytes."""
    with Image.open(io.BytesIO(picture)) as image:
        image.convert("RGB").quantize(16, dither=Image.Dither.NONE).save(path, optimize=True)


def draw_identified(folder: Path, path: Path) -> None:
    """Draw an identified frame of Orion as ``identify --picture`` does."""
    with tempfile.TemporaryDirectory() as scratch:
        inside = Path(scratch)
        frame = inside / "frame.csv"
        run_starcat(inside, "simulate", folder, "-o", frame, "--seed", 552, "--false-stars", 3)
        run_starcat(inside, "identify", folder, frame, "--picture", inside / "identified.png")
        save_small_png((inside / "identified.png").read_bytes(), path)


def draw_plan(folder: Path, path: Path) -> None:
    """Draw a plan of two hours of a camera that turns with its orbit, as ``plan --plot`` does."""
    rows = ["time,ra_deg,dec_deg,roll_deg"]
    for minute in range(0, 120, 2):
        time_utc = f"2027-03-01T{6 + minute // 60:02d}:{minute % 60:02d}:00"
        rows.append(f"{time_utc},{(300 + 3.9 * minute) % 360:.3f},-10,0")
    with tempfile.TemporaryDirectory() as scratch:
        (Path(scratch) / "attitudes.csv").write_text("\n".join(rows) + "\n")
        limits = ("--limit-mag", 5.5, "--keep-out", "Sun=30,Moon=15", "--plot", path)
        run_starcat(Path(scratch), "plan", folder, "attitudes.csv", *limits)


def draw_calibration(folder: Path, path: Path) -> None:
    """Draw the residuals of a calibration as ``calibrate --plot`` does."""
    with tempfile.TemporaryDirectory() as scratch:
        frames = [f"frame{seed}.csv" for seed in range(1, 6)]
        for seed, name in enumerate(frames, 1):
            run_starcat(Path(scratch), "simulate", folder, "-o", name, "--seed", seed)
        size = ("--size", "1024x1024", "--fov", "10:15", "-o", "camera.toml", "--plot", path)
        run_starcat(Path(scratch), "calibrate", folder, *frames, *size)


def draw_service(folder: Path, path: Path) -> None:
    """Take pictures of two pages of the service in a browser."""
    sys.path.append(str(FIGURES.parents[1] / "tests" / "builders"))
    import browsing
    from served import serve
    from services import DATABASE, add_database

    if not browsing.CHROMIUM.exists():
        sys.stderr.write(f"no browser, no {path.name}: {browsing.CHROMIUM} is missing\n")
        return
    with tempfile.TemporaryDirectory() as scratch:
        inside = Path(scratch)
        add_database(inside / "root", folder)
        with (
            serve(inside / "root", inside / "log") as served,
            browsing.launched() as browser,
            browsing.opened(browser, served.address, 1100) as page,
        ):
            page.set_default_timeout(120_000)
            if path.name == "service_new.png":
                page.goto("/new")
                browsing.settled(page)
            else:
                page.goto(f"/identify?database={DATABASE}&seed=552")
                page.get_by_text("identified").first.wait_for()
            page.wait_for_timeout(1000)
            save_small_png(page.screenshot(full_page=False), path)


DRAWINGS: dict[str, Callable[[Path, Path], object]] = {
    "frame.svg": draw_frame,
    "time.svg": draw_time,
    "coverage.svg": lambda folder, path: shutil.copyfile(
        folder / "report" / "coverage_map.svg", path
    ),
    "identified.png": draw_identified,
    "plan.svg": draw_plan,
    "calibration.svg": draw_calibration,
    "service_new.png": draw_service,
    "service_identify.png": draw_service,
}
"""Functions that draw the pictures, of the folder of ``gaia-12deg`` and the path of the picture."""


def main() -> None:
    """Write the pictures, or those that are named."""
    names = sys.argv[1:] or [Path(name).stem for name in ("flow.svg", *DRAWINGS)]
    if "flow" in names:
        draw_flow(FIGURES / "flow.svg")
    with tempfile.TemporaryDirectory() as scratch:
        folder = starcat.build(starcat.preset("gaia-12deg"), scratch).folder
        for name, draw in DRAWINGS.items():
            if Path(name).stem in names:
                draw(folder, FIGURES / name)
    sys.stderr.write("wrote the pictures in docs/figures/\n")


if __name__ == "__main__":
    main()
