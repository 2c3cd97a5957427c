"""Write down what must not change: ``python tests/builders/freeze.py FOLDER [--only SECTION]``.

Run it with the code before and with the code after (``PYTHONPATH`` says which), each into a folder
of its own; ``diff -r`` of the two is the proof that a user sees the same. It knows the program
from outside only: the command line, a server over HTTP, and the public names of ``starcat``.

Manifests and digests of files are as they are. In all else `HIDDEN` and `TIMED` stand for what
no two runs have in common, numbers have nine digits, and objects of JSON are sorted by key.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import inspect
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any
from urllib.parse import quote_plus, urlencode

from served import Answer, Served, serve

HIDDEN = {
    r"127\.0\.0\.1:\d+": "127.0.0.1:<port>",
    r"starcat_[\w-]{43}": "<token>",
    r"\b[0-9a-f]{32}\b|\b[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}\b": "<id>",
    r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d(:\d\d(\.\d+)?)?(Z|\+00:00)?": "<time>",
    r"\w{3}, \d\d \w{3} \d{4} \d\d:\d\d:\d\d GMT": "<time>",
    r"/static/[0-9a-f]{12}/": "/static/<digest>/",
    # Rows of tables: the times of a build and of an answer, and those of an evaluation.
    r"(?m)^(time_s|read|select|products|write|self-test|report|verify|total) +[\d.e-]+ *$":
        r"\1 <seconds>",
    r"(?m)(\[[\d., ]+\] .*\d) +[\d.]+ *$": r"\1 <ms>",
    r"wrong +ms": "wrong ms",
    r"(\d+\xa0min )?[\d.]+\xa0s(?=[.<])": "<seconds>",
    r"(?m)^[0-9a-f]{8}(?=  |$)": "<token id>",
    r"(?m) +$": "",
    r'("?\b(time_s|at_s)"?: )[\d.e-]+': r"\1<seconds>",
}  # fmt: skip
TIMED = re.compile(r"(time|times|created|started|ended|at|published)_s|\w+_ms")
"""Keys of JSON whose values are times."""
LONG = re.compile(r"(?<![\w.])-?\d+\.\d{7,}(?:e[+-]?\d+)?(?![\w.])")
LARGE = 1_000_000
"""Of a text with more characters the digest is written."""

SMALL = (
    "--set selection.faint_limit_mag=5 --set camera.fov_x_deg=20 --set boresights.count=2000"
    " --set self_test.frames=20"
)
BUILT = {
    "mine": f"--preset gaia-12deg --set 'name=\"mine\"' {SMALL}",
    "later": f"--preset gaia-12deg --set 'name=\"mine\"' {SMALL} --set 'version=\"1.1.0\"'"
    " --set selection.max_stars=2000 --set 'selection.doubles.action=\"merge\"'",
    "all": f"--preset sao-12deg --set 'name=\"all\"' {SMALL} --set products.levels.enabled=true"
    " --set products.crossmatch.enabled=true"
    ' --set \'products.crossmatch.catalogs=["hipparcos", "gaia"]\''
    ' --set \'selection.variables.join=["hipparcos", "tycho1", "gcvs"]\''
    " --set selection.max_stars_per_field=30 --set 'catalog.motions=[\"hipparcos\"]'",
}
"""Databases that the sections ask: a small one, its next version, and one with every product."""
MINE, LATER, ALL = "dist/mine-1.0.0", "dist/mine-1.1.0", "dist/all-1.0.0"
NORTH = "SELECT designation, mag, separation_deg FROM cone(38, 89, 9) ORDER BY mag"
FORMATS = ("csv", "json", "parquet", "votable", "fits", "ecsv", "npz")
SEEDS = range(1, 6)

COMMANDS = f"""
presets: presets
presets-one: presets sao-12deg
sources: sources
methods: methods
estimate-sao: estimate --preset sao-12deg
presets-toml: presets sao-12deg --toml
estimate: estimate specs/wide.toml
init: init specs/mycam.toml --size 1280x960 --focal-mm 25 --pixel-um 5.5 --replace
init-range: init specs/range.toml --size 1280x960 --fov-range 10:20 --faint-limit 5.8 --replace
build: build specs/wide.toml -o wide --replace
inspect-all: inspect {ALL}
coverage-files: coverage {MINE} -o files/coverage
verify-all: verify {ALL}
diff: diff {MINE} {LATER}
rebuild: rebuild {ALL}
sql: sql {MINE} "{NORTH}"
sql-list: sql --list
sql-macros: sql --macros
sql-views: sql {ALL} --views
sql-preamble: sql {MINE} --preamble
sql-two: sql {MINE} {LATER} --named changed-stars
sql-reasons: sql {ALL} "SELECT reason, count(*) AS n FROM rejected GROUP BY reason ORDER BY reason"
sql-source: sql sao "SELECT count(*) AS n, min(mag) AS brightest_mag FROM stars"
sql-store: sql files/store "SELECT star_id, mag FROM cone(83.6, -5.4, 3) ORDER BY mag, star_id"
sql-empty: sql {MINE} "SELECT * FROM stars WHERE mag > 90"
simulate: simulate {MINE} -o frames/again.csv --seed 7 --false-stars 3
simulate-image: simulate {MINE} -o frames/again.png --seed 7
identify: identify {MINE} frames/1.csv
identify-frames: identify {MINE} frames/frames.json
identify-ndjson: identify {MINE} frames/frames.json --ndjson
identify-track: identify {MINE} frames/still.json --track
identify-noise: identify {MINE} frames/1.csv --noise-px 0.5 --noise-mag 0.3 --fov-error 5%
identify-wide: identify {ALL} frames/wide.csv --fov 18:32 --size 1024x1024
identify-prior: identify {MINE} frames/1.csv --prior-q 0,0,0,1 --prior-error-deg 2
identify-time: identify {MINE} frames/1.csv --time 2026-11-22T10:00:00 --velocity 0,7.5,0
identify-png: identify {MINE} frames/1.png --picture files/pictures/1.svg
identify-fits: identify {MINE} frames/1.fits --wcs files/pictures/w.fits
identify-few: identify {MINE} bad/few.csv --fail-on-no-match
identify-onboard: identify files/onboard.img frames/1.csv
calibrate: calibrate {MINE} frames/1.png frames/2.png frames/3.png -o files/camera.toml \
--plot files/pictures/left.svg
export: export {ALL} -o files/csv --replace
export-onboard: export {MINE} --to onboard -o files/onboard.img --replace
selftest: selftest {MINE} --frames 20
evaluate: evaluate {MINE} --noise-px 0,1 --false-stars 2 --frames 10 -o evaluated
publish: publish {MINE} registry
publish-later: publish {LATER} registry
releases: releases registry
pull: pull mine@latest --registry registry -o pulled
pull-old: pull mine@1.0.0 --registry registry -o pulled
pull-locked: pull --locked -o pulled
ingest: ingest sao -o files/sao.parquet --epoch-jyear 2026.0
ingest-band: ingest hipparcos -o files/hipparcos.parquet --band Hp --read-limit-mag 5
ingest-hats: ingest sao --to hats -o files/store --max-partition-rows 3000 --replace
crossmatch: crossmatch files/sao.parquet files/hipparcos.parquet -o files/both.parquet
build-store: build --preset sao-12deg {SMALL} --input sao=files/store -o of-store
inspect-onboard: inspect files/onboard.img
verify-onboard: verify files/onboard.img --against {MINE}
token-list: token list --root service
token-create: token create anna --role builder --root service
token-revoke: token revoke anna --root service
"""
"""What is asked, by name; each is run without and with ``--json``."""

FIRST = ("ingest", "simulate", "export", "publish", "token-create")
"""Commands whose files others read: those go before the rest."""

EXPORTED = {
    "pyramid.img": "onboard --method pyramid", "big.img": "onboard --endian big",
    "onboard.c": "c", "hats": "hats --product stars",
}  # fmt: skip
BAD_FILES = {
    "few.csv": "x_px,y_px,mag\n100,100,2\n500,400,3\n",
    "letters.csv": "x_px,y_px\n1,2\n3,abc\n",
    "frame.png": "no picture",
    "sao.dat": "no catalog at all\nnor this\n",
    "cut.dat.gz": b"\x1f\x8b\x08\x00\x00\x00\x00\x00\x00\x03K",
    "index/index.json": '{"format": "other"}',
    "service/service.toml": "portt = 8000\n",
    "full/file": "",
}

ERRORS = f"""
build
build --preset sao-12degs
build --preset gaia-12deg --set selection.faint_limit_mga=6
build --preset gaia-12deg --set selection.faint_limit_mag=six
build --preset gaia-12deg --set selection.bright_limit_mag=7
build --preset sao-12deg --input sao.dat.gz
build --preset gaia-12deg --max-memory 0.1 -o bad/out
build --preset gaia-12deg --set selection.faint_limit_mag=-20 -o bad/out
ingest soa -o bad/out.parquet
ingest sao --band K -o bad/out.parquet
ingest sao --input bad/sao.dat -o bad/out.parquet
ingest sao --input bad/cut.dat.gz -o bad/out.parquet
crossmatch bad/none.parquet bad/none.parquet -o bad/out.parquet
identify {MINE} bad/none.csv
identify {MINE} bad/letters.csv
identify {MINE} bad/frame.png
identify {MINE} frames/1.csv --method triangles
identify {MINE} frames/1.csv --fov 5:20
identify {MINE} frames/1.csv --tolerance-px 2 --noise-px 0.5
identify {MINE} frames/1.csv --tolerance-px 900
calibrate {MINE} bad/few.csv -o bad/camera.toml
inspect bad/none-1.0.0
inspect bad/newer
verify bad/damaged
sql nosuch "SELECT 1"
sql {MINE} "SELEC 1"
sql {MINE} "COPY stars TO 'x.csv'"
sql {MINE} "SELECT * FROM read_csv('x.csv')"
sql {MINE} "SELECT magg FROM stars"
sql {MINE} --named densest-feilds
export {MINE} --product star -o bad/out
export {MINE} --to onboard --max-bytes 9000 -o bad/x.img
export {MINE} -o bad/full/file
publish {MINE} https://example.org/registry
publish bad/damaged bad/registry
pull mine@9.9.9 --registry bad/registry -o bad/out
pull nothing --registry bad/index
serve --root bad/service
serve --root bad/open --host 0.0.0.0
token create "a b" --role reader --root bad/people
sql {MINE} --ouput x
--server localhost:8000 sql {MINE} "SELECT 1"
--server http://127.0.0.1:9 releases bad/registry
"""


class Freezer:
    """Runs the program, and writes what it says into a folder."""

    def __init__(self, out: Path, work: Path, catalogs: Path) -> None:
        self.out, self.catalogs = out, catalogs
        self.known = {str(work): "<work>", str(catalogs): "<catalogs>", sys.prefix: "<prefix>"}

    def write(self, name: str, text: str) -> None:
        path = self.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text.rstrip("\n") + "\n", encoding="utf-8")

    def clean(self, text: str) -> str:
        """Return a text with what changes from run to run replaced."""
        for found, shown in self.known.items():
            text = text.replace(found, shown)
        for pattern, shown in HIDDEN.items():
            text = re.sub(pattern, shown, text)
        return LONG.sub(lambda number: f"{float(number[0]):.9g}", text)

    def tidy(self, value: Any, key: str = "") -> Any:
        """Return content of JSON with the same replaced."""
        if TIMED.fullmatch(key) and value is not None:
            return "<time>"
        if isinstance(value, dict):
            return {self.clean(name): self.tidy(one, name) for name, one in value.items()}
        if isinstance(value, list):
            return [self.tidy(one) for one in value]
        if isinstance(value, float):
            return float(f"{value:.9g}")
        return self.clean(value) if isinstance(value, str) else value

    def shown(self, text: str) -> str:
        """Return a text as it is written: JSON sorted, what is large as its digest."""
        try:
            value = json.loads(text)
        except ValueError:
            value = None
        is_json = isinstance(value, dict | list)
        cleaned = json_text(self.tidy(value)) if is_json else self.clean(text)
        if len(cleaned) > LARGE:
            return f"{len(cleaned)} characters, sha256 {sha256(cleaned.encode())}"
        return cleaned

    def run(self, line: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "starcat", *shlex.split(line)]
        return subprocess.run(command, capture_output=True, text=True, check=False, timeout=500)

    def tell(self, name: str, line: str, *, is_for_people: bool = True) -> None:
        """Run a command with ``--json``, and without, and write what it says."""
        for more in ["", " --json"] if is_for_people else [" --json"]:
            done = self.run(line + more)
            said = f"$ starcat {self.clean(line + more)}\nexit code {done.returncode}\n--- stdout\n"
            said += f"{self.shown(done.stdout)}\n--- stderr\n{self.shown(done.stderr)}"
            self.write(f"{name}{'.json' if more else ''}.txt", said)

    def prepare(self) -> None:
        """Build the databases that the sections ask, and make frames, good and bad ones."""
        for line in BUILT.values():
            done = self.run(f"build {line} -o dist")
            assert done.returncode == 0, done.stderr
        for folder in ("frames", "specs", "files/pictures", "files/answers"):
            Path(folder).mkdir(parents=True)
        for frame in (*(f"{n}.csv" for n in SEEDS), *(f"{n}.png" for n in SEEDS[:3]), "1.fits"):
            self.run(f"simulate {MINE} -o frames/{frame} --seed {frame[0]}")
        self.run(f"simulate {ALL} -o frames/wide.csv --seed 3")
        frames = [frame_of(Path(f"frames/{n}.csv")) for n in SEEDS]
        Path("frames/frames.json").write_text(json.dumps(frames))
        Path("frames/still.json").write_text(json.dumps([frames[0]] * 3))
        text = self.run("presets sao-12deg --toml").stdout.replace("sao-12deg", "wide", 1)
        for name, value in {"fov_x_deg": 25.0, "faint_limit_mag": 4.5, "frames": 20}.items():
            text = re.sub(rf"(?m)^{name} = .*", f"{name} = {value}", text, count=1)
        Path("specs/wide.toml").write_text(text)
        for name, content in BAD_FILES.items():
            path = Path("bad", name)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content if isinstance(content, bytes) else content.encode())
        for name in ("damaged", "newer"):
            shutil.copytree(MINE, Path("bad", name), copy_function=shutil.copyfile)
        with Path("bad/damaged/pairs.parquet").open("r+b") as file:
            file.write(b"?")
        path = Path("bad/newer/manifest.json")
        path.write_text(path.read_text().replace('_version": "1.', '_version": "2.', 1))


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def json_text(value: Any) -> str:
    return json.dumps(value, indent=1, sort_keys=True, ensure_ascii=False)


def digests(folder: Path) -> str:
    """Return a line for each file of a folder: its digest, its size and its path."""
    found = [folder] if folder.is_file() else sorted(p for p in folder.rglob("*") if p.is_file())
    root = folder.parent if folder.is_file() else folder
    read = ((path.read_bytes(), path.relative_to(root).as_posix()) for path in found)
    return "\n".join(f"{sha256(content)} {len(content):>10} {name}" for content, name in read)


def frame_of(path: Path) -> dict[str, Any]:
    """Return a frame of centroids as JSON has it."""
    rows = list(csv.DictReader(path.read_text().splitlines()))
    points = [[float(row["x_px"]), float(row["y_px"])] for row in rows]
    return {"name": path.stem, "centroids_px": points, "mag": [float(row["mag"]) for row in rows]}


def freeze_help(freezer: Freezer) -> None:
    """Write the help of the program, of its commands, and of those of its groups."""
    waiting = [""]
    for words in waiting:
        text = freezer.run(f"{words} --help").stdout
        freezer.write(f"help/starcat{words.replace(' ', '-')}.txt", freezer.clean(text))
        listed = text.partition("Commands:\n")[2]
        waiting += [f"{words} {name}" for name in re.findall(r"(?m)^  (\w+)", listed)]
    freezer.write("help/version.txt", freezer.clean(freezer.run("--version").stdout))


def freeze_builds(freezer: Freezer) -> None:
    """Build every preset whose catalogs are here; the small databases are looked at as well."""
    for preset in json.loads(freezer.run("presets --json").stdout):
        name = preset["name"]
        line = f"build --preset {name} -o dist"
        freezer.tell(f"builds/{name}", line, is_for_people=False)
        if name.startswith("2mass"):
            line += f" --input 2mass={freezer.catalogs / 'psc_estimated.gz'}"
            freezer.tell(f"builds/{name}-from-file", line, is_for_people=False)
    for folder in sorted(Path("dist").glob("*-*/")):
        manifest = json.loads((folder / "manifest.json").read_text())
        freezer.write(f"builds/{folder.name}/manifest_sha256", manifest["manifest_sha256"])
        freezer.write(f"builds/{folder.name}/manifest.json", json_text(manifest))
        freezer.write(f"builds/{folder.name}/files", digests(folder))


def freeze_commands(freezer: Freezer) -> None:
    """Run `COMMANDS`, each method and each format; keep digests of what they wrote."""
    told = dict(line.split(": ", 1) for line in COMMANDS.strip().splitlines())
    more = {}
    for method in json.loads(freezer.run("methods --json").stdout):
        name = method["method"]
        more[f"method-{name}"] = f"identify {MINE} frames/2.csv --method {name}"
    for form in FORMATS:
        # The largest tables are written as CSV only.
        products = "--product stars --product crossmatch --product levels --product grid"
        more[f"export-{form}"] = f"export {ALL} --to {form} {products} -o files/{form} --replace"
        more[f"sql-{form}"] = f'sql {MINE} "{NORTH}" -o files/answers/north.{form}'
        more[f"sql-{form}-shown"] = f'sql {MINE} "{NORTH}" --format {form}'
    for name, to in EXPORTED.items():
        line = f"export {MINE} --to {to} -o files/{name} --replace"
        more[f"export-{name.replace('.', '-')}"] = line
    both = told | more
    for name in sorted(both, key=lambda one: not one.startswith(FIRST)):
        freezer.tell(f"commands/{name}", both[name], is_for_people=name in told)
    for path in sorted([*Path("files").iterdir(), Path("frames")]):
        freezer.write(f"files/{path.name}", digests(path))
    for name in ("starcat.lock", "specs/mycam.toml", "specs/range.toml", "files/camera.toml"):
        freezer.write(f"written/{Path(name).name}", freezer.shown(Path(name).read_text()))
    made = sorted(p.relative_to("evaluated").as_posix() for p in Path("evaluated").rglob("*.*"))
    freezer.write("written/evaluated", "\n".join(made))  # the times of the trials are in them


def freeze_errors(freezer: Freezer) -> None:
    """Run what cannot be done; for people too where it is the first of its command."""
    freezer.run(f"publish {MINE} bad/registry")
    freezer.run("token create anna --role reader --root bad/people")
    seen = set()
    for number, line in enumerate(ERRORS.strip().splitlines(), 1):
        command = line.split()[0].strip("-")
        freezer.tell(f"errors/{number:02}-{command}", line, is_for_people=command not in seen)
        seen.add(command)


def freeze_python(freezer: Freezer) -> None:
    """Write the public names with their parameters, and what they answer."""
    import starcat

    faces = {}
    for name in starcat.__all__:
        one = getattr(starcat, name)
        is_shown = inspect.isclass(one) and name != "StarcatError"
        members = [m for m in dir(one) if is_shown and m[0] != "_"]
        faces[name] = parameters(one)
        faces |= {f"{name}.{m}": parameters(getattr(one, m)) for m in members}
    freezer.write("python/names.json", json_text(faces))

    database = starcat.open(MINE)
    matcher = starcat.Matcher.open(MINE, noise_px=0.5, noise_mag=0.3)
    frames = json.loads(Path("frames/frames.json").read_text())
    points, mags = ([one[key] for one in frames] for key in ("centroids_px", "mag"))
    many = matcher.identify_many(points, magnitudes=mags)
    near = {"prior": many[0].q_body_from_icrs, "prior_error_deg": 0.5}
    observer = starcat.Observer.at("2026-11-22T10:00:00", velocity_km_s=[0.0, 7.5, 0.0])
    spots = matcher.database, points[0], matcher.database.camera, observer
    with starcat.connect(MINE, LATER) as connection:
        stars = connection.sql("SELECT count(*) AS n, min(mag) AS least FROM a.stars").to_arrow()
    found = starcat.calibrate(MINE, [f"frames/{n}.png" for n in SEEDS[:3]], fov_deg=(15, 25))
    answers = {
        "open": [database, list(database.products), database.spec],
        "stars": [str(database.stars.schema), database.stars.slice(0, 2).to_pylist()],
        "sql": [database.sql(NORTH).to_arrow().to_pylist(), stars.to_pylist()],
        "said": [str(x) for x in (matcher, database.verify(), starcat.verify(ALL), found)],
        "identified": [*map(facts, many)],
        "batch": [many.status, many.q_body_from_icrs],
        "not_identified": facts(matcher.identify(points[0][:2])),
        "with_prior": facts(matcher.identify(points[0], **near)),
        "objects": [str(many[0].table()), str(many[0].wcs().pixel_to_world(511.5, 383.5))],
        "sky": facts(starcat.sky_in_time(many[0], *spots)),
        "in_time": facts(starcat.identify_in_time(matcher.identify, *spots)),
        "tracked": [*map(facts, starcat.Tracker(matcher).follow([points[0]] * 3))],
        "preset": [starcat.preset("sao-12deg"), starcat.read_spec("specs/wide.toml")],
        "built": str(starcat.build("specs/wide.toml", "python").folder),
        "ingested": starcat.ingest("sao").stars.num_rows,
    }
    for name, answer in answers.items():
        freezer.write(f"python/{name}.json", json_text(freezer.tidy(plain(answer))))


def parameters(one: Any) -> str:
    """Return names, kinds and defaults; annotations name what may be renamed."""
    if not callable(one) or (inspect.isclass(one) and issubclass(one, Exception)):
        return ""
    found = inspect.signature(one).parameters.values()
    bare = [parameter.replace(annotation=inspect.Parameter.empty) for parameter in found]
    return re.sub(r" at 0x\w+|starcat\.[\w.]+\.", "", str(inspect.Signature(bare)))


def facts(result: Any) -> dict[str, Any]:
    """Return what a result says of itself; where it refuses, what it says then."""
    values = {}
    for name in {*dir(result)} - {"asked"}:
        if not name.startswith("_"):
            try:
                values[name] = getattr(result, name)
            except Exception as error:
                values[name] = str(error)
    return {name: value for name, value in values.items() if not callable(value)}


def plain(value: Any) -> Any:
    """Return a value as JSON has it: specs by their keys, arrays as lists, others as they print."""
    for method in ("model_dump", "tolist"):
        value = getattr(value, method)() if hasattr(value, method) else value
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    return value if isinstance(value, bool | int | float | str | None) else str(value)


BRIGHT = (
    "SELECT TOP 9 designation, ra_deg, mag FROM mine_1_0_0.stars WHERE mag < 2 ORDER BY mag, ra_deg"
)
CIRCLE = (
    "SELECT COUNT(*) AS n FROM mine_1_0_0.stars WHERE"
    " 1 = CONTAINS(POINT(ra_deg, dec_deg), CIRCLE(83.6, -5.4, 10))"
)
CAMERA = {"name": "cam", "camera": {"width_px": 1280, "height_px": 960, "fov_x_deg": 15}}
PRESET = {"preset": "gaia-12deg", "changes": {"selection.faint_limit_mag": "5"}}

GETS = f"""
/ /new /new?database=@mine /new/tiling?count=10 /jobs /jobs/@job /databases /databases/@mine
/databases/@mine/coverage /databases/@mine/coverage.png /databases/@mine/fields.json
/databases/@mine/report /databases/@mine/compare?other=@later /databases/@mine/sql
/databases/@mine/sql?query=SELECT+count(*)+AS+n+FROM+stars /databases/@mine/sql?query=SELEC
/databases/@mine/sql/file?query=SELECT+1+AS+one&format=csv /databases/0123456789abcdef
/identify /identify/frame/@mine?seed=3 /releases?database=@mine /sign-in /nothing
/api/docs /api/openapi.json /healthz /readyz
/api/v1/specs/schema /api/v1/specs/presets /api/v1/specs/presets/sao-12deg
/api/v1/specs/presets/nothing /api/v1/catalogs /api/v1/jobs?kind=build /api/v1/jobs?limit=many
/api/v1/jobs/@job /api/v1/jobs/0123456789abcdef0123456789abcdef
/api/v1/databases /api/v1/databases/@mine /api/v1/databases/nothing
/api/v1/databases/@mine/manifest /api/v1/databases/@mine/report /api/v1/databases/@mine/coverage
/api/v1/databases/@mine/diff/@later?most=3 /api/v1/databases/@mine/files
/api/v1/databases/@mine/files/report/coverage.json /api/v1/databases/@mine/files/../secret
/api/v1/databases/@mine/archive /api/v1/identify/options /api/v1/sql/queries /api/v1/sql/macros
/api/v1/sql/views?target=@mine /api/v1/sql/views?target=nothing
/scs/mine?RA=83.6&DEC=-5.4&SR=3 /scs/sao?RA=83.6&DEC=-5.4&SR=1&RESPONSEFORMAT=csv
/scs/mine?RA=x&DEC=-5.4&SR=3 /scs/nothing?RA=1&DEC=2&SR=3
/tap/capabilities /tap/availability /tap/tables /tap/tables/mine_1_0_0.stars
/tap/tables/mine.nothing /tap/examples /tap/sync?LANG=ADQL
/tap/sync?LANG=ADQL&QUERY={quote_plus(CIRCLE)}
/tap/sync?LANG=ADQL&QUERY={quote_plus("SELECT * FROM TAP_SCHEMA.columns")}&RESPONSEFORMAT=csv
/tap/sync?LANG=ADQL&QUERY={quote_plus("SELECT nothing FROM mine_1_0_0.stars")} /tap/async/nothing
"""

REQUESTS = f"""
page-new-wrong POST /new form name=No+name&preset=gaia-12deg
page-preview POST /new/preview form preset=gaia-12deg
page-identified POST /identify multipart database=@mine
page-sign-in-wrong POST /sign-in form token=starcat_wrong
validate POST /api/v1/specs/validate json {json.dumps(PRESET)}
validate-toml POST /api/v1/specs/validate toml name = "x"
validate-text POST /api/v1/specs/validate text name
validate-400 POST /api/v1/specs/validate json {{"preset"
validate-413 POST /api/v1/specs/validate toml *2000000
estimate POST /api/v1/specs/estimate json {json.dumps(PRESET)}
coverage POST /api/v1/specs/coverage json {json.dumps(PRESET)}
starter POST /api/v1/specs/starter json {json.dumps(CAMERA)}
starter-422 POST /api/v1/specs/starter json {{"name": "cam"}}
jobs-401 POST /api/v1/jobs json {{"kind": "build", "preset": "gaia-12deg"}}
jobs-403 POST /api/v1/jobs json {{"kind": "build", "preset": "gaia-12deg"}} as reader
jobs-wrong POST /api/v1/jobs json {{"kind": "sweep"}} as builder
jobs-preset POST /api/v1/jobs json {{"kind": "build", "preset": "nothing"}} as builder
jobs-source POST /api/v1/jobs json {{"kind": "ingest", "source": "gcvs"}} as builder
jobs-again POST /api/v1/jobs json @wish as builder
job-cancel-done POST /api/v1/jobs/@job/cancel as publisher
job-retry-done POST /api/v1/jobs/@job/retry as publisher
databases-405 PUT /api/v1/databases
database-file-head HEAD /api/v1/databases/@mine/files/database.h5
database-delete-403 DELETE /api/v1/databases/@later as builder
releases-403 POST /api/v1/releases json {{"database": "@mine"}} as builder
releases-post POST /api/v1/releases json {{"database": "@mine", "note": "first"}} as publisher
releases-again POST /api/v1/releases json {{"database": "@mine"}} as publisher
releases-404 POST /api/v1/releases json {{"database": "nothing"}} as publisher
releases GET /api/v1/releases
releases-page GET /releases
release GET /api/v1/releases/mine/1.0.0
release-404 GET /api/v1/releases/mine/9.9.9
registry GET /registry/index.json
registry-version GET /registry/versions/mine/1.0.0.json
registry-404 GET /registry/secret
identify POST /api/v1/identify/@mine json @frame
identify-upload POST /api/v1/identify/@mine multipart options={{"fov_error": 0.02}}
identify-picture POST /api/v1/identify/@mine/picture?format=svg json @frame
identify-wrong POST /api/v1/identify/@mine json {{"centroids_px": [[1]]}}
identify-415 POST /api/v1/identify/@mine text 1,2
sql-named POST /api/v1/sql json {{"targets": ["@mine"], "named": "emptiest-fields"}}
sql-wrong POST /api/v1/sql json {{"targets": ["@mine"], "query": "SELEC 1"}}
sql-writes POST /api/v1/sql json {{"targets": ["@mine"], "query": "DROP TABLE stars"}}
sql-422 POST /api/v1/sql json {{"targets": []}}
host-wrong GET /api/v1/databases with Host: example.org
origin-wrong POST /api/v1/jobs json {{}} with Origin: http://example.org
token-wrong GET /api/v1/databases as nobody
delete DELETE /api/v1/databases/@later as publisher
delete-again DELETE /api/v1/databases/@later as publisher
"""
"""Name, method, address; then what is sent, ``as`` whom, and ``with`` which header."""

LINE = re.compile(
    r"(?P<name>\S+) (?P<method>[A-Z]+) (?P<target>\S+)"
    r"(?: (?P<kind>json|toml|text|form|multipart) (?P<body>.+?))?"
    r"(?: as (?P<who>\w+))?(?: with (?P<header>[\w-]+): (?P<value>\S+))?"
)
TYPES = {
    "text": "text/plain",
    "form": "application/x-www-form-urlencoded",
    "multipart": "multipart/form-data; boundary=freeze",
}
UWS = ("/phase", "/owner", "/parameters", "/results", "/results/result", "/error")
LEFT_OUT = {"date", "content-length", "x-request-id", "retry-after"}


class Asker:
    """Sends requests to a server, and writes the answers."""

    def __init__(self, freezer: Freezer, served: Served, tokens: dict[str, str]) -> None:
        self.freezer, self.served, self.tokens = freezer, served, tokens
        self.names: dict[str, str] = {}

    def ask(self, line: str) -> Answer:
        """Send a request, again while the server is busy, and write its answer."""
        for name, value in self.names.items():
            line = line.replace(f"@{name}", value)
        found = LINE.fullmatch(line)
        assert found is not None, line
        headers, body = {}, None
        if found["who"]:
            headers["Authorization"] = f"Bearer {self.tokens.get(found['who'], 'starcat_wrong')}"
        if found["header"]:
            headers[found["header"]] = found["value"]
        if found["kind"]:
            headers["Content-Type"] = TYPES.get(found["kind"], f"application/{found['kind']}")
            body = found["body"].encode()
            body = b"#" * int(body[1:]) if body.startswith(b"*") else body
        if found["kind"] == "multipart":
            body = multipart(found["body"], Path("frames/1.png"))
        for _ in range(60):
            answer = self.served.raw(found["method"], found["target"], headers, body, 120)
            if answer.status != 503:
                break
            time.sleep(1)
        self.keep(found["name"], f"{found['method']} {found['target']}", answer)
        return answer

    def keep(self, name: str, request: str, answer: Answer) -> None:
        heads = {k: v for k, v in answer.headers.items() if k not in LEFT_OUT}
        shown = [f"{name}: {self.freezer.clean(value)}" for name, value in sorted(heads.items())]
        kind = heads.get("content-type", "")
        if re.search(r"json|text|xml|svg|toml|^$", kind) and "parquet" not in kind:
            body = self.freezer.shown(answer.text)
        else:
            body = f"{len(answer.body)} bytes, sha256 {sha256(answer.body)}"
        text = "\n".join([self.freezer.clean(request), str(answer.status), *shown, "", body])
        self.freezer.write(f"service/{name}.txt", text)


def multipart(field: str, path: Path) -> bytes:
    """Return a form with a field and a file."""
    name, _, value = field.partition("=")
    head = 'Content-Disposition: form-data; name="{}"'
    file = f'{head.format("file")}; filename="{path.name}"\r\nContent-Type: image/png'
    start = f"--freeze\r\n{head.format(name)}\r\n\r\n{value}\r\n--freeze\r\n{file}\r\n\r\n"
    return start.encode() + path.read_bytes() + b"\r\n--freeze--\r\n"


def freeze_service(freezer: Freezer) -> None:
    """Run a server, let it build, and write what it answers."""
    tokens = {}
    for role in ("reader", "builder", "publisher"):
        done = freezer.run(f"token create {role} --role {role} --root served --json")
        tokens[role] = json.loads(done.stdout)["token"]
    with serve(Path("served"), Path("log"), upload_mib=1.0) as served:
        asker = Asker(freezer, served, tokens)
        do_jobs(asker)
        asker.names["frame"] = json.dumps(frame_of(Path("frames/1.csv")))
        for target in GETS.split():
            name = re.sub(r"\W+", "-", target).strip("-") or "home"
            asker.ask(f"get-{name[:90]} GET {target}")
        ask_in_formats(asker)
        do_tap_jobs(asker)
        for line in REQUESTS.strip().splitlines():
            asker.ask(line)
        there = f"--server {served.address} --token {tokens['builder']}"
        registry = f"--registry {served.address}/registry"
        for name in ("mine", "nothing"):
            freezer.tell(f"service/cli-sql-{name}", f'{there} sql {name}-1.0.0 "{NORTH}"')
            line = f"{there} identify {name}-1.0.0 frames/1.csv"
            freezer.tell(f"service/cli-identify-{name}", line)
            freezer.tell(f"service/cli-pull-{name}", f"pull {name} {registry} -o got")
        freezer.tell("service/cli-build", f"{there} build {BUILT['mine']} -o brought")
        freezer.tell("service/cli-releases", f"releases {served.address}/registry")
        figures = served.raw("GET", "/metrics").text
        freezer.write("service/metrics.txt", "\n".join(re.findall("(?m)^# .*", figures)))
        for path in sorted(set(re.findall(r"/static/[^\"]+", served.raw("GET", "/").text))):
            asker.keep(f"static-{Path(path).name}", path, served.raw("GET", path))
        for _ in range(13):
            asker.ask("token-guessed GET /api/v1/databases as nobody")


def do_jobs(asker: Asker) -> None:
    """Have two databases built, rates measured and a catalog read; write what is told of it."""
    jobs: dict[str, dict[str, Any]] = {}
    for name in ("later", "mine"):
        changes = dict(word.split("=", 1) for word in shlex.split(BUILT[name])[3::2])
        jobs[name] = {"kind": "build", "preset": "gaia-12deg", "changes": changes}
    jobs["rates"] = {"kind": "evaluate", "database": "@mine", "frames": 20}
    jobs["sao"] = {"kind": "ingest", "source": "sao"}
    for name, wish in jobs.items():
        sent = asker.ask(f"job-{name}-sent POST /api/v1/jobs json {json.dumps(wish)} as builder")
        asker.names["job"] = json.loads(sent.text)["id"]
        address = f"/api/v1/jobs/{asker.names['job']}"
        asker.served.raw("GET", f"{address}/events", timeout_s=300)  # it ends with the job
        for part in ("", "/events.json", "/log"):
            answer = asker.served.raw("GET", address + part)
            # How far a stage had come when it was last looked at is chance.
            text = re.sub(r"[\d,]+ of [\d,]+(?=\n)", "<n> of <n>", answer.text)
            text = re.sub(r'"(done|total|number)":\d+', r'"\1":"<n>"', text)
            told = Answer(answer.status, answer.headers, text.encode())
            asker.keep(f"job-{name}{part.replace('/', '-')}", address + part, told)
        if wish["kind"] == "build":
            found = json.loads(asker.served.raw("GET", address).text)
            asker.names |= {name: found["result"]["database"], "wish": json.dumps(wish)}


def ask_in_formats(asker: Asker) -> None:
    """Ask one query of TAP, and one in SQL, in all formats."""
    for form in ("votable", "votable/td", "fits", "csv", "tsv", "json", "parquet", "pdf"):
        query = urlencode({"LANG": "ADQL", "QUERY": BRIGHT, "RESPONSEFORMAT": form})
        asker.ask(f"tap-sync-{form.replace('/', '-')} GET /tap/sync?{query}")
    for form in ("rows", *FORMATS, "pdf"):
        wish = {"targets": [asker.names["mine"]], "query": NORTH, "format": form}
        asker.ask(f"sql-format-{form} POST /api/v1/sql json {json.dumps(wish)}")


def do_tap_jobs(asker: Asker) -> None:
    """Let a job of TAP live and die, and another fail."""
    for name, query in (("right", BRIGHT), ("wrong", "SELECT nothing FROM mine_1_0_0.stars")):
        form = urlencode({"LANG": "ADQL", "QUERY": query, "RESPONSEFORMAT": "csv"})
        made = asker.ask(f"async-{name}-made POST /tap/async form {form}")
        job = re.sub(r"^https?://[^/]+", "", made.headers["location"])
        asker.freezer.known[job.rpartition("/")[2]] = "<job>"
        asker.ask(f"async-{name}-pending GET {job}")
        asker.ask(f"async-{name}-duration POST {job}/executionduration form EXECUTIONDURATION=60")
        asker.ask(f"async-{name}-run POST {job}/phase form PHASE=RUN")
        while asker.served.raw("GET", f"{job}/phase").text in ("PENDING", "QUEUED", "EXECUTING"):
            time.sleep(0.2)
        for part in ("", *UWS):
            asker.ask(f"async-{name}-job{part.replace('/', '-')} GET {job}{part}")
        asker.ask(f"async-{name}-again POST {job}/phase form PHASE=RUN")
    asker.ask("async-list GET /tap/async")
    asker.ask(f"async-gone DELETE {job}")
    asker.ask(f"async-gone-again DELETE {job}")


SECTIONS = {
    "help": freeze_help,
    "builds": freeze_builds,
    "python": freeze_python,
    "errors": freeze_errors,
    "commands": freeze_commands,
    "service": freeze_service,
}


def main() -> None:
    """Freeze all sections, or those that are named."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path, help="folder to write into; must not exist")
    parser.add_argument("--only", action="append", choices=SECTIONS, help="section; repeatable")
    given = parser.parse_args()
    out = given.folder.resolve()
    out.mkdir(parents=True)
    default = Path(__file__).resolve().parents[3] / "shared" / "catalogs"
    catalogs = Path(os.environ.get("STARCAT_CATALOGS", default)).resolve()
    with tempfile.TemporaryDirectory(prefix="freeze-") as work:
        os.environ.pop("STARCAT_TOKEN", None)
        os.environ |= {
            "COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb", "TZ": "UTC",
            "STARCAT_CATALOGS": str(catalogs), "STARCAT_CACHE": f"{work}/cache",
        }  # fmt: skip
        os.chdir(work)
        freezer = Freezer(out, Path(work), catalogs)
        freezer.prepare()
        for name in given.only or SECTIONS:
            began = time.monotonic()
            SECTIONS[name](freezer)
            print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)
        os.chdir(out)


if __name__ == "__main__":
    main()
