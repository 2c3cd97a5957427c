"""Write reproduction.md, a file of a release, from a full evaluation of the papers."""

from __future__ import annotations

from pathlib import Path

from starcat_lab.report.files import RESULTS, write_reproduction

ROOT = Path(__file__).resolve().parents[1]

if __name__ == "__main__":
    page = write_reproduction(
        ROOT / "dist" / "evaluation" / "all" / RESULTS, ROOT / "dist" / "reports"
    )
    print(f"wrote {page.relative_to(ROOT)}")
