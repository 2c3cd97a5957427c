"""Builds that are killed while they replace a database, and builds on a full disk.

A database is under the final name after a kill at any file-system event. The processes are real
and die by SIGKILL; one interpreter that has everything imported forks them. The report, which
takes most of the time of a small build, is left out.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(
    sys.platform != "linux", reason="names are exchanged, and file systems mounted, on Linux only"
)

BUILDS = """
import os, shutil, signal, sys
from pathlib import Path

import starcat.pipeline.finish
from starcat.database.verify import verify
from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import spec_from_dict

output, stars = Path(sys.argv[1]), Path(sys.argv[2])
final = output / "small-1.0.0"
starcat.pipeline.finish.write_report = lambda *_: None

def build_small(faint_limit_mag, replace):
    spec = spec_from_dict({
        "name": "small", "version": "1.0.0", "epoch_jyear": 2026.0,
        "catalog": {"source": "sao"}, "selection": {"faint_limit_mag": faint_limit_mag},
        "camera": {"width_px": 512, "height_px": 512, "fov_x_deg": 40.0},
        "boresights": {"count": 80}, "self_test": {"frames": 1, "min_identified": 0.0},
        "products": {name: {"enabled": False} for name in
            ("grid", "radial", "hausdorff_angular", "hausdorff_l2", "neighbours")},
    }, "spec")
    build(spec, output, inputs={"sao": [stars]}, replace=replace)

def child(last):
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    code, steps = 1, 0
    def hook(event, _):
        nonlocal steps
        if event.partition(".")[0] in ("open", "os", "shutil", "fcntl", "ctypes"):
            steps += 1
            if steps == last and event != "os.kill":
                os.kill(os.getpid(), signal.SIGKILL)
    sys.addaudithook(hook)
    try:
        build_small(6.0, replace=True)
        count = steps
        (output.parent / "steps").write_text(str(count))
        code = 0
    finally:
        os._exit(code)

build_small(5.5, replace=False)
shutil.copytree(output, output.parent / "before")

def reset():
    shutil.rmtree(output)
    shutil.copytree(output.parent / "before", output)

assert child(0) == 0
total = int((output.parent / "steps").read_text())
for step in range(1, total + 1):
    reset()
    assert child(step) == -signal.SIGKILL, step
    assert not verify(final).findings, step
    if step % 8 and step < total - 8:
        continue
    build_small(6.0, replace=True)
    assert not verify(final).findings, step
    left = {path.name for path in output.iterdir()}
    assert left == {"small-1.0.0", "small-1.0.0.build.json"}, (step, left)
print(total)
"""


def run_script(script: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", script, *map(str, arguments)]
    return subprocess.run(words, capture_output=True, text=True, check=False)


@pytest.mark.timeout(600)
@pytest.mark.slow
def test_a_kill_at_any_event_leaves_a_database(tmp_path, sao_file):
    ran = run_script(BUILDS, tmp_path / "dist", sao_file)
    assert ran.returncode == 0, ran.stderr[-2000:]
    assert int(ran.stdout) > 100


# A full disk ----------------------------------------------------------------------------------


FULL = """
import resource, signal, sys
from pathlib import Path

from starcat.errors import OutputError
from starcat.pipeline.build import build
from starcat.pipeline.specs.reading import read_spec

spec, stars, output, limit_bytes = sys.argv[1:]
if int(limit_bytes):
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(limit_bytes), resource.RLIM_INFINITY))
for _ in range(2):
    try:
        build(read_spec(spec), Path(output) / "dist", inputs={"sao": stars})
    except OutputError as error:
        print(error)
    assert not list(Path(output).iterdir())
"""


def check_failed_builds(ran: subprocess.CompletedProcess[str], folder: Path, words: str) -> None:
    line = f"{folder / 'dist'}: writing failed ({words}); nothing was left there\n"
    assert (ran.returncode, ran.stdout, ran.stderr) == (0, 2 * line, "")


@pytest.mark.parametrize("limit_bytes", [100_000, 700_000])
def test_builds_that_cannot_write_are_refused_and_the_process_goes_on(
    tmp_path, sao_file, small_spec, limit_bytes
):
    (tmp_path / "spec.toml").write_text(small_spec)
    folder = tmp_path / "out"
    folder.mkdir()
    ran = run_script(FULL, tmp_path / "spec.toml", sao_file, folder, limit_bytes)
    check_failed_builds(ran, folder, "File too large")


@pytest.mark.slow
@pytest.mark.parametrize("size", ["64k", "300k", "700k", "1m", "1100k", "3m"])
def test_builds_on_a_full_disk_are_refused_and_the_process_goes_on(
    tmp_path, sao_file, small_spec, size
):
    (tmp_path / "spec.toml").write_text(small_spec)
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("only an administrator can mount a file system")
    try:
        ran = run_script(FULL, tmp_path / "spec.toml", sao_file, folder, 0)
        check_failed_builds(ran, folder, "No space left on device")
    finally:
        subprocess.run(["umount", str(folder)], check=True)
