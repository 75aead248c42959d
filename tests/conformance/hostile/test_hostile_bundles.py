"""Bundles that are attacks: each gets its verdict before anything of it is played, and a plain copy falls for it."""

from __future__ import annotations

import importlib.util
import py_compile
from pathlib import Path

import pytest
from bundle_attacks import BUNDLES, PATHS, SECRET, BundleAttack, packed

from evopolicy_common.errors import BundleError
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import BundleFile
from evopolicy_gateway.submits.snapshots import take_snapshot


def folders(tmp_path: Path) -> tuple[Path, Path]:
    """`system/` with a policy, and a file outside that holds the secret."""
    system, secret = tmp_path / "system", tmp_path / "outside" / "secret"
    system.mkdir()
    secret.parent.mkdir()
    secret.write_bytes(SECRET)
    (system / "policy.py").write_text("class Policy: ...")
    return system, secret


@pytest.mark.parametrize("attack", BUNDLES, ids=lambda attack: attack.name)
def test_a_hostile_folder_has_a_verdict_and_no_bundle(tmp_path: Path, attack: BundleAttack) -> None:
    system, secret = folders(tmp_path)
    attack.spoil(system, secret)
    taken = take_snapshot(system, BlobStore(tmp_path / "blobs"))
    assert taken.digest is None
    assert taken.error is not None
    assert taken.error.category == attack.verdict
    assert attack.words in taken.error.message
    assert not any(SECRET in path.read_bytes() for path in (tmp_path / "blobs").rglob("*") if path.is_file())


@pytest.mark.parametrize(
    "attack", [attack for attack in BUNDLES if attack.harm], ids=lambda attack: attack.name
)
def test_a_plain_copy_falls_for_it(tmp_path: Path, attack: BundleAttack) -> None:
    system, secret = folders(tmp_path)
    attack.spoil(system, secret)
    assert attack.harm is not None
    assert attack.harm(system)


@pytest.mark.parametrize("path", PATHS)
def test_a_packed_bundle_writes_nothing_outside_its_folder(tmp_path: Path, path: str) -> None:
    bundle = packed(path)
    with pytest.raises(BundleError, match="plain relative path"):
        bundles.load(bundle.packed, bundle.digest)
    with pytest.raises(BundleError, match="plain relative path"):
        bundles.unpack(bundle, tmp_path / "a" / "bundle")
    assert list(tmp_path.iterdir()) == []


def test_a_packed_bundle_with_compiled_code_is_refused(tmp_path: Path) -> None:
    # Compiled code of this kind is loaded without a look at the source beside it.
    source, decoy = tmp_path / "policy.py", tmp_path / "decoy.py"
    source.write_text("WHO = 'policy.py'")
    decoy.write_text("WHO = 'a decoy'")
    compiled = py_compile.compile(
        str(decoy),
        importlib.util.cache_from_source(str(source)),
        invalidation_mode=py_compile.PycInvalidationMode.UNCHECKED_HASH,
    )
    spec = importlib.util.spec_from_file_location("policy", source)
    assert spec is not None
    assert spec.loader is not None
    policy = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(policy)
    assert policy.WHO == "a decoy"
    name = str(Path(compiled).relative_to(tmp_path))
    bundle = bundles.pack(
        [BundleFile(path, False, (tmp_path / path).read_bytes()) for path in ("policy.py", name)]
    )
    with pytest.raises(BundleError, match="compiled code"):
        bundles.load(bundle.packed, bundle.digest)


def test_a_plain_write_goes_outside(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    (file,) = [file for file in packed("../evil").files if file.path != "policy.py"]
    (folder / file.path).write_bytes(file.data)
    assert (tmp_path / "evil").exists()
