"""How many photographs are identified, unchanged and damaged, by scale and by a range.

The photographs are in the folder ``spel`` of $STARCAT_NIGHTS. Damaged copies of each:
strong JPEG compression; the same after a glow was added, which becomes stairs of blocks; a
textured foreground below a horizon (foliage); and coarse grain. The scale comes from the database
(48.8 deg, off by 5 % at most), the range is 30 to 60 deg. An answer is right if its attitude is
within half a degree of the attitude of the unchanged photograph.

It fails if an answer is wrong, or if an unchanged photograph is not identified.

Run: python benchmarks/photographs.py [--count 20]
"""

from __future__ import annotations

import os
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from rows import LackingError, Options, Rows, ended
from scipy.ndimage import gaussian_filter

from starcat.frames.images.solve_files import answer_file
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions
from starcat.matcher.result import MatchResult
from starcat.pipeline.build import build
from starcat.pipeline.specs.build_spec import CameraSpec
from starcat.pipeline.starter import starter_spec

SIDE_PX, FOV_DEG, RANGE_DEG = 1024, 48.8, (30.0, 60.0)
RIGHT_DEG = 0.5

Grey = NDArray[np.float64]


def glow(grey: Grey, rng: np.random.Generator) -> Grey:
    y, x = np.mgrid[:SIDE_PX, :SIDE_PX]
    left, top = rng.uniform(0.0, SIDE_PX, 2)
    return grey + 40.0 * np.exp(-((x - left) ** 2 + (y - top) ** 2) / (2.0 * 400.0**2))


def foliage(grey: Grey, rng: np.random.Generator) -> Grey:
    texture = gaussian_filter(rng.normal(size=grey.shape), 2.5)
    horizon = 650.0 + 1200.0 * gaussian_filter(rng.normal(size=SIDE_PX), 40.0)
    leaves = np.abs(texture) / texture.std() * rng.choice([4.0, 8.0, 16.0])
    return np.where(np.arange(SIDE_PX)[:, None] > horizon, leaves, grey)


def grain(grey: Grey, rng: np.random.Generator) -> Grey:
    grains = gaussian_filter(rng.normal(size=grey.shape) ** 3, 1.0)
    return grey + 20.0 + rng.choice([2.0, 3.0, 4.0]) * grains / grains.std()


# The damage to a photograph, and the quality of the JPEG file that it is written to, if any.
DAMAGE: dict[str, tuple[Callable[[Grey, np.random.Generator], Grey], int | None]] = {
    "JPEG 15": (lambda grey, _: grey, 15),
    "glow, JPEG 20": (glow, 20),
    "foliage": (foliage, None),
    "grain": (grain, None),
}


def opened(name: str, folder: Path, widest_deg: float | None = None) -> Matcher:
    narrowest = FOV_DEG if widest_deg is None else RANGE_DEG[0]
    camera = CameraSpec(width_px=SIDE_PX, height_px=SIDE_PX, fov_x_deg=narrowest)
    spec = starter_spec(name, camera, widest_fov_x_deg=widest_deg).spec
    short = spec.self_test.model_copy(update={"frames": 5})
    spec = spec.model_copy(update={"self_test": short})
    return Matcher.open(build(spec, folder).folder)


def is_right(result: MatchResult, truth: MatchResult) -> bool:
    half = min(1.0, abs(float(result.q_body_from_icrs @ truth.q_body_from_icrs)))
    return bool(np.degrees(2.0 * np.arccos(half)) < RIGHT_DEG)


def words_of(path: Path, matcher: Matcher, options: IdentifyOptions, truth: MatchResult) -> str:
    [answer] = answer_file(path, matcher, options)
    if not answer.result.ok:
        return "none"
    if not is_right(answer.result, truth):
        return "wrong"
    return f"attempt {answer.attempt.number}" if answer.attempt else "attempt 1"


def row(name: str, ways: list[Counter[str]], rows: Rows) -> str:
    cells = []
    for counts in ways:
        right = sum(count for word, count in counts.items() if word.startswith("attempt"))
        before = counts["attempt 1"] + counts["attempt 2"]
        rows.expect(not counts["wrong"], f"{name}: {counts['wrong']} wrong")
        cells.append(f"{before} | {right} of {sum(counts.values())}")
    return f"| {name} | {' | '.join(cells)} |"


def main(rows: Rows) -> None:
    options = Options(__doc__)
    options.size("--count", 20, 1, "damaged photographs of each kind")
    count, folder = options.asked().count, Path(os.environ.get("STARCAT_NIGHTS", "")) / "spel"
    paths = sorted(folder.glob("*.jpg"), key=lambda path: int(path.stem.removeprefix("img_")))
    if "STARCAT_NIGHTS" not in os.environ or not paths:
        raise LackingError("photographs in the folder $STARCAT_NIGHTS")
    with tempfile.TemporaryDirectory() as scratch:
        ways = [
            (opened("scale", Path(scratch)), IdentifyOptions()),
            (opened("range", Path(scratch), RANGE_DEG[1]), IdentifyOptions(fov_deg=RANGE_DEG)),
        ]
        print("| pictures | scale: attempts 1, 2 | all attempts | range: 1, 2 | all |")
        print("|---|---|---|---|---|")
        truths = [next(iter(answer_file(path, ways[0][0]))).result for path in paths]
        rows.expect(all(one.ok for one in truths), "a photograph as it is has no answer")
        counts = [
            Counter(words_of(path, *way, truth) for path, truth in zip(paths, truths, strict=True))
            for way in ways
        ]
        rows.expect(not any(one["none"] for one in counts), "a photograph as it is has no answer")
        print(row("photographs", counts, rows), flush=True)
        for name, (damaged, quality) in DAMAGE.items():
            counts = [Counter(), Counter()]
            for number, path in enumerate(paths[:count]):
                rng = np.random.default_rng([41, number])
                grey = np.asarray(Image.open(path).convert("L"), dtype=np.float64)
                image = np.clip(np.rint(damaged(grey, rng)), 0, 255).astype(np.uint8)
                written = Path(scratch) / ("damaged.png" if quality is None else "damaged.jpg")
                Image.fromarray(image).save(written, **({"quality": quality} if quality else {}))
                for way, found in zip(ways, counts, strict=True):
                    found[words_of(written, *way, truths[number])] += 1
            print(row(name, counts, rows), flush=True)


if __name__ == "__main__":
    ended(main)
