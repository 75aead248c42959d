"""The content-addressed store: whole or absent, checked, and in order."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evopolicy_common.errors import StorageError
from evopolicy_common.records.blobs import MAX_UNFINISHED, BlobStore, digest_of, is_digest, write_atomically


def test_what_is_put_is_read_back(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    digest = store.put(b"hello")
    assert digest == digest_of(b"hello")
    assert store.read_blob(digest) == b"hello"
    assert store.read_chunk(digest, 1, 3) == b"ell"
    assert list(store.digests()) == [digest]


def test_a_damaged_blob_is_refused_and_set_aside(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    digest = store.put(b"hello")
    store.path(digest).write_bytes(b"hullo")
    with pytest.raises(StorageError, match="damaged"):
        store.read_blob(digest)
    assert not store.has(digest)
    store.put(b"hello")
    assert store.read_blob(digest) == b"hello"


@given(data=st.binary(min_size=1, max_size=400), step=st.integers(1, 100))
def test_chunks_in_order_make_the_blob(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, step: int
) -> None:
    store = BlobStore(tmp_path_factory.mktemp("blobs"))
    digest = digest_of(data)
    have = 0
    while have < len(data):
        have = store.append_chunk("w", digest, len(data), have, data[have : have + step])
    assert store.read_blob(digest) == data


def test_a_chunk_out_of_order_changes_nothing(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    data = b"0123456789"
    digest = digest_of(data)
    assert store.append_chunk("w", digest, 10, 0, data[:4]) == 4
    assert store.append_chunk("w", digest, 10, 6, data[6:]) == 4
    assert store.append_chunk("other", digest, 10, 0, data[:2]) == 2
    assert store.append_chunk("w", digest, 10, 4, data[4:]) == 10
    assert store.append_chunk("other", digest, 10, 2, data[2:]) == 10


def test_an_upload_of_other_bytes_is_refused_and_can_be_begun_again(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    digest = digest_of(b"good")
    with pytest.raises(StorageError):
        store.append_chunk("w", digest, 4, 0, b"evil")
    assert store.append_chunk("w", digest, 4, 0, b"good") == 4


@pytest.mark.parametrize("name", ["../../etc/passwd", "", "0" * 63, "0" * 65, "G" * 64, "0" * 63 + "\n"])
def test_what_is_no_digest_never_reaches_a_path(tmp_path: Path, name: str) -> None:
    assert not is_digest(name)
    with pytest.raises(ValueError, match="digest"):
        BlobStore(tmp_path).path(name)


def test_an_atomic_write_replaces_the_file_and_leaves_nothing_beside(tmp_path: Path) -> None:
    path = tmp_path / "f"
    write_atomically(path, b"one")
    write_atomically(path, b"two", mode=0o600)
    assert path.read_bytes() == b"two"
    assert path.stat().st_mode & 0o777 == 0o600
    assert list(tmp_path.iterdir()) == [path]


def test_a_sender_that_finishes_nothing_takes_a_bounded_number_of_places(tmp_path: Path) -> None:
    store = BlobStore(tmp_path)
    for k in range(3 * MAX_UNFINISHED):
        assert store.append_chunk("w", digest_of(b"%d" % k), 1000, 0, b"begun") == 5
    store.append_chunk("other", digest_of(b"mine"), 1000, 0, b"begun")
    assert len(list((tmp_path / "parts").iterdir())) == MAX_UNFINISHED + 1
    # The latest go on where they were.
    last = 3 * MAX_UNFINISHED - 1
    assert store.append_chunk("w", digest_of(b"%d" % last), 1000, 5, b"on") == 7
    assert store.append_chunk("w", digest_of(b"0"), 1000, 5, b"on") == 0
