"""How often rendered pictures of bad nights are identified with the default settings.

Pictures of 1024 x 1024 px over 12 deg, of all stars to G = 10 (streaks and meshes: to 9), with the
database of the preset gaia-12deg: haze, moonlight, a mesh before the lens, faint stars among hot
pixels, and streaks of a camera that turns about a random axis while the shutter is open.

It fails if an answer is wrong, or if no picture is identified.

Run: python benchmarks/pictures.py [--count 30]
"""

from __future__ import annotations

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "builders"))

from hard_pictures import NIGHT_KINDS, Taken, streaked, take, take_picture, verdict, worst_px
from rows import Options, Rows, database, ended

from starcat.errors import ConfigError
from starcat.frames.images.solve_files import answer_file
from starcat.geometry.attitude import matrix_from_quaternion
from starcat.matcher.matcher import Matcher

RATES_DEG_S = (0.1, 0.3, 1.0, 3.0)
EXPOSURES_S = (0.05, 0.2, 1.0)


def said(matcher: Matcher, taken: Taken) -> str:
    try:
        return verdict(matcher, taken)
    except ConfigError as error:
        return f"refused: {str(error)[:40]}"
    finally:
        taken.path.unlink()


def row(rows: Rows, name: str, words: list[str]) -> str:
    counts = Counter(words)
    rows.expect(not counts["wrong"], f"{name}: {counts['wrong']} wrong of {len(words)}")
    others = sum(counts.values()) - counts["right"] - counts["wrong"]
    return f"{counts['right']} of {len(words)} | {counts['wrong']} | {others}"


def streaks(
    rows: Rows, matcher: Matcher, folder: Path, count: int, rates: tuple[float, ...]
) -> Iterator[str]:
    camera = matcher.database.camera
    for rate in rates:
        for exposure in EXPOSURES_S:
            words, off_arcsec = [], []
            for number in range(count):
                rng = np.random.default_rng([2027, number, int(100 * rate), int(100 * exposure)])
                picture = streaked(rng, rate, exposure)
                taken = take_picture(picture, "streak", number, rng, camera, folder)
                [answer] = answer_file(taken.path, matcher)
                taken.path.unlink()
                if not answer.result.ok:
                    words.append(answer.result.status)
                    continue
                q = answer.result.q_body_from_icrs
                words.append("right" if worst_px(taken, q, camera) < 3.0 else "wrong")
                across = (matrix_from_quaternion(q) @ taken.matrix.T)[2, :2]
                off_arcsec.append(np.degrees(np.hypot(*across)) * 3600.0)
            length = rate * exposure * camera.focal_length_px * np.pi / 180.0
            error = f"{np.median(off_arcsec):.1f}" if off_arcsec else ""
            counts = row(rows, f"{rate:g} deg/s, {exposure:g} s", words)
            yield f"| {rate:g} | {exposure:g} | {length:.0f} | {counts} | {error} |"


def main(rows: Rows) -> None:
    options = Options(__doc__)
    options.size("--count", 30, 1, "pictures of each kind")
    given = options.asked()
    count, answered = given.count, 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        matcher = Matcher.open(database("gaia-12deg", folder / "dist").folder)
        print("| pictures | right | wrong | no answer |\n|---|---|---|---|")
        for kind in NIGHT_KINDS:
            taken = (take(kind, number, matcher.database.camera, folder) for number in range(count))
            words = [said(matcher, one) for one in taken]
            answered += words.count("right")
            print(f"| {kind} | {row(rows, kind, words)} |", flush=True)
        rows.expect(answered > 0, "no picture of a hard night is identified")
        print(
            "\n| rate deg/s | exposure s | streak px | right | wrong | no answer | error arcsec |"
        )
        print("|---|---|---|---|---|---|---|")
        rates = RATES_DEG_S[:1] if given.quick else RATES_DEG_S
        for line in streaks(rows, matcher, folder, max(1, count // 3), rates):
            print(line, flush=True)


if __name__ == "__main__":
    ended(main)
