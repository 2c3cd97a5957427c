"""Databases for a camera that is known only from a few photographs, and how well they identify.

1, 3 and 5 photographs of a folder are drawn at a time. The spec that `starcat init --from` makes of
them is built, and identifies the remaining photographs with default settings. A draw is good if at
least nine tenths of the remaining photographs are identified. An answer is right if its attitude
is within half a degree of the attitude that a database for the stated field finds.

It fails if an answer is wrong, or if fewer than 17, 20 and 20 of 20 draws are good.

Run: python benchmarks/first_camera.py [FOLDER] [--draws 20] (default: $STARCAT_NIGHTS/spel)
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import numpy as np
from photographs import is_right
from rows import LackingError, Options, Rows, ended

from starcat.cli.specs import starter_of_photos
from starcat.frames.images.measure import LocalInputs, measure_file
from starcat.frames.images.solve_files import FileAnswers
from starcat.matcher.matcher import Matcher
from starcat.matcher.options import IdentifyOptions
from starcat.matcher.result import MatchResult
from starcat.pipeline.build import build
from starcat.pipeline.specs.build_spec import BuildSpec, CameraSpec
from starcat.pipeline.starter import starter_spec
from starcat.progress import no_progress

FOV_DEG = 48.8
NEEDED = {1: 0.85, 3: 1.0, 5: 1.0}
MIN_FRACTION = 0.9


def opened(spec: BuildSpec, folder: Path) -> Matcher:
    short = spec.self_test.model_copy(update={"frames": 5})
    spec = spec.model_copy(update={"self_test": short})
    return Matcher.open(build(spec, folder).folder)


def main(rows: Rows) -> None:
    options = Options(__doc__)
    options.add_argument("folder", nargs="?", type=Path, help="photographs of one camera")
    options.size("--draws", 20, 1, "draws of each number of photographs")
    asked = options.asked()
    folder = asked.folder or Path(os.environ.get("STARCAT_NIGHTS", "")) / "spel"
    if asked.folder is None and "STARCAT_NIGHTS" not in os.environ:
        raise LackingError("photographs: a folder, or $STARCAT_NIGHTS")
    paths = sorted(folder.glob("*.jpg"))
    if not paths:
        raise LackingError(f"photographs in {folder}")
    measured = [measure_file(path) for path in paths]

    def answers(matcher: Matcher) -> list[MatchResult]:
        given = matcher.database.camera, IdentifyOptions(), LocalInputs()
        return [
            next(iter(FileAnswers(path, matcher, one, *given))).result
            for path, one in zip(paths, measured, strict=True)
        ]

    height, width = measured[0].shape or (0, 0)
    camera = CameraSpec(width_px=width, height_px=height, fov_x_deg=FOV_DEG)
    with tempfile.TemporaryDirectory() as scratch:
        truths = answers(opened(starter_spec("truth", camera).spec, Path(scratch)))
        print("| photographs | good draws | fewest identified of the others | wrong | field, deg | "
              "seconds of init, build |")  # fmt: skip
        print("|---|---|---|---|---|---|")
        generator = np.random.default_rng(38)
        for count, needed in NEEDED.items():
            good, fewest, wrong, fields, times = 0, 1.0, 0, [], []
            for draw in range(asked.draws):
                chosen = set(generator.choice(len(paths), count, replace=False).tolist())
                begin_s = time.process_time()
                some = [str(paths[row]) for row in sorted(chosen)]
                starter, _ = starter_of_photos(
                    some, f"n{count}-{draw}", None, None, None, no_progress
                )
                init_s = time.process_time() - begin_s
                matcher = opened(starter.spec, Path(scratch))
                times.append((init_s, time.process_time() - begin_s - init_s))
                fields.append(matcher.database.camera.fov_x_deg)
                others = [
                    (found, truth)
                    for row, (found, truth) in enumerate(zip(answers(matcher), truths, strict=True))
                    if row not in chosen
                ]
                identified = sum(found.ok for found, _ in others)
                wrong += sum(
                    found.ok and truth.ok and not is_right(found, truth) for found, truth in others
                )
                good += identified >= MIN_FRACTION * len(paths)
                fewest = min(fewest, identified / len(others))
            middle, longest = np.median(times, axis=0), np.max(times, axis=0)
            print(f"| {count} | {good} of {asked.draws} | {fewest:.0%} | {wrong} | "
                  f"{min(fields):.2f} to {max(fields):.2f} | {middle[0]:.1f}, {middle[1]:.1f} "
                  f"(at most {longest[0]:.1f}, {longest[1]:.1f}) |", flush=True)  # fmt: skip
            rows.expect(not wrong, f"{count}: {wrong} answers are wrong")
            if not asked.quick:
                rows.expect(good >= needed * asked.draws, f"{count}: {good} good draws")


if __name__ == "__main__":
    ended(main)
