"""The coordinator's blobs, in a folder and in an object store: whole or absent, checked, collected only unnamed."""

from __future__ import annotations

import os
import re
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import httpx
import pytest
from rigs.store_rows import blob, outcome_row, run_row, state_row, submit_row

from evopolicy_common.errors import ConfigError, LeadLostError, StorageError
from evopolicy_common.records.blobs import BlobStore, digest_of
from evopolicy_coordinator.core.contract.records import submit_group
from evopolicy_coordinator.storage import disk_use, objects
from evopolicy_coordinator.storage.backup import back_up
from evopolicy_coordinator.storage.engines import BLOBS, DATABASE, connect, place_of, record_place
from evopolicy_coordinator.storage.moving import move_blobs
from evopolicy_coordinator.storage.objects import ObjectBlobs, blobs_of, checked_blobs
from evopolicy_coordinator.storage.state_folder import identity_of
from evopolicy_coordinator.storage.store import Store

if TYPE_CHECKING:
    from machines.seaweedfs import ObjectStore

DAY_S = 24 * 3600.0
DATA = b"the bytes of a bundle"
DIGEST = digest_of(DATA)


class Rig:
    """A state folder with a store and blobs. `objects` is the service that has the blobs; None: a folder."""

    def __init__(self, root: Path, objects: ObjectStore | None) -> None:
        self.root, self.objects = root, objects
        root.chmod(0o700)
        identity_of(root)
        self.store = Store(root / DATABASE)
        self.store.load()
        self.store.write([run_row(), state_row()])
        self.address = str(root / "blobs") if objects is None else objects.new()
        if objects is not None:
            record_place(root, BLOBS, self.address)
        self.blobs = self.opened()

    def opened(self) -> BlobStore:
        return blobs_of(self.root, self.root / DATABASE, None, lambda: self.store.incarnation)

    def restart(self) -> None:
        self.store.load()
        self.blobs = self.opened()
        self.blobs.drop_unfinished()

    def age(self) -> None:
        """Makes all blobs older than a collection leaves alone."""
        if self.objects is None:
            for digest in self.blobs.digests():
                os.utime(self.blobs.path(digest), (0, 0))
        else:
            self.sql("UPDATE objects SET since = 0")

    def sql(self, statement: str) -> list[tuple[object, ...]]:
        db = connect(self.root / DATABASE, "rw", 1.0)
        found = db.execute(statement).fetchall()
        db.close()
        return list(found)

    def replace(self, digest: str, data: bytes) -> None:
        """Other bytes in the place of a blob's."""
        if self.objects is None:
            self.blobs.path(digest).write_bytes(data)
        else:
            import obstore

            self.blobs.drop_unfinished()
            ((name,),) = self.sql(f"SELECT name FROM objects WHERE digest = '{digest}'")
            prefix = self.address.removeprefix("s3://").partition("/")[2]
            obstore.put(self.objects.objects, f"{prefix}/{name}", data)

    def collect(self) -> int:
        return disk_use.collect(self.root, 7 * DAY_S).blobs


@pytest.fixture(params=["folder", pytest.param("objects", marks=pytest.mark.cluster)])
def rig(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Rig]:
    """On both the same tests."""
    found = Rig(tmp_path, request.getfixturevalue("object_store") if request.param == "objects" else None)
    yield found
    found.store.close()


@pytest.fixture
def remote(tmp_path: Path, object_store: ObjectStore) -> Iterator[Rig]:
    found = Rig(tmp_path, object_store)
    yield found
    found.store.close()


def test_a_stored_blob_is_read_whole_and_in_chunks(rig: Rig) -> None:
    assert rig.blobs.append_chunk("w", DIGEST, len(DATA), 0, DATA[:5]) == 5
    assert not rig.blobs.has(DIGEST)
    assert rig.blobs.append_chunk("w", DIGEST, len(DATA), 9, DATA[9:]) == 5
    assert rig.blobs.append_chunk("w", DIGEST, len(DATA), 5, DATA[5:]) == len(DATA)
    empty = rig.blobs.put(b"")
    for blobs in (rig.blobs, rig.opened()):
        assert blobs.hold(DIGEST) == blobs.size(DIGEST) == len(DATA)
        assert blobs.read_blob(DIGEST) == DATA
        assert blobs.read_chunk(DIGEST, 4, 5) == DATA[4:9]
        assert blobs.read_blob(empty) == b""
    assert set(rig.blobs.digests()) == {DIGEST, empty}
    rig.restart()
    assert rig.blobs.read_chunk(DIGEST, 0, 99) == DATA


def test_uploaded_bytes_of_another_digest_are_refused(rig: Rig) -> None:
    with pytest.raises(StorageError, match="uploaded bytes are not blob"):
        rig.blobs.append_chunk("w", DIGEST, 4, 0, b"evil")
    assert not rig.blobs.has(DIGEST)
    assert rig.blobs.put(DATA) == DIGEST


@pytest.mark.parametrize("other", [DATA[:7], DATA[:-1] + b"!", b""])
def test_a_swapped_or_truncated_blob_is_never_read(rig: Rig, other: bytes) -> None:
    """Attack: whoever can write where the blobs are replaces a bundle or cuts it."""
    rig.blobs.put(DATA)
    rig.replace(DIGEST, other)
    with pytest.raises(StorageError):
        rig.blobs.read_blob(DIGEST)
    # A gateway sends all bytes again, and then they are there again.
    rig.blobs.append_chunk("gw/r", DIGEST, len(DATA), 0, DATA, lambda _: None)
    assert rig.opened().read_blob(DIGEST) == DATA


@pytest.mark.cluster
def test_no_chunk_of_a_swapped_object_is_sent(remote: Rig) -> None:
    """Attack: as above, for a receiver that asks in chunks. The reason names the object, and a restored one is read."""
    remote.blobs.put(DATA)
    remote.replace(DIGEST, DATA[::-1])
    for _ in range(2):
        with pytest.raises(StorageError, match=rf"{DIGEST}-\d+-\w+ has other bytes than were written"):
            remote.blobs.read_chunk(DIGEST, 0, 5)
    assert "has other bytes" in remote.blobs.trouble
    remote.replace(DIGEST, DATA)
    assert remote.blobs.read_chunk(DIGEST, 0, 5) == DATA[:5]
    assert remote.blobs.trouble == ""
    assert remote.blobs.hold(DIGEST) == len(DATA)


def test_the_last_chunk_is_stored_when_it_is_sent_again(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first time the place refuses it."""
    keep = type(rig.blobs)._keep

    def refuse(*_: object) -> None:
        raise StorageError("no room")

    monkeypatch.setattr(type(rig.blobs), "_keep", refuse)
    for _ in range(2):
        with pytest.raises(StorageError, match="no room"):
            rig.blobs.append_chunk("w", DIGEST, len(DATA), 0, DATA)
    rig.blobs.append_chunk("w", DIGEST, len(DATA), 0, DATA[:5])
    with pytest.raises(StorageError, match="no room"):
        rig.blobs.append_chunk("w", DIGEST, len(DATA), 5, DATA[5:])
    monkeypatch.setattr(type(rig.blobs), "_keep", keep)
    assert rig.blobs.append_chunk("w", DIGEST, len(DATA), 5, DATA[5:]) == len(DATA)
    assert rig.blobs.read_blob(DIGEST) == DATA


def test_a_collection_takes_old_blobs_that_no_row_names(rig: Rig) -> None:
    kept, recorded = rig.blobs.put(b"a named bundle"), blob(b"a recording", inline=False)
    rig.blobs.put(b"a recording")
    rig.store.write([submit_row(bundle=kept), outcome_row(submit_group("r-1", 0, "train"), 0, 0, recorded)])
    gone = rig.blobs.put(b"uploaded for nothing")
    assert rig.collect() == 0
    rig.age()
    assert disk_use.collect(rig.root, 7 * DAY_S, dry_run=True).blobs == 1
    assert rig.blobs.has(gone)
    assert rig.collect() == 1
    assert set(rig.blobs.digests()) == {kept, recorded.digest}
    assert [rig.blobs.read_blob(each) for each in (kept, recorded.digest)] == [
        b"a named bundle",
        b"a recording",
    ]
    if rig.objects is not None:
        assert len(rig.objects.paths(rig.address)) == 2


@pytest.mark.parametrize("how", ["uploaded", "held"])
def test_a_blob_stored_during_a_collection_stays(rig: Rig, how: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the collection's lists and its deletions a blob that it shall take is uploaded again, or named."""
    rig.blobs.put(DATA)
    rig.age()
    named = disk_use._named

    def meanwhile(*args: object) -> set[str]:
        found = named(*args)  # type: ignore[arg-type]
        if how == "uploaded":
            for offset in (0, 5):
                rest = DATA[:5] if offset == 0 else DATA[5:]
                rig.blobs.append_chunk("gw/r", DIGEST, len(DATA), offset, rest, lambda _: None)
        else:
            assert rig.blobs.hold(DIGEST) == len(DATA)
            rig.store.write([submit_row(bundle=DIGEST)])
        return found

    monkeypatch.setattr(disk_use, "_named", meanwhile)
    rig.collect()
    rig.restart()
    assert rig.blobs.read_blob(DIGEST) == DATA


@pytest.mark.cluster
def test_no_row_names_a_blob_that_was_collected_meanwhile(remote: Rig) -> None:
    """The coordinator has found the blob, and commits the row only after the collection: the write fails, and after
    another upload it succeeds. Neither clock nor age matters: the object is a day old by the database's."""
    remote.blobs.put(DATA)
    assert remote.blobs.hold(DIGEST) == len(DATA)
    remote.age()
    assert remote.collect() == 1
    with pytest.raises(StorageError, match="was collected before a row named it"):
        remote.store.write([submit_row(bundle=DIGEST)])
    assert remote.sql("SELECT COUNT(*) FROM submits") == [(0,)]
    assert remote.blobs.hold(DIGEST) is None
    remote.blobs.put(DATA)
    remote.store.write([submit_row(bundle=DIGEST)])
    remote.age()
    assert remote.collect() == 0
    assert remote.opened().read_blob(DIGEST) == DATA


@pytest.mark.cluster
def test_a_late_deletion_never_meets_a_new_upload(remote: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attack on the order of events: a collector is paused between its commit and its request to delete the object,
    and the blob is uploaded and named meanwhile."""
    remote.blobs.put(DATA)
    remote.age()
    reached, go_on = threading.Event(), threading.Event()
    asking = ObjectBlobs._asking

    def paused(self: ObjectBlobs, what: str) -> object:
        if what.startswith("delete "):
            reached.set()
            assert go_on.wait(30)
        return asking(self, what)

    monkeypatch.setattr(ObjectBlobs, "_asking", paused)
    collector = threading.Thread(target=remote.collect)
    collector.start()
    assert reached.wait(30)
    remote.blobs.put(DATA)
    remote.store.write([submit_row(bundle=DIGEST)])
    go_on.set()
    collector.join(30)
    assert remote.opened().read_blob(DIGEST) == DATA
    (left,) = remote.objects.paths(remote.address) if remote.objects else ()
    assert DIGEST in left


@pytest.mark.cluster
def test_a_replaced_coordinator_stores_no_blob(remote: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attack on the order of events: a coordinator is paused while it uploads, another one leads and a collection
    deletes the object; the first one wakes up."""
    assert remote.objects is not None
    other, changing = Store(remote.root / DATABASE), ObjectBlobs._changing

    def paused(self: ObjectBlobs, lock: str | None = None) -> object:
        monkeypatch.setattr(ObjectBlobs, "_changing", changing)
        other.load()
        remote.collect()
        return changing(self, lock)

    monkeypatch.setattr(ObjectBlobs, "_changing", paused)
    with pytest.raises(LeadLostError, match="was stored for incarnation"):
        remote.blobs.put(DATA)
    assert not remote.blobs.has(DIGEST)
    assert remote.objects.paths(remote.address) == []
    other.close()


@pytest.mark.cluster
def test_two_collections_at_once_take_no_named_blob(remote: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """A row is written between the two; the first one has read the rows before."""
    remote.blobs.put(DATA)
    remote.age()
    named, nested = disk_use._named, []

    def meanwhile(*args: object) -> set[str]:
        found = named(*args)  # type: ignore[arg-type]
        if not nested:
            nested.append(True)
            remote.store.write([submit_row(bundle=DIGEST)])
            remote.collect()
        return found

    monkeypatch.setattr(disk_use, "_named", meanwhile)
    remote.collect()
    assert remote.opened().read_blob(DIGEST) == DATA


@pytest.mark.cluster
def test_what_no_row_names_goes_with_the_next_incarnation(remote: Rig) -> None:
    """An upload whose row was never committed, as after a crash between the two."""
    assert remote.objects is not None
    remote.blobs.put(DATA)
    remote.sql("DELETE FROM objects")
    remote.collect()
    assert len(remote.objects.paths(remote.address)) == 1
    remote.restart()
    remote.collect()
    assert remote.objects.paths(remote.address) == []


@pytest.mark.cluster
def test_copies_of_objects_take_bounded_space(remote: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(objects, "COPIES_BYTES", 250)
    digests = [remote.blobs.put(bytes([k]) * 100) for k in range(4)]
    assert sum(remote.blobs.path(each).exists() for each in digests) == 2
    assert [remote.blobs.read_chunk(each, 99, 9) for each in digests] == [bytes([k]) for k in range(4)]


@pytest.mark.cluster
def test_denied_access_and_a_full_store_have_reasons(
    remote: Rig, monkeypatch: pytest.MonkeyPatch, object_store: ObjectStore
) -> None:
    for name, value in object_store.reading.items():
        monkeypatch.setenv(name, value)
    denied = remote.opened()
    with pytest.raises(StorageError, match=r"cannot write \w\w/.*403 Forbidden \(AccessDenied\)"):
        denied.put(DATA)
    for name, value in object_store.keys.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "guessed")
    with pytest.raises(StorageError, match=r"\(SignatureDoesNotMatch\)") as refused:
        remote.opened().put(DATA)
    assert "guessed" not in str(refused.value)
    assert not remote.blobs.has(DIGEST)
    remote.blobs.put(DATA)
    object_store.kill()
    try:
        with pytest.raises(StorageError, match=r"cannot write .* error sending request"):
            remote.blobs.put(b"while it is down")
        object_store.start("-volume.minFreeSpace=900TiB")
        with pytest.raises(StorageError, match=r"cannot write .*500 Internal Server Error \(InternalError\)"):
            remote.blobs.put(b"while it is full")
        object_store.kill()
    finally:
        object_store.start()
    assert remote.opened().read_chunk(DIGEST, 0, 99) == DATA
    remote.blobs.put(b"while it is full")
    assert remote.blobs.trouble == ""


@pytest.mark.cluster
def test_an_address_serves_one_blob_for_a_while(remote: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """Attack: a worker uses the address of a blob that it may read for another blob, to write or delete, and later."""
    other = remote.blobs.put(b"the bundle of another run")
    remote.blobs.put(DATA)
    assert isinstance(remote.blobs, ObjectBlobs)
    assert remote.blobs.address(DIGEST) == ""
    remote.blobs.direct = True
    address = remote.blobs.address(DIGEST)
    assert httpx.get(address).content == DATA
    ((theirs,),) = remote.sql(f"SELECT name FROM objects WHERE digest = '{other}'")
    ((ours,),) = remote.sql(f"SELECT name FROM objects WHERE digest = '{DIGEST}'")
    attacks = [
        httpx.get(address.replace(str(ours), str(theirs))),
        httpx.get(address.partition(str(ours)[:2] + "/")[0] + "?" + address.partition("?")[2]),
        httpx.put(address, content=b"evil"),
        httpx.delete(address),
        httpx.get(re.sub(r"Expires=\d+", "Expires=604800", address)),
    ]
    assert [each.status_code for each in attacks] == [403] * len(attacks)
    monkeypatch.setattr(objects, "ADDRESS_LIFE", timedelta(seconds=1))
    short = remote.blobs.address(DIGEST)
    time.sleep(2.5)
    assert httpx.get(short).status_code == 403
    assert httpx.get(address).content == DATA
    with pytest.raises(StorageError):
        remote.blobs.address(digest_of(b"not stored"))


def test_direct_blobs_need_an_object_store(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="name an object store"):
        blobs_of(tmp_path, tmp_path / DATABASE, tmp_path / "blobs", direct=True)


@pytest.mark.cluster
def test_an_object_store_has_the_blobs_of_one_state_folder(remote: Rig) -> None:
    assert isinstance(remote.blobs, ObjectBlobs)
    for _ in range(2):
        remote.blobs.claim("ours")
    with pytest.raises(ConfigError, match="blobs of another state folder"):
        remote.blobs.claim("theirs")


@pytest.mark.cluster
def test_blobs_move_to_an_object_store_and_back(tmp_path: Path, object_store: ObjectStore) -> None:
    rig = Rig(tmp_path / "state", None) if (tmp_path / "state").mkdir(mode=0o700) is None else None
    assert rig is not None
    stored = {rig.blobs.put(b"%d" % k * 1000) for k in range(3)}
    bundle = min(stored)
    rig.store.write([submit_row(bundle=bundle)])
    rig.store.close()
    address = object_store.new()
    assert move_blobs(rig.root, address) == 3
    assert place_of(rig.root, BLOBS) == address
    assert len(object_store.paths(address)) == 3
    copied = back_up(rig.root, tmp_path / "backup")
    assert copied.blobs == 3
    assert set(BlobStore(tmp_path / "backup" / "blobs").digests()) == stored
    with pytest.raises(ConfigError, match="there already"):
        move_blobs(rig.root, address)
    for path in BlobStore(rig.root / "blobs").digests():
        BlobStore(rig.root / "blobs").delete(path)
    assert move_blobs(rig.root, str(rig.root / "blobs")) == 3
    back = blobs_of(rig.root, rig.root / DATABASE)
    assert type(back) is BlobStore
    assert {digest_of(back.read_blob(each)) for each in back.digests()} == stored


@pytest.mark.cluster
@pytest.mark.parametrize(
    "address",
    ["s3://key:secret@bucket/x", "s3://bucket/x?sig=secret", "ftp://secret", "s3:///secret", "az://secret/x"],
)
def test_an_address_with_a_key_is_refused_without_echo(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("AZURE_STORAGE_ACCOUNT_NAME", raising=False)
    with pytest.raises(ConfigError) as refused:
        checked_blobs(address)
    assert "secret@" not in str(refused.value)
    assert "sig=" not in str(refused.value)
