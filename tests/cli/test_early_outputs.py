"""Outputs that cannot be written are reported before any work: no option waits for its end."""

import pytest

COMMANDS = {
    "identify": ["identify", "DATABASE", "photo.png"],
    "calibrate": ["calibrate", "DATABASE", "frame.csv", "-o", "camera.toml"],
    "plan": ["plan", "DATABASE", "10,20,30"],
}
OPTIONS = [
    ("identify", "--picture", ".png"),
    ("identify", "--contact-sheet", ".png"),
    ("identify", "--wcs", ".fits"),
    ("calibrate", "--plot", ".svg"),
    ("plan", "--plot", ".png"),
]


@pytest.fixture
def command(starcat, small_database, tmp_path, monkeypatch):
    """Run a command that fails if it opens the database."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frame.csv").write_text("x_px,y_px\n1,1\n")
    (tmp_path / "photo.png").write_bytes(b"")
    for name in (
        "starcat.matcher.matcher.open_database",
        "starcat.frames.planning.plan.open_database",
    ):
        monkeypatch.setattr(name, lambda *_, **__: pytest.fail("the work began"))

    def run(name, *options):
        words = [small_database if word == "DATABASE" else word for word in COMMANDS[name]]
        return starcat([*words, *options])

    return run


@pytest.mark.parametrize(("name", "option", "suffix"), OPTIONS)
def test_a_folder_that_does_not_exist(command, name, option, suffix):
    run = command(name, option, f"none/out{suffix}")
    assert run.code == 1
    assert f"{option} none/out{suffix}: none is not a folder" in run.err


@pytest.mark.parametrize(("name", "option", "suffix"), OPTIONS)
def test_a_folder_in_place_of_a_file(command, tmp_path, name, option, suffix):
    (tmp_path / f"out{suffix}").mkdir()
    run = command(name, option, f"out{suffix}")
    assert run.code == 1
    assert f"{option} out{suffix}: is a folder" in run.err


@pytest.mark.parametrize(
    ("name", "option", "file", "words"),
    [
        ("identify", "--picture", "out.pdf", "a picture is one of .png, .svg"),
        ("identify", "--contact-sheet", "out.svg", "a contact sheet is a .png file"),
        ("identify", "--wcs", "out.png", "expected a FITS file, whose name ends with .fits"),
        ("calibrate", "--plot", "out.pdf", "a plot is one of .png, .svg"),
        ("plan", "--plot", "out.pdf", "a plot is one of .png, .svg"),
    ],
)
def test_a_kind_of_file_that_is_not_written(command, name, option, file, words):
    run = command(name, option, file)
    assert run.code == 2
    assert words in run.err
