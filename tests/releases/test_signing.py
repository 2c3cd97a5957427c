"""Signed registries: signed files, checks, and attacks, each refused with a message."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.x448 import X448PrivateKey
from registry_files import edit_index, serving, write
from signed_registry import CHIEFS, CLOCK, Forger, key_of, make, publics, signing

from starcat.errors import ConfigError, ProductError, StarcatError
from starcat.releases.lockfile import pull_pinned, pull_wanted
from starcat.releases.publishing import publish_artifact
from starcat.releases.registry import remembered
from starcat.releases.signing import change_roles, renew, renew_if_old, roles_of
from starcat.releases.tree import INDEX_NAME, MAX_INDEX_BYTES
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
    artifact_version: Callable[[str], Path],
    small_artifact: Path,
) -> Made:
    return Made(*make(tmp_path_factory.mktemp("signed"), artifact_version, small_artifact))


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
        return remembered(str(made.registry))


def pull(
    registry: str = "registry",
    wanted: str = "small",
    trust: Path | None = Path("root.json"),
    output: Path = Path("out"),
    lock: Path = Path("starcat.lock"),
) -> Any:
    return pull_wanted(wanted, registry, output, lock, ONCE, trust=trust)


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


def other_byte(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    write(path, bytes(data))


def link(path: Path) -> None:
    moved = Path("elsewhere").resolve()
    path.rename(moved)
    path.symlink_to(moved)


def fifo(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def huge(path: Path, size: int = 1 << 30) -> None:
    write(path, b"")
    with path.open("r+b") as file:
        file.truncate(size)


def on_blob(change: Callable[[Path], object], name: str) -> Callable[[Path, Path], None]:
    return lambda registry, earlier: change(blob(registry, name))


def on_file(change: Callable[[Path], object], name: str) -> Callable[[Path, Path], None]:
    return lambda registry, earlier: change(registry / name)


def on_index(change: Callable[[dict[str, Any]], object]) -> Callable[[Path, Path], None]:
    return lambda registry, earlier: edit_index(registry, change)


def on_metadata(
    role: str, change: Callable[[dict[str, Any]], object]
) -> Callable[[Path, Path], None]:
    return lambda registry, earlier: Forger(registry).edit_json(role, change)


def gone(path: Path) -> None:
    path.unlink()


def text(content: str | bytes) -> Callable[[Path], None]:
    return lambda path: write(path, content)


def all_of_before(registry: Path, earlier: Path) -> None:
    shutil.rmtree(registry)
    linked(earlier, registry)


def file_of_before(name: str, to: str = "") -> Callable[[Path, Path], None]:
    def change(registry: Path, earlier: Path) -> None:
        write(registry / (to or name), (earlier / name).read_bytes())

    return change


def by_mallory(role: str) -> Callable[[Path, Path], None]:
    def change(registry: Path, earlier: Path) -> None:
        Forger(registry).change(role, ["mallory"], lambda one: None)
        if role == "targets":
            Forger(registry).name_upwards("targets")
        elif role == "snapshot":
            Forger(registry).name_upwards("snapshot")

    return change


def other_releases(*names: str) -> Callable[[Path, Path], None]:
    """Sign other releases with some keys, and name them with keys that may do so."""

    def change(registry: Path, earlier: Path) -> None:
        def fewer(targets: Any) -> None:
            targets.targets.pop("versions/small/1.0.0.json")

        Forger(registry).change("targets", names, fewer)
        Forger(registry).name_upwards("targets")

    return change


def one_key_twice(registry: Path, earlier: Path) -> None:
    """Put the signature of one key under the id of another, too."""
    other_releases("anna", "bert")(registry, earlier)

    def twice(content: dict[str, Any]) -> None:
        one, other = content["signatures"]
        other["sig"] = one["sig"]

    Forger(registry).edit_json("targets", twice)
    Forger(registry).name_upwards("targets")


def same_key_id_twice(registry: Path, earlier: Path) -> None:
    other_releases("anna")(registry, earlier)
    doubled = lambda content: content["signatures"].append(content["signatures"][0])  # noqa: E731
    Forger(registry).edit_json("targets", doubled)
    Forger(registry).name_upwards("targets")


def new_root(
    *names: str, change: Callable[[Any], object] = lambda root: None
) -> Callable[[Path, Path], None]:
    return lambda registry, earlier: (Forger(registry).change("root", names, change), None)[1]


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
    data = forger.sign(held, "root", ["mallory"])
    write(registry / "metadata/root.json", data)
    for role in ("targets", "snapshot", "timestamp"):
        forger.sign(forger.read(role), role, ["mallory"])


def frozen(role: str, *names: str) -> Callable[[Path, Path], None]:
    """Let signatures end long ago, as in an old state that an attacker shows for ever."""

    def change(registry: Path, earlier: Path) -> None:
        forger = Forger(registry)
        forger.change(role, names, lambda one: setattr(one, "expires", LONG_AGO))
        if role in ("targets", "snapshot"):
            forger.name_upwards(role)

    return change


def older_named(role: str, *names: str) -> Callable[[Path, Path], None]:
    """Name an older file of a role in a newer file, with the keys that may."""

    def change(registry: Path, earlier: Path) -> None:
        forger, old = Forger(registry), Forger(earlier)
        meta = old._meta(role)
        if role == "targets":
            forger.change("snapshot", names, lambda one: one.meta.update({"targets.json": meta}))
            forger.name_upwards("snapshot")
        else:
            forger.change("timestamp", names, lambda one: setattr(one, "snapshot_meta", meta))

    return change


def root_left_out(registry: Path, earlier: Path) -> None:
    """Offer the third root where the second should be."""
    new_root(*CHIEFS)(registry, earlier)
    new_root(*CHIEFS)(registry, earlier)
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


RELEASE, INDEX, META = "versions/small/1.0.1.json", "index.json", "metadata/"
TIMESTAMP, ROOT2 = META + "timestamp.json", META + "2.root.json"
TARGETS, SNAPSHOT = META + "3.targets.json", META + "3.snapshot.json"
NOT_SIGNED = "is not the file that was signed"

Attack = tuple[Callable[[Path, Path], object], str]
ATTACKS: dict[str, Attack] = {
    # Files of a database.
    "a byte of a file": (on_blob(other_byte, "database.h5"), "its sha256 begins with"),
    "a byte of the manifest": (on_blob(other_byte, "manifest.json"), "its sha256 begins with"),
    "a longer file": (on_blob(text(b"x" * 10_000_000), "stars.parquet"), "bytes; expected"),
    "an empty file": (on_blob(text(b""), "stars.parquet"), "0 bytes; expected"),
    "a missing file": (on_blob(gone, "stars.parquet"), "missing"),
    "a link for a file": (on_blob(link, "database.h5"), "a symbolic link; expected a file"),
    "a pipe for a file": (on_blob(fifo, "manifest.json"), "not a file"),
    "a huge file": (on_blob(huge, "stars.parquet"), "1073741824 bytes; expected"),
    # The file of a release.
    "a byte of the release": (on_file(other_byte, RELEASE), f"{RELEASE} {NOT_SIGNED}"),
    "the release of an older version": (
        file_of_before("versions/small/1.0.0.json", RELEASE),
        f"{RELEASE} {NOT_SIGNED}",
    ),
    "a missing release": (on_file(gone, RELEASE), f"{RELEASE} {NOT_SIGNED}"),
    "a link for the release": (on_file(link, RELEASE), "a symbolic link; expected a file"),
    "a huge release": (on_file(huge, RELEASE), "longer than"),
    # The index, which is not signed itself.
    "an index with another content": (on_index(exchanged), "lists small-1.0.1 with another"),
    "an index with a later version": (on_index(later), "lists small-9.9.9 as the latest"),
    "an index without the release": (on_index(unlisted), "lists small-1.0.0 as the latest"),
    "an index of before": (file_of_before(INDEX), "lists small-1.0.0 as the latest"),
    "an index of nonsense": (on_file(text("{}"), INDEX), "not what starcat writes"),
    "no index": (on_file(gone, INDEX), "no registry"),
    "a huge index": (on_file(huge, INDEX), f"longer than {MAX_INDEX_BYTES} bytes"),
    "a link for the index": (on_file(link, INDEX), "a symbolic link; expected a file"),
    # Changes of signed files by an attacker without a key.
    "no metadata": (lambda one, _: shutil.rmtree(one / "metadata"), "is not signed"),
    "no timestamp": (on_file(gone, TIMESTAMP), "timestamp.json is missing, so the registry is"),
    "no snapshot": (on_file(gone, SNAPSHOT), "3.snapshot.json is missing"),
    "no targets": (on_file(gone, TARGETS), "3.targets.json is missing"),
    "a higher version of the timestamp": (
        on_metadata("timestamp", raised),
        "timestamp.json is signed by 0 of the 1 trusted keys",
    ),
    "a byte of the snapshot": (on_file(other_byte, SNAPSHOT), f"3.snapshot.json {NOT_SIGNED}"),
    "a byte of the targets": (on_file(other_byte, TARGETS), f"3.targets.json {NOT_SIGNED}"),
    "a timestamp without signatures": (on_metadata("timestamp", unsigned), "signed by 0 of the 1"),
    "an empty timestamp": (on_file(text(""), TIMESTAMP), "is not metadata of a registry"),
    "a timestamp of lists": (on_file(text("[" * 9000), TIMESTAMP), "is not metadata"),
    "a timestamp of bytes": (on_file(text(b"\xff\x00"), TIMESTAMP), "is not metadata"),
    "a huge timestamp": (on_file(huge, TIMESTAMP), "longer than"),
    "a huge snapshot": (on_file(huge, SNAPSHOT), "longer than"),
    "huge targets": (on_file(huge, TARGETS), "longer than"),
    "a huge root": (on_file(huge, ROOT2), "longer than"),
    "a root of nonsense": (on_file(text("{}"), ROOT2), "2.root.json is not metadata"),
    "a link for the timestamp": (on_file(link, TIMESTAMP), "a symbolic link; expected a file"),
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
    "all with other keys": (all_by_mallory, "timestamp.json is signed by 0 of the 1"),
    "a timestamp by another": (by_mallory("timestamp"), "timestamp.json is signed by 0 of the 1"),
    "a snapshot by another": (by_mallory("snapshot"), "4.snapshot.json is signed by 0 of the 1"),
    "targets by another": (by_mallory("targets"), "4.targets.json is signed by 0 of the 2"),
    "targets by one of two": (other_releases("anna"), "4.targets.json is signed by 1 of the 2"),
    "targets by one and another": (other_releases("anna", "mallory"), "signed by 1 of the 2"),
    "targets by who may only renew": (other_releases("anna", "clock"), "signed by 1 of the 2"),
    "one signature for two": (one_key_twice, "4.targets.json is signed by 1 of the 2"),
    "one signature twice": (same_key_id_twice, "4.targets.json is not metadata"),
    "a root by another": (new_root("mallory"), "2.root.json is signed by 0 of the 2"),
    "a root by one of two": (new_root("chief"), "2.root.json is signed by 1 of the 2"),
    "a root by one and another": (
        new_root("chief", "mallory", change=mallorys_root),
        "2.root.json is signed by 1 of the 2",
    ),
    "a root by who signs releases": (new_root("anna", "bert"), "2.root.json is signed by 0 of"),
    "a root that leaves one out": (root_left_out, "2.root.json has another version"),
    "a timestamp as snapshot": (role_of_another, "is not as it was signed"),
}
"""Attacks on a registry that is pulled from for the first time, and the sentence for each."""

LATER_ATTACKS: dict[str, Attack] = {
    "everything of before": (all_of_before, "timestamp.json is older than the last known"),
    "the timestamp of before": (file_of_before(TIMESTAMP), "older than the last known state"),
    "an older snapshot, newly named": (
        older_named("snapshot", "clock"),
        "timestamp.json is older than the last known state of this registry",
    ),
    "older targets, newly named": (
        older_named("targets", "anna"),
        "snapshot.json is older than the last known state of this registry",
    ),
    "nothing signed any more": (
        lambda one, _: shutil.rmtree(one / "metadata"),
        "is missing, so the registry is not signed",
    ),
    "other keys for all": (all_by_mallory, "timestamp.json is signed by 0 of the 1"),
}
"""Attacks on a user who has pulled before, and does not name a key again."""


def refused(
    attack: Attack, registry: Path, earlier: Path, trust: Path | None, address: str
) -> None:
    change, sentence = attack
    change(registry, earlier)
    with pytest.raises(StarcatError) as caught:
        pull(address, trust=trust)
    said = str(caught.value)
    assert sentence in said
    assert len(said) < 600
    assert not Path("out/small-1.0.1").exists()
    assert not Path("out/small-1.0.0").exists()
    assert not Path("starcat.lock").exists()


FAST = {
    *("a byte of a file", "a link for a file", "the release of an older version"),
    *("an index with a later version", "no metadata", "a byte of the targets", "a huge timestamp"),
    *("the targets of before", "frozen timestamp", "all with other keys", "one signature for two"),
    *("targets by one of two", "a root by one and another"),
}
"""One of each kind; the others run with the slow tests."""


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FAST else pytest.mark.slow) for name in ATTACKS]
)
def test_an_attack_is_refused_with_its_sentence(name, registry, made):
    refused(ATTACKS[name], registry, made.earlier, Path("root.json"), "registry")


@pytest.mark.parametrize("name", LATER_ATTACKS)
def test_an_attack_on_who_has_pulled_before_is_refused(name, registry, made, seen):
    shutil.copytree(seen, remembered("registry"), symlinks=True)
    refused(LATER_ATTACKS[name], registry, made.earlier, None, "registry")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        *("a byte of a file", "a byte of the release", "an index with a later version"),
        *("no metadata", "targets by one of two", "frozen timestamp"),
    ],
)
def test_an_attack_behind_an_address_is_refused(name, registry, made):
    with serving(registry) as server:
        refused(ATTACKS[name], registry, made.earlier, Path("root.json"), server.url)


def test_the_roles_of_a_registry_behind_an_address_are_those_of_its_folder(registry, tmp_path):
    with serving(registry) as server:
        assert roles_of(server.url) == roles_of(str(registry))
        by_mallory("targets")(registry, registry)
        with pytest.raises(ProductError, match="signatures do not agree"):
            roles_of(server.url)
    (tmp_path / "plain").mkdir()
    (tmp_path / "plain" / INDEX_NAME).write_bytes((registry / INDEX_NAME).read_bytes())
    with serving(tmp_path / "plain") as server, pytest.raises(ConfigError, match="nothing is sig"):
        roles_of(server.url)


def test_a_key_is_trusted_only_with_a_root_that_it_signed(registry, made):
    sentence = "metadata/1.root.json is not a root that the key"
    refused((all_by_mallory, sentence), registry, made.earlier, Path("chief.pub"), "registry")
    untouched = (lambda one, _: None, sentence)
    linked(made.registry, "other")
    refused(untouched, registry, made.earlier, Path("mallory.pub"), "other")


def test_an_unsigned_pull_is_refused_to_a_user_who_trusts_a_key(published, registry, made):
    attack = (lambda one, _: None, "metadata/timestamp.json is missing")
    refused(attack, registry, made.earlier, Path("root.json"), str(published))
    attack = (lambda one, _: None, "metadata/root.json is missing")
    refused(attack, registry, made.earlier, Path("chief.pub"), str(published))


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
    shutil.copytree(seen, remembered("registry"), symlinks=True)
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


def test_a_registry_is_renewed_by_a_key_that_can_do_nothing_else(registry, small_artifact):
    frozen("timestamp", "clock")(registry, registry)
    with pytest.raises(StarcatError, match="The publisher can run 'starcat keys renew"):
        pull()
    facts = {one.role: one for one in renew(registry, signing("clock", days=2))}
    assert facts["timestamp"].until == f"{datetime.now(UTC) + timedelta(days=2):%Y-%m-%d}"
    assert pull().signed == "checked"
    with pytest.raises(ConfigError, match="of the role targets that are needed: 2, by the keys"):
        publish_artifact(small_artifact, str(registry), signing=signing("clock"))


def test_a_publisher_does_not_sign_files_that_others_put_there(registry, small_artifact):
    Forger(registry).edit_json("targets", lambda one: one["signed"]["targets"].clear())
    with pytest.raises(StarcatError, match="was changed, and is not signed again"):
        publish_artifact(small_artifact, str(registry), signing=signing("anna", "bert"))


def test_from_the_command_line(starcat, small_artifact, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name in ("anna", "bert"):
        assert starcat(["keys", "new", name]).code == 0
        assert Path(f"{name}.key").stat().st_mode & 0o777 == 0o600
    again = starcat(["keys", "new", "anna"])
    assert again.code == 1
    assert "a key is never overwritten" in again.err
    keys = ["--sign", "anna.key", "--sign", "bert.key"]
    ran = starcat(["publish", small_artifact, "registry", *keys, "--threshold", "2"])
    assert "published: small-1.0.0 in registry, signed" in ran.err
    ran = starcat(["publish", small_artifact, "registry"])
    assert (ran.code, "publish with a key (--sign)" in ran.err) == (2, True)
    ran = starcat(["publish", small_artifact, "registry", "--sign", "anna.key"])
    assert (ran.code, "that are missing: 1. Give --sign" in ran.err) == (2, True)
    ran = starcat(["pull", "small", "--registry", "registry", "-o", "out", "--trust", "anna.pub"])
    assert "pulled: out/small-1.0.0; signed by keys that you trust" in ran.err
    ran = starcat(["keys", "renew", "registry", "--sign", "bert.key", "--days", "1", "--json"])
    facts = json.loads(ran.out)
    assert [one["version"] for one in facts] == [1, 1, 1, 2]
    assert starcat(["keys", "show", "registry", "--json"]).out == ran.out


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("chief.pub", "a public key, which only checks; sign with the file NAME.key"),
        ("root.json", "no private key in PEM"),
        ("none.key", "no such key; 'starcat keys new NAME' makes one"),
        ("rsa.key", "a key of another kind; only Ed25519 is used"),
        ("secret.key", "a key under a passphrase"),
        ("cut.key", "a damaged private key"),
    ],
)
def test_an_invalid_key_does_not_sign(content, sentence, registry, small_artifact, starcat):
    for name, of in (("rsa", "x448"), ("secret", "ed25519"), ("cut", "ed25519")):
        Path(f"{name}.key").write_bytes(pem_of(of, b"word" if name == "secret" else None))
    Path("cut.key").write_bytes(
        Path("cut.key").read_bytes()[:60] + b"\n-----END PRIVATE KEY-----\n"
    )
    before = sorted(registry.rglob("*"))
    ran = starcat(["publish", small_artifact, registry, "--sign", content])
    assert ran.code == (3 if content == "none.key" else 2)
    assert sentence in ran.err
    assert sorted(registry.rglob("*")) == before


def pem_of(kind: str, passphrase: bytes | None) -> bytes:
    key = X448PrivateKey.generate() if kind == "x448" else key_of("chief")
    hidden = serialization.NoEncryption()
    if passphrase is not None:
        hidden = serialization.BestAvailableEncryption(passphrase)
    form = serialization.PrivateFormat.PKCS8
    return key.private_bytes(serialization.Encoding.PEM, form, hidden)


def test_a_registry_is_renewed_when_half_of_its_time_has_passed(registry):
    assert not renew_if_old(registry, signing("clock"))
    assert renew_if_old(registry, signing("clock", now=datetime.now(UTC) + timedelta(days=50)))
    assert (
        roles_of(str(registry))[-1].version
        == Forger(registry).read("timestamp").signed.version
        == 4
    )
