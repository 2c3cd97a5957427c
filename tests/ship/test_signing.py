"""Signed registries: signed files, checks, and attacks, each refused with a message."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from registry_files import change_byte, edit_index, replace_by_link, serving, write
from signed_registry import CHIEFS, CLOCK, Forger, key_of, make, publics, signing

from starcat.errors import ConfigError, ProductError, StarcatError
from starcat.ship.releases import lockfile, metadata
from starcat.ship.releases.lockfile import pull_pinned
from starcat.ship.releases.publishing import publish
from starcat.ship.releases.registry import remembered
from starcat.ship.releases.signing import change_roles, renew, renew_if_old, roles_of
from starcat.ship.releases.tree import INDEX_NAME, MAX_INDEX_BYTES
from starcat.storage.download import DownloadOptions
from starcat.storage.keys import public_pem

ONCE = DownloadOptions(retries=0, timeout_s=5.0, backoff_s=0.0)
LONG_AGO = datetime(2020, 1, 1, tzinfo=UTC)


class Made(NamedTuple):
    registry: Path
    earlier: Path


@pytest.fixture(scope="module")
def made(
    tmp_path_factory: pytest.TempPathFactory,
    database_version: Callable[[str], Path],
    small_database: Path,
) -> Made:
    return Made(*make(tmp_path_factory.mktemp("signed"), database_version, small_database))


def linked(source: str | Path, target: str | Path) -> Path:
    """Copy a folder fast; who changes a file of it removes it first."""
    return Path(shutil.copytree(source, target, copy_function=os.link))


@pytest.fixture
def registry(made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The signed registry, its first root, and the public keys of its chief and another."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name in ("chief", "mallory"):
        Path(f"{name}.pub").write_bytes(public_pem(key_of(name).public_key()))
    shutil.copy(made.registry / "metadata" / "1.root.json", "root.json")
    return linked(made.registry, "registry")


@pytest.fixture(scope="module")
def seen(made: Made, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state that a user keeps of the registry after a pull."""
    folder = tmp_path_factory.mktemp("seen")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(folder / "state"))
        root = made.registry / "metadata" / "1.root.json"
        pull(str(made.registry), trust=root, output=folder / "out", lock=folder / "lock")
        (state,) = remembered(str(made.registry))
        return state


def pull(
    registry: str = "registry",
    wanted: str = "small",
    trust: Path | None = Path("root.json"),
    output: Path = Path("out"),
    lock: Path = Path("starcat.lock"),
) -> Any:
    return lockfile.pull(wanted, registry, output, lock=lock, options=ONCE, trust=trust)


def blob(registry: Path, name: str) -> Path:
    """The content of a file of the newest release."""
    index = json.loads((registry / "index.json").read_bytes())
    path = registry / "blobs/sha256"
    digest = index["releases"][-1]["manifest"]["sha256"]
    if name != "manifest.json":
        manifest = json.loads((path / digest[:2] / digest).read_bytes())
        digest = manifest["files"][name]["sha256"]
    return path / digest[:2] / digest


# Attacks -----------------------------------------------------------------------------------------
# Each attacker can write to the registry and has the keys that the attack's name states.


def fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def huge(path: Path, size: int = 1 << 30) -> None:
    write(path, b"")
    with path.open("r+b") as file:
        file.truncate(size)


Change = Callable[[Any], object]
Attack = Callable[[Path, Path], object]
"""Changes a registry, whose earlier state is in the second folder."""


def on_blob(change: Change, name: str) -> Attack:
    return lambda registry, earlier: change(blob(registry, name))


def on_file(change: Change, name: str) -> Attack:
    return lambda registry, earlier: change(registry / name)


def on_index(change: Change) -> Attack:
    return lambda registry, earlier: edit_index(registry, change)


def on_timestamp(change: Change) -> Attack:
    return lambda registry, earlier: Forger(registry).edit_json("timestamp", change)


def text(content: str | bytes) -> Callable[[Path], None]:
    return lambda path: write(path, content)


def all_of_before(registry: Path, earlier: Path) -> None:
    shutil.rmtree(registry)
    linked(earlier, registry)


def file_of_before(name: str, to: str = "") -> Attack:
    return lambda registry, earlier: write(registry / (to or name), (earlier / name).read_bytes())


def signed(role: str, *names: str, change: Change = bool, then: Change | None = None) -> Attack:
    """Sign a changed file of a role with some keys, and name it with keys that may do so.

    ``then`` changes the file and its signatures once more.
    """

    def attack(registry: Path, earlier: Path) -> None:
        forger = Forger(registry)
        forger.change(role, names, change)
        if then is not None:
            forger.edit_json(role, then)
        if role in ("targets", "snapshot"):
            forger.name_upwards(role)

    return attack


def fewer_releases(*names: str, then: Change | None = None) -> Attack:
    fewer = lambda targets: targets.targets.pop("versions/small/1.0.0.json")  # noqa: E731
    return signed("targets", *names, change=fewer, then=then)


def frozen(role: str, *names: str) -> Attack:
    """Let signatures end long ago, as in an old state that an attacker shows for ever."""
    return signed(role, *names, change=lambda one: setattr(one, "expires", LONG_AGO))


def under_two_keys(content: dict[str, Any]) -> None:
    """Put the signature of one key under the id of another, too."""
    one, other = content["signatures"]
    other["sig"] = one["sig"]


def mallorys_root(root: Any) -> None:
    from securesystemslib.signer import SSlibKey

    for role in ("root", "targets", "snapshot", "timestamp"):
        root.add_key(SSlibKey.from_crypto(key_of("mallory").public_key()), role)
        root.roles[role].threshold = 1


def all_by_mallory(registry: Path, earlier: Path) -> None:
    """Exchange the whole registry for one with other keys."""
    forger = Forger(registry)
    held = forger.read("root")
    mallorys_root(held.signed)
    write(registry / "metadata/root.json", forger.sign(held, "root", ["mallory"]))
    for role in ("targets", "snapshot", "timestamp"):
        forger.sign(forger.read(role), role, ["mallory"])


def older_named(role: str, *names: str) -> Attack:
    """Name an older file of a role in a newer file, with the keys that may."""

    def attack(registry: Path, earlier: Path) -> None:
        forger, meta = Forger(registry), Forger(earlier)._meta(role)
        if role == "targets":
            forger.change("snapshot", names, lambda one: one.meta.update({"targets.json": meta}))
            forger.name_upwards("snapshot")
        else:
            forger.change("timestamp", names, lambda one: setattr(one, "snapshot_meta", meta))

    return attack


def root_left_out(registry: Path, earlier: Path) -> None:
    """Offer the third root where the second should be."""
    for _ in range(2):
        signed("root", *CHIEFS)(registry, earlier)
    write(registry / ROOT2, (registry / "metadata/3.root.json").read_bytes())


def role_of_another(registry: Path, earlier: Path) -> None:
    """Offer the timestamp, whose key may sign no snapshot, as a snapshot."""
    forger = Forger(registry)
    write(registry / "metadata/9.snapshot.json", forger.path("timestamp").read_bytes())
    meta = forger._meta("snapshot")
    forger.change("timestamp", CLOCK, lambda one: setattr(one, "snapshot_meta", meta))


def unlisted(index: dict[str, Any]) -> None:
    index["releases"].pop()


def later(index: dict[str, Any]) -> None:
    index["releases"].append({**index["releases"][-1], "version": "9.9.9"})


def exchanged(index: dict[str, Any]) -> None:
    index["releases"][-1]["manifest"] = index["releases"][0]["manifest"]


def raised(content: dict[str, Any]) -> None:
    content["signed"]["version"] += 1


def unsigned(content: dict[str, Any]) -> None:
    content["signatures"] = []


def twice(content: dict[str, Any]) -> None:
    content["signatures"] *= 2


RELEASE, INDEX, META = "versions/small/1.0.1.json", "index.json", "metadata/"
TIMESTAMP, ROOT2 = META + "timestamp.json", META + "2.root.json"
TARGETS, SNAPSHOT = META + "3.targets.json", META + "3.snapshot.json"
NOT_SIGNED, LINKED = "is not the file that was signed", "a symbolic link; expected a file"
OLDER = "is older than the last known state of this registry"


def by(keys: int, needed: int) -> str:
    return f"is signed by {keys} of the {needed} trusted keys"


ATTACKS: dict[str, tuple[Attack, str]] = {
    # Files of a database.
    "a byte of a file": (on_blob(change_byte, "database.h5"), "its sha256 begins with"),
    "a byte of the manifest": (on_blob(change_byte, "manifest.json"), "its sha256 begins with"),
    "a longer file": (on_blob(text(b"x" * 10_000_000), "stars.parquet"), "bytes; expected"),
    "an empty file": (on_blob(text(b""), "stars.parquet"), "0 bytes; expected"),
    "a missing file": (on_blob(Path.unlink, "stars.parquet"), "missing"),
    "a link for a file": (on_blob(replace_by_link, "database.h5"), LINKED),
    "a pipe for a file": (on_blob(fifo, "manifest.json"), "not a file"),
    "a huge file": (on_blob(huge, "stars.parquet"), "1073741824 bytes; expected"),
    # The file of a release.
    "a byte of the release": (on_file(change_byte, RELEASE), f"{RELEASE} {NOT_SIGNED}"),
    "the release of an older version": (
        file_of_before("versions/small/1.0.0.json", RELEASE),
        f"{RELEASE} {NOT_SIGNED}",
    ),
    "a missing release": (on_file(Path.unlink, RELEASE), f"{RELEASE} {NOT_SIGNED}"),
    "a link for the release": (on_file(replace_by_link, RELEASE), LINKED),
    "a huge release": (on_file(huge, RELEASE), "longer than"),
    # The index, which is not signed itself.
    "an index with another content": (on_index(exchanged), "lists small-1.0.1 with another"),
    "an index without the release": (on_index(unlisted), "lists small-1.0.0 as the latest"),
    "an index of before": (file_of_before(INDEX), "lists small-1.0.0 as the latest"),
    "an index of nonsense": (on_file(text("{}"), INDEX), "not what starcat writes"),
    "no index": (on_file(Path.unlink, INDEX), "no registry"),
    "a huge index": (on_file(huge, INDEX), f"longer than {MAX_INDEX_BYTES} bytes"),
    "a link for the index": (on_file(replace_by_link, INDEX), LINKED),
    # Changes of signed files by an attacker without a key.
    "no metadata": (lambda one, _: shutil.rmtree(one / "metadata"), "is not signed"),
    "no timestamp": (on_file(Path.unlink, TIMESTAMP), "timestamp.json is missing, so the registry"),
    "no snapshot": (on_file(Path.unlink, SNAPSHOT), "3.snapshot.json is missing"),
    "no targets": (on_file(Path.unlink, TARGETS), "3.targets.json is missing"),
    "a higher version of the timestamp": (on_timestamp(raised), f"timestamp.json {by(0, 1)}"),
    "a byte of the snapshot": (on_file(change_byte, SNAPSHOT), f"3.snapshot.json {NOT_SIGNED}"),
    "a byte of the targets": (on_file(change_byte, TARGETS), f"3.targets.json {NOT_SIGNED}"),
    "a timestamp without signatures": (on_timestamp(unsigned), by(0, 1)),
    "an empty timestamp": (on_file(text(""), TIMESTAMP), "is not metadata of a registry"),
    "a timestamp of lists": (on_file(text("[" * 9000), TIMESTAMP), "is not metadata"),
    "a timestamp of bytes": (on_file(text(b"\xff\x00"), TIMESTAMP), "is not metadata"),
    "a huge timestamp": (on_file(huge, TIMESTAMP), "longer than"),
    "a huge snapshot": (on_file(huge, SNAPSHOT), "longer than"),
    "huge targets": (on_file(huge, TARGETS), "longer than"),
    "a huge root": (on_file(huge, ROOT2), "longer than"),
    "a root of nonsense": (on_file(text("{}"), ROOT2), "2.root.json is not metadata"),
    "a link for the timestamp": (on_file(replace_by_link, TIMESTAMP), LINKED),
    "a pipe for the timestamp": (on_file(fifo, TIMESTAMP), "not a file"),
    # Older and mixed states.
    "the targets of before": (
        file_of_before(META + "2.targets.json", TARGETS),
        f"3.targets.json {NOT_SIGNED}",
    ),
    "the snapshot of before": (
        file_of_before(META + "2.snapshot.json", SNAPSHOT),
        f"3.snapshot.json {NOT_SIGNED}",
    ),
    # Signatures that have ended.
    "frozen timestamp": (frozen("timestamp", "clock"), "timestamp.json have ended on 2020-01-01"),
    "frozen snapshot": (frozen("snapshot", "anna"), "snapshot.json have ended on 2020-01-01"),
    "frozen targets": (frozen("targets", "anna", "bert"), "targets.json have ended on 2020"),
    "frozen root": (frozen("root", *CHIEFS), "root.json have ended on 2020-01-01"),
    # Keys that do not count, or too few of them.
    "all with other keys": (all_by_mallory, f"timestamp.json {by(0, 1)}"),
    "a timestamp by another": (signed("timestamp", "mallory"), f"timestamp.json {by(0, 1)}"),
    "a snapshot by another": (signed("snapshot", "mallory"), f"4.snapshot.json {by(0, 1)}"),
    "targets by another": (signed("targets", "mallory"), f"4.targets.json {by(0, 2)}"),
    "targets by one of two": (fewer_releases("anna"), f"4.targets.json {by(1, 2)}"),
    "targets by one and another": (fewer_releases("anna", "mallory"), by(1, 2)),
    "targets by who may only renew": (fewer_releases("anna", "clock"), by(1, 2)),
    "one signature for two": (
        fewer_releases("anna", "bert", then=under_two_keys),
        f"4.targets.json {by(1, 2)}",
    ),
    "one signature twice": (fewer_releases("anna", then=twice), "4.targets.json is not metadata"),
    "a root by another": (signed("root", "mallory"), f"2.root.json {by(0, 2)}"),
    "a root by one of two": (signed("root", "chief"), f"2.root.json {by(1, 2)}"),
    "a root by one and another": (
        signed("root", "chief", "mallory", change=mallorys_root),
        f"2.root.json {by(1, 2)}",
    ),
    "a root by who signs releases": (signed("root", "anna", "bert"), f"2.root.json {by(0, 2)}"),
    "a root that leaves one out": (root_left_out, "2.root.json has another version"),
    "a timestamp as snapshot": (role_of_another, "is not as it was signed"),
}
"""Attacks on a registry that is pulled from for the first time, and the sentence for each."""

LATER_ATTACKS: dict[str, tuple[Attack, str]] = {
    "everything of before": (all_of_before, f"timestamp.json {OLDER}"),
    "the timestamp of before": (file_of_before(TIMESTAMP), OLDER),
    "an older snapshot, newly named": (older_named("snapshot", "clock"), f"timestamp.json {OLDER}"),
    "older targets, newly named": (older_named("targets", "anna"), f"snapshot.json {OLDER}"),
    "nothing signed any more": (
        lambda one, _: shutil.rmtree(one / "metadata"),
        "is missing, so the registry is not signed",
    ),
    "other keys for all": (all_by_mallory, f"timestamp.json {by(0, 1)}"),
}
"""Attacks on a user who has pulled before, and does not name a key again."""


def refused(sentence: str, address: str = "registry", trust: str | None = "root.json") -> None:
    with pytest.raises(StarcatError) as caught:
        pull(address, trust=None if trust is None else Path(trust))
    said = str(caught.value)
    assert sentence in said
    assert len(said) < 600
    assert not Path("out/small-1.0.1").exists()
    assert not Path("out/small-1.0.0").exists()
    assert not Path("starcat.lock").exists()


FAST = {
    *("a byte of a file", "a link for a file", "the release of an older version"),
    *("an index without the release", "no metadata", "a byte of the targets", "a huge timestamp"),
    *("the targets of before", "frozen timestamp", "all with other keys", "one signature for two"),
    *("targets by one of two", "a root by one and another"),
}
"""One of each kind; the others run with the slow tests."""


SOME = (
    *("a byte of a file", "a byte of the release", "an index without the release"),
    *("no metadata", "targets by one of two", "frozen timestamp"),
)


@pytest.mark.parametrize(
    ("name", "is_behind_an_address"),
    [pytest.param(name, False, marks=[pytest.mark.slow] * (name not in FAST)) for name in ATTACKS]
    + [pytest.param(name, True, marks=pytest.mark.slow) for name in SOME],
)
def test_an_attack_is_refused_with_its_sentence(name, is_behind_an_address, registry, made):
    attack, sentence = ATTACKS[name]
    attack(registry, made.earlier)
    with serving(registry) if is_behind_an_address else nullcontext() as server:
        refused(sentence, server.url("") if server else "registry")


@pytest.mark.parametrize("name", LATER_ATTACKS)
def test_an_attack_on_who_has_pulled_before_is_refused(name, registry, made, seen):
    shutil.copytree(seen, remembered("registry")[0], symlinks=True)
    attack, sentence = LATER_ATTACKS[name]
    attack(registry, made.earlier)
    refused(sentence, trust=None)


# Links -------------------------------------------------------------------------------------------


def exchanged_for_a_link(registry: Path) -> str:
    """The folder that the user trusted is a link to unsigned content."""
    registry.rename("aside")
    registry.symlink_to("evil")
    return "registry"


def link_above_exchanged(registry: Path) -> str:
    """A link above the folder that the user trusted leads to unsigned content."""
    Path("mount").unlink()
    Path("mount").symlink_to("other")
    return "mount/registry"


@pytest.mark.parametrize("attack", [exchanged_for_a_link, link_above_exchanged])
def test_a_link_does_not_switch_off_what_is_trusted(attack, registry, published, starcat):
    shutil.copytree(published, "evil")
    shutil.copytree(published, "other/registry")
    Path("mount").symlink_to(registry.parent)
    for name in ("registry", "mount/registry"):
        assert pull(name, output=Path("first"), lock=Path("first.lock")).signed == "checked"
    address = attack(registry)
    refused("metadata/timestamp.json is missing, so the registry is not signed", address, None)
    ran = starcat(["pull", "small@latest", "--registry", address, "-o", "out"])
    assert (ran.code, "is not signed" in ran.err) == (5, True)


def test_the_folder_that_the_shell_shows_counts(registry, published, monkeypatch):
    shutil.copytree(published, "other/registry")
    Path("mount").symlink_to(registry.parent)
    monkeypatch.setenv("PWD", f"{Path.cwd()}/mount")
    assert pull(output=Path("first"), lock=Path("first.lock")).signed == "checked"
    link_above_exchanged(registry)
    monkeypatch.chdir("mount")
    with pytest.raises(ProductError, match="is not signed"):
        pull(trust=None)


def test_a_registry_that_moved_is_checked_under_both_names(registry, published):
    assert pull().signed == "checked"
    registry.rename("new-place")
    registry.symlink_to("new-place")
    assert pull(trust=None).signed == "checked"
    assert pull("new-place", trust=None).signed == "checked"
    # The folder without links is remembered, too: the link is not needed any more.
    registry.unlink()
    shutil.move("new-place", "aside")
    shutil.copytree(published, "new-place")
    with pytest.raises(ProductError, match="is not signed"):
        pull("new-place", trust=None)


def test_trust_that_was_kept_for_the_place_of_a_link_is_used(registry, published):
    """Versions up to 1.0 kept it so."""
    assert pull().signed == "checked"
    Path("named").symlink_to("registry")
    assert pull("named", trust=None).signed == "checked"
    Path("named").unlink()
    Path("named").symlink_to(published)
    with pytest.raises(ProductError, match="is not signed"):
        pull("named", trust=None)


# An index and the signatures -------------------------------------------------------------------


def test_an_index_that_is_only_newer_gives_the_signed_version_and_a_warning(registry, starcat):
    on_index(later)(registry, registry)
    ran = starcat(["pull", "small", "--registry", "registry", "-o", "out", "--trust", "chief.pub"])
    assert ran.code == 0
    words = "index.json lists small-9.9.9, which is not signed; small-1.0.1 is the latest signed"
    assert words in ran.err
    assert "pulled: out/small-1.0.1; signed by keys that you trust" in ran.err
    (warning,) = pull(trust=None).warnings
    assert words in warning
    assert not pull(trust=None, wanted="small@1.0.1").warnings
    with pytest.raises(StarcatError, match=r"among signed releases, has no version 9\.9\.9"):
        pull(trust=None, wanted="small@9.9.9")


def empty(index: dict[str, Any]) -> None:
    index["releases"].clear()


@pytest.mark.parametrize("trust", [[], ["--trust", "chief.pub"]])
@pytest.mark.parametrize(
    ("change", "hidden"), [(empty, ["small-1.0.0", "small-1.0.1"]), (unlisted, ["small-1.0.1"])]
)
def test_verify_names_the_signed_releases_that_the_index_hides(
    change, hidden, trust, registry, starcat
):
    on_index(change)(registry, registry)
    ran = starcat(["verify", "registry", *trust, "--json"])
    assert ran.code == 5
    found = json.loads(ran.out)["findings"]
    assert [(one["file"], one["product"]) for one in found] == [("index.json", h) for h in hidden]
    assert f"the signed release {hidden[0]} is not in the index" in ran.out


def test_verify_of_a_sound_registry(registry, starcat):
    ran = starcat(["verify", "registry", "--trust", "chief.pub"])
    assert (ran.code, "registry: sound (" in ran.out) == (0, True)
    assert {path.stat().st_mode & 0o222 for path in registry.glob("blobs/sha256/*/*")} == {0}


def test_verify_uses_what_was_trusted_before(registry, made, seen, starcat):
    shutil.copytree(seen, remembered("registry")[0], symlinks=True)
    all_of_before(registry, made.earlier)
    ran = starcat(["verify", "registry", "--json"])
    assert (ran.code, OLDER in ran.out) == (5, True)


def test_verify_refuses_metadata_of_which_the_timestamp_is_gone(registry, starcat):
    (registry / TIMESTAMP).unlink()
    ran = starcat(["verify", "registry"])
    assert (ran.code, "timestamp.json: cannot be read" in ran.err) == (5, True)


def test_the_roles_of_a_registry_behind_an_address_are_those_of_its_folder(registry, tmp_path):
    with serving(registry) as server:
        assert roles_of(server.url("")) == roles_of(str(registry))
        signed("targets", "mallory")(registry, registry)
        with pytest.raises(ProductError, match="signatures do not agree"):
            roles_of(server.url(""))
    (tmp_path / "plain").mkdir()
    (tmp_path / "plain" / INDEX_NAME).write_bytes((registry / INDEX_NAME).read_bytes())
    with serving(tmp_path / "plain") as server, pytest.raises(ConfigError, match="nothing is sig"):
        roles_of(server.url(""))


def test_a_key_is_trusted_only_with_a_root_that_it_signed(registry, made):
    sentence = "metadata/1.root.json is not a root that the key"
    refused(sentence, trust="mallory.pub")
    all_by_mallory(registry, made.earlier)
    refused(sentence, trust="chief.pub")


def test_an_unsigned_pull_is_refused_to_a_user_who_trusts_a_key(published, registry):
    refused("metadata/timestamp.json is missing", str(published))
    refused("metadata/root.json is missing", str(published), "chief.pub")


# Right uses -------------------------------------------------------------------------------------


@pytest.mark.parametrize("trust", [pytest.param("root.json", marks=pytest.mark.slow), "chief.pub"])
def test_what_is_signed_is_pulled_and_remembered(trust, registry):
    one = pull(trust=Path(trust))
    assert (one.folder.name, one.signed, one.outcome) == ("small-1.0.1", "checked", "pulled")
    again = pull(trust=None)
    assert (again.signed, again.outcome) == ("checked", "unchanged")
    (locked,) = pull_pinned(None, None, Path("out"), Path("starcat.lock"), ONCE)
    assert locked.signed == "pinned"
    (locked,) = pull_pinned(
        None, None, Path("out"), Path("starcat.lock"), ONCE, trust=Path("root.json")
    )
    assert locked.signed == "checked"


def test_without_trust_a_registry_is_as_it_was(published, registry):
    assert pull(trust=None).signed == "unchecked"
    shutil.rmtree("out")
    Path("starcat.lock").unlink()
    assert pull(str(published), trust=None).signed == "unsigned"
    assert not Path("state").exists()


def test_a_pin_that_is_not_signed_is_refused(registry, made):
    pull(trust=None, wanted="small@1.0.1")
    all_of_before(registry, made.earlier)
    with pytest.raises(StarcatError, match=r"has no version 1\.0\.1 of small; it has 1\.0\.0"):
        pull_pinned(None, None, Path("two"), Path("starcat.lock"), ONCE, trust=Path("root.json"))
    assert not list(Path("two").glob("small*"))


def test_keys_are_rotated_and_who_trusted_goes_on(registry, made, seen):
    shutil.copytree(seen, remembered("registry")[0], symlinks=True)
    new = ("chief", "dora")
    with pytest.raises(ConfigError, match="of the role root that are needed: 2"):
        change_roles(registry, signing("chief", "dora"), {"root": publics(new)}, {})
    facts = change_roles(
        registry,
        signing("chief", "deputy", "dora", "bert", "emil", "clock"),
        {"root": publics(new), "targets": publics(("bert", "emil"))},
        {},
    )
    assert [(one.role, one.version, one.threshold) for one in facts] == [
        ("root", 2, 2), ("targets", 4, 2), ("snapshot", 4, 1), ("timestamp", 4, 1),
    ]  # fmt: skip
    assert pull(trust=None).signed == "checked"
    with pytest.raises(ConfigError, match="is not one of the keys that sign registry"):
        renew(registry, signing("anna"))
    assert pull(trust=Path("chief.pub")).outcome == "unchanged"


def test_a_registry_is_renewed_by_a_key_that_can_do_nothing_else(registry, small_database):
    frozen("timestamp", "clock")(registry, registry)
    with pytest.raises(StarcatError, match="The publisher can run 'starcat keys renew"):
        pull()
    facts = {one.role: one for one in renew(registry, signing("clock", days=2))}
    assert facts["timestamp"].until == f"{datetime.now(UTC) + timedelta(days=2):%Y-%m-%d}"
    assert pull().signed == "checked"
    with pytest.raises(ConfigError, match="of the role targets that are needed: 2, by the keys"):
        publish(small_database, str(registry), sign=signing("clock"))


def test_a_publisher_does_not_sign_files_that_others_put_there(registry, small_database):
    Forger(registry).edit_json("targets", lambda one: one["signed"]["targets"].clear())
    with pytest.raises(StarcatError, match="was changed, and is not signed again"):
        publish(small_database, str(registry), sign=signing("anna", "bert"))


def test_from_the_command_line(starcat, small_database, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name in ("anna", "bert"):
        assert starcat(["keys", "new", name]).code == 0
        assert Path(f"{name}.key").stat().st_mode & 0o777 == 0o600
    keys = ["--sign", "anna.key", "--sign", "bert.key"]
    ran = starcat(["publish", small_database, "registry", *keys, "--threshold", "2"])
    assert "published and signed: small-1.0.0 in registry" in ran.err
    ran = starcat(["publish", small_database, "registry", "--sign", "anna.key"])
    assert (ran.code, "that are missing: 1. Give --sign" in ran.err) == (2, True)
    ran = starcat(["pull", "small", "--registry", "registry", "-o", "out", "--trust", "anna.pub"])
    assert "pulled: out/small-1.0.0; signed by keys that you trust" in ran.err
    ran = starcat(["keys", "renew", "registry", "--sign", "bert.key", "--days", "1", "--json"])
    facts = json.loads(ran.out)
    assert [one["version"] for one in facts] == [1, 1, 1, 2]
    assert facts[0]["names"] == ["anna", "bert"]
    assert starcat(["keys", "show", "registry", "--json"]).out == ran.out


def test_a_change_of_roles_and_a_release_keep_the_days_of_the_timestamp(registry, database_version):
    in_30_days = f"{datetime.now(UTC) + timedelta(days=30):%Y-%m-%d}"
    renew(registry, signing("clock", days=30))
    facts = change_roles(
        registry,
        signing("chief", "deputy", "anna", "bert", "dora", "clock"),
        {"targets": publics(("anna", "bert", "dora"))},
        {},
    )
    assert [one.until for one in facts if one.role == "timestamp"] == [in_30_days]
    publish(database_version("1.0.2"), str(registry), sign=signing("anna", "bert"))
    assert roles_of(str(registry))[-1].until == in_30_days
    assert renew(registry, signing("clock"))[-1].until == in_30_days
    assert renew(registry, signing("clock", days=2))[-1].until < in_30_days


def test_keys_are_shown_with_their_names(starcat, small_database, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("anna", "chief"):
        assert starcat(["keys", "new", name]).code == 0
    assert starcat(["publish", small_database, "registry", "--sign", "anna.key"]).code == 0
    sign = ["--sign", "anna.key", "--sign", "chief.key"]
    assert starcat(["keys", "roles", "registry", *sign, "--root", "chief.pub"]).code == 0
    facts = json.loads(starcat(["keys", "show", "registry", "--json"]).out)
    assert [one["names"] for one in facts] == [["chief"], ["anna"], ["anna"], ["anna"]]
    ran = starcat(["keys", "show", "registry"])
    assert ["root", "chief", facts[0]["keys"][0]] in [
        line.split()[:3] for line in ran.out.splitlines()
    ]


def test_a_first_publication_that_is_killed_while_it_signs_can_be_repeated(
    small_database, tmp_path, monkeypatch
):
    written = metadata.replace_file

    def stop_at_the_timestamp(path: Path, data: bytes, beside: Path) -> None:
        if path.name == "timestamp.json":
            raise KeyboardInterrupt
        written(path, data, beside)

    registry = tmp_path / "registry"
    with monkeypatch.context() as patch:
        patch.setattr(metadata, "replace_file", stop_at_the_timestamp)
        with pytest.raises(KeyboardInterrupt):
            publish(small_database, str(registry), sign=signing("anna"))
    assert not (registry / "metadata").exists()
    published = publish(small_database, str(registry), sign=signing("anna"))
    assert (published.outcome, published.is_signed) == ("unchanged", True)
    assert roles_of(str(registry))[-1].version == 1


def test_a_registry_is_renewed_when_half_of_its_time_has_passed(registry):
    assert not renew_if_old(registry, signing("clock"))
    assert renew_if_old(registry, signing("clock", now=datetime.now(UTC) + timedelta(days=50)))
    assert (
        roles_of(str(registry))[-1].version
        == Forger(registry).read("timestamp").signed.version
        == 4
    )
