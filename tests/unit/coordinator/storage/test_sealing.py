"""The cluster's secrets as one sealed document in the database. Attackers: who reads the database, who writes to it."""

from __future__ import annotations

import base64
import os
from pathlib import Path

import pytest
from cryptography.fernet import Fernet

from evopolicy_common.errors import ConfigError, LeadLostError, StorageError
from evopolicy_coordinator.storage import sealing
from evopolicy_coordinator.storage.sealing import NOTED, SHARED_FILES, SharedFiles
from evopolicy_coordinator.storage.store import Store


@pytest.fixture
def key(tmp_path: Path) -> Path:
    return key_file(tmp_path / "key")


def key_file(path: Path, *lines: bytes) -> Path:
    path.write_bytes(b"\n".join(lines or (base64.b64encode(os.urandom(32)),)))
    path.chmod(0o600)
    return path


class Folder:
    """A state folder of a coordinator, and its database."""

    def __init__(
        self, root: Path, key: Path | None, database: Path | None = None, files: bool = False
    ) -> None:
        self.root, self.database = root, database or root.parent / "db"
        root.mkdir(mode=0o700)
        if files:
            for name in SHARED_FILES:
                self.write(name, f"{name} of the first".encode())
        self.shared = SharedFiles(root, key)

    def write(self, name: str, data: bytes) -> None:
        (self.root / name).parent.mkdir(exist_ok=True)
        (self.root / name).write_bytes(data)

    def files(self) -> dict[str, bytes]:
        return {name: (self.root / name).read_bytes() for name in SHARED_FILES if (self.root / name).exists()}

    def lead(self) -> Store:
        store = Store(self.database)
        self.shared.take_sealed(store.sealed())
        store.load()
        self.shared.push(store)
        return store


def test_a_standby_gets_the_files_and_every_later_change(tmp_path: Path, key: Path) -> None:
    first, second = Folder(tmp_path / "1", key, files=True), Folder(tmp_path / "2", key)
    store = first.lead()
    second.shared.join(second.database)
    assert second.files() == first.files()
    assert {path.stat().st_mode & 0o777 for path in second.root.rglob("*") if path.is_file()} == {0o600}
    first.write("certs/machines.json", b"[1]")
    (first.root / "secret").unlink()
    first.shared.push(store)
    second.shared.join(second.database)
    assert second.files() == first.files()
    assert "secret" not in second.files()


def test_changes_made_while_stopped_are_told_from_another_leaders(tmp_path: Path, key: Path) -> None:
    first, second = Folder(tmp_path / "1", key, files=True), Folder(tmp_path / "2", key)
    first.lead().close()
    second.lead().close()
    second.write("secret", b"a new epoch")
    first.write("certs/machines.json", b"[1]")
    second.lead().close()
    first.lead().close()
    second.lead().close()
    assert first.files() == second.files()
    assert (first.files()["secret"], first.files()["certs/machines.json"]) == (b"a new epoch", b"[1]")
    first.write("secret", b"one")
    second.write("secret", b"two")
    second.lead().close()
    with pytest.raises(ConfigError, match=r"^secret differ between .* Move these files away"):
        first.lead()
    (first.root / "secret").unlink()
    (first.root / NOTED).unlink()
    first.lead().close()
    assert first.files() == second.files()


def test_a_lost_file_is_restored_and_an_interrupted_copy_completed(
    tmp_path: Path, key: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, second = Folder(tmp_path / "1", key, files=True), Folder(tmp_path / "2", key)
    store = first.lead()
    (first.root / "certs" / "ca-key.pem").unlink()
    store.close()
    first.lead().close()
    assert "certs/ca-key.pem" in first.files()
    second.lead().close()
    for name in SHARED_FILES:
        second.write(name, b"later")
    second.lead().close()
    written = []

    def failing(path: Path, data: bytes, mode: int) -> None:
        if len(written) == 3:
            raise StorageError("no space")
        written.append(path)
        path.write_bytes(data)

    with monkeypatch.context() as patched:
        patched.setattr(sealing, "write_atomically", failing)
        with pytest.raises(StorageError, match="no space"):
            first.lead()
    first.lead().close()
    assert first.files() == second.files()


def test_who_reads_the_database_learns_no_secret(tmp_path: Path, key: Path) -> None:
    """Attack: the database's administrator, or a leaked dump, reads split secret, signing key and passwords."""
    first = Folder(tmp_path / "1", key, files=True)
    first.lead().close()
    stored = b"".join(path.read_bytes() for path in tmp_path.glob("db*"))
    for data in first.files().values():
        for form in (data, base64.b64encode(data)[:-4], data.hex().encode()):
            assert form not in stored
    assert Fernet(key.read_bytes()).decrypt(Store(first.database).sealed() or b"")


@pytest.mark.parametrize(
    "attack", ["a byte changed", "sealed with another key", "cut", "an older one restored"]
)
def test_a_changed_document_is_refused(tmp_path: Path, key: Path, attack: str) -> None:
    """Attack: who writes to the database plants secrets, or brings a revoked machine back."""
    first, second = Folder(tmp_path / "1", key, files=True), Folder(tmp_path / "2", key)
    store = first.lead()
    old = store.sealed()
    assert old is not None
    first.write("certs/machines.json", b"[]")
    first.shared.push(store)
    second.shared.join(second.database)
    before = second.files()
    sealed = {
        "a byte changed": old[:60] + bytes([old[60] ^ 1]) + old[61:],
        "sealed with another key": Fernet(Fernet.generate_key()).encrypt(b"x"),
        "cut": old[:80],
        "an older one restored": old,
    }[attack]
    store.write_sealed(sealed)
    expected = "restored an older one" if attack.startswith("an older") else "not sealed with the key"
    with pytest.raises(ConfigError, match=expected):
        second.shared.join(second.database)
    assert second.files() == before


def test_a_standby_without_the_key_says_so_and_takes_nothing(tmp_path: Path, key: Path) -> None:
    Folder(tmp_path / "1", key, files=True).lead().close()
    second = Folder(tmp_path / "2", None)
    with pytest.raises(ConfigError, match="name the file with their key by --seal-key"):
        second.shared.join(second.database)
    assert second.files() == {}


def test_a_deposed_leader_changes_no_secret(tmp_path: Path, key: Path) -> None:
    first, second = Folder(tmp_path / "1", key, files=True), Folder(tmp_path / "2", key)
    old = first.lead()
    second.lead().close()
    first.write("secret", b"too late")
    with pytest.raises(LeadLostError):
        first.shared.push(old)
    second.shared.join(second.database)
    assert second.files()["secret"] == b"secret of the first"


def test_a_key_is_replaced_by_one_above_it(tmp_path: Path, key: Path) -> None:
    first = Folder(tmp_path / "1", key, files=True)
    first.lead().close()
    new = base64.b64encode(os.urandom(32))
    first.shared = SharedFiles(first.root, key_file(tmp_path / "both", new, key.read_bytes()))
    first.lead().close()
    first.shared = SharedFiles(first.root, key_file(tmp_path / "new", new))
    first.lead().close()


@pytest.mark.parametrize(
    ("content", "mode", "expected"),
    [
        (b"hush-hush", 0o600, "32 bytes in base64"),
        (b"", 0o600, "32 bytes"),
        (b"hush-hush", 0o644, "chmod 600"),
    ],
)
def test_an_unusable_key_is_refused_and_not_shown(
    tmp_path: Path, content: bytes, mode: int, expected: str
) -> None:
    (tmp_path / "key").write_bytes(content)
    (tmp_path / "key").chmod(mode)
    with pytest.raises(ConfigError, match=expected) as raised:
        SharedFiles(tmp_path, tmp_path / "key")
    assert "hush" not in str(raised.value)
    with pytest.raises(ConfigError, match="No such file"):
        SharedFiles(tmp_path, tmp_path / "missing")
