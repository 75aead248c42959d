"""The snapshot of `system/` for a submit: a bundle, or the verdict on a folder that cannot be one."""

from __future__ import annotations

import ast
import stat
from pathlib import Path

import msgspec

from evopolicy_common.errors import BundleError
from evopolicy_common.logs import log
from evopolicy_common.messages.episode import FailureCategory, PolicyFailure
from evopolicy_common.records.blobs import BlobStore
from evopolicy_common.records.code_metrics import MAX_PARSED_BYTES, parse
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.trees import TreeRecorder
from evopolicy_common.records.secrets import read_passed

POLICY_FILE = "policy.py"


class SystemSnapshot(msgspec.Struct, frozen=True, kw_only=True):
    """Exactly one of `digest` and `error` is set."""

    digest: str | None
    error: PolicyFailure | None
    kept: str | None = None
    """Digest of a bundle without a policy: stored for the run's checkpoint, and not sent."""
    bundle: bundles.Bundle | None = None
    """None where `system/` cannot be one."""
    tree: str = ""
    """Digest of the workspace's tree; empty: not recorded."""


def take_snapshot(system: Path, blobs: BlobStore, *, published: bool = False) -> SystemSnapshot:
    """Snapshots the current `system` and stores the bundle.

    A folder that cannot be a bundle is the policy's failure and is charged: `missing_policy` when `policy.py` is
    missing or no regular file, else `import_error`; the message names file, value and limit. `published`: the source
    decides too, as in the published software. Raises StorageError when the store refuses.
    """
    try:
        bundle = bundles.snapshot(system)
    except BundleError as error:
        return SystemSnapshot(digest=None, error=_no_bundle(system, str(error)))
    except OSError as error:
        why = f"system/ cannot be read: {error.strerror or error}"
        return SystemSnapshot(digest=None, error=_no_bundle(system, why))
    files, failure = {file.path: file.data for file in bundle.files}, None
    if POLICY_FILE not in files:
        failure = _no_bundle(system, "system/policy.py is missing; write a class Policy there")
    elif published:
        failure = _fault_of_source(files)
    digest = blobs.put(bundle.packed)
    sent, kept = (None, digest) if failure else (digest, None)
    return SystemSnapshot(digest=sent, error=failure, kept=kept, bundle=bundle)


def record_tree(
    snapshot: SystemSnapshot, submit: str, recorder: TreeRecorder, folder: Path
) -> SystemSnapshot:
    """The snapshot with the workspace's tree, unless that cannot be recorded. `folder`: the run's."""
    try:
        tree = recorder.record(submit, snapshot.bundle, read_passed(folder))
    except Exception as error:
        log.error("the workspace is not recorded", submit=submit, exc_info=error)
        return snapshot
    return msgspec.structs.replace(snapshot, tree=tree)


def _fault_of_source(files: dict[str, bytes]) -> PolicyFailure | None:
    """The verdict of the published software on sources that it does not run: `import_error` for a Python file that
    cannot be parsed, `missing_policy` for a `policy.py` without a class statement `Policy` at its top level."""
    remaining = MAX_PARSED_BYTES
    for path in sorted(path for path in files if path.endswith(".py")):
        remaining -= len(files[path])
        if remaining < 0:
            break
        tree = parse(files[path])
        if tree is None:
            return _failure("import_error", f"system/{path} cannot be parsed as Python")
        classes = {node.name for node in tree.body if isinstance(node, ast.ClassDef)}
        if path == POLICY_FILE and "Policy" not in classes:
            why = "system/policy.py has no class statement Policy at its top level"
            return _failure("missing_policy", why)
    return None


def _failure(category: FailureCategory, message: str) -> PolicyFailure:
    return PolicyFailure(category=category, step_index=None, message=message[:4000])


def _no_bundle(system: Path, message: str) -> PolicyFailure:
    try:
        there = stat.S_ISREG((system / POLICY_FILE).lstat().st_mode) and not system.is_symlink()
    except OSError:
        there = False
    return _failure("import_error" if there else "missing_policy", message)
