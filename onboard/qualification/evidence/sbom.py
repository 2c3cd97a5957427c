# SPDX-License-Identifier: MIT
"""Write the software bill of materials of this folder: SPDX 2.3, JSON.

    sbom.py FILE

The same files give the same bytes. The time of creation is SOURCE_DATE_EPOCH, or else the time of
the commit, or else 1970.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

ONBOARD = Path(__file__).resolve().parents[2]
NOT_OURS = {"build", "target", "__pycache__"}


def git(*words: str) -> str:
    """Return what git says; nothing where the folder is in no repository."""
    try:
        done = subprocess.run(
            ["git", "-C", str(ONBOARD), *words], capture_output=True, text=True, check=False
        )
    except FileNotFoundError:
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def epoch() -> int:
    """Return the time of creation that the document states, seconds."""
    return int(os.environ.get("SOURCE_DATE_EPOCH") or git("log", "-1", "--format=%ct") or 0)


def version() -> str:
    header = (ONBOARD / "include" / "starcat.h").read_text(encoding="utf-8")
    found = re.search(r'STARCAT_VERSION "(.*)"', header)
    assert found is not None
    return found[1]


def package(name: str, **more: object) -> dict[str, object]:
    return {
        "SPDXID": f"SPDXRef-{name}",
        "name": name,
        "downloadLocation": "NOASSERTION",
        "licenseDeclared": "NOASSERTION",
        "licenseConcluded": "NOASSERTION",
        "copyrightText": "NOASSERTION",
    } | more


def describe() -> dict[str, object]:
    """Return the document."""
    paths = [path for path in ONBOARD.rglob("*") if path.is_file() and not path.is_symlink()]
    names = {path.relative_to(ONBOARD).as_posix(): path for path in paths}
    files, sha1s = [], []
    for name in sorted(names):
        if any(part in NOT_OURS or part.startswith("build-") for part in name.split("/")):
            continue
        data = names[name].read_bytes()
        sha1s.append(hashlib.sha1(data).hexdigest())
        sums = [("SHA1", sha1s[-1]), ("SHA256", hashlib.sha256(data).hexdigest())]
        files.append(
            {
                "SPDXID": f"SPDXRef-File-{re.sub('[^A-Za-z0-9.-]', '-', name)}-{len(files)}",
                "fileName": f"./{name}",
                "checksums": [{"algorithm": a, "checksumValue": v} for a, v in sums],
                "licenseConcluded": "MIT",
                "copyrightText": "NOASSERTION",
            }
        )
    code = hashlib.sha1("".join(sorted(sha1s)).encode()).hexdigest()
    own = package(
        "starcat-onboard",
        versionInfo=version(),
        licenseDeclared="MIT",
        licenseConcluded="MIT",
        filesAnalyzed=True,
        packageVerificationCode={"packageVerificationCodeValue": code},
        hasFiles=[file["SPDXID"] for file in files],
    )
    libm = package(
        "libm", filesAnalyzed=False, comment="sqrt, sin, cos, atan2 and log, or what replaces them"
    )
    relations = [
        ("SPDXRef-DOCUMENT", "DESCRIBES", own["SPDXID"]),
        (own["SPDXID"], "DEPENDS_ON", libm["SPDXID"]),
        *((own["SPDXID"], "CONTAINS", file["SPDXID"]) for file in files),
    ]
    return {
        "spdxVersion": "SPDX-2.3",
        "dataLicense": "CC0-1.0",
        "SPDXID": "SPDXRef-DOCUMENT",
        "name": f"starcat-onboard-{version()}",
        "documentNamespace": f"https://spdx.org/spdxdocs/starcat-onboard-{version()}-{code}",
        "creationInfo": {
            "created": datetime.fromtimestamp(epoch(), UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
            "creators": ["Tool: starcat-onboard-sbom.py"],
        },
        "packages": [own, libm],
        "files": files,
        "relationships": [
            {"spdxElementId": a, "relationshipType": kind, "relatedSpdxElement": b}
            for a, kind, b in relations
        ],
    }


if __name__ == "__main__":
    document = describe()
    Path(sys.argv[1]).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    print(f"sbom: SPDX 2.3, {len(document['files'])} files, MIT")
