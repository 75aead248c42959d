"""`checkpoints/submit_NNN/`: a submitted policy's files with `_meta.json` and `metrics.json` beside them.

The layout is the published one. A file of the policy's own that has the name of one of the two is kept in `_meta.json`
(`shadowed_files`), so that the bundle can be had from the folder again. Checkpoints of earlier versions had the policy in
`system/`, and in `metrics.json` what is in `_meta.json` now; they are read too.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, BundleError, ProtocolError
from evopolicy_common.records import bundles
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.bundles import Bundle, BundleFile
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA, CodeMetrics, code_metrics
from evopolicy_common.simulators import SIMULATORS

META = "_meta.json"
METRICS = "metrics.json"
METADATA = frozenset({META, METRICS})
"""What is in a checkpoint's folder beside the policy's files."""


class ImportScan(msgspec.Struct, frozen=True, kw_only=True):
    """The import statements of a policy's files, read and not run."""

    imports: tuple[str, ...]
    """Top-level names, sorted."""
    denied: tuple[str, ...]
    """Those of them that a policy may not import."""


class CheckpointMeta(msgspec.Struct, frozen=True, kw_only=True):
    """`_meta.json`: the published fields, then ours."""

    schema_version: str = PUBLISHED_SCHEMA
    submit_index: int
    submit_time: str
    """When the submit was accepted; empty where an older file does not tell."""
    n_episodes_requested: int
    remaining_budget_before: int
    remaining_budget_after: int
    snapshot_size_bytes: int = 0
    snapshot_files: Any = ()
    """Paths of the policy's files. Not relied on where other software has written it, nor is `import_scan`."""
    import_scan: Any = None
    """`ImportScan`."""
    validation_status: str
    """The status in the submit's summary."""
    bundle: str = ""
    """Digest of the bundle; empty where `system/` could not be one, or other software has written the file."""
    mean_return: float | None = None
    """Visible train mean; None when not ok."""
    val_mean: float | None = None
    """Hidden validation mean; None when not ok or not eligible."""
    shadowed_files: tuple[BundleFile, ...] = ()
    """The policy's own files in whose place the metadata are: path, whether it is executable, base64 of its bytes."""


class _OldMetrics(msgspec.Struct, frozen=True, kw_only=True):
    """`metrics.json` as earlier versions wrote it."""

    schema_version: int
    submit_index: int
    status: str
    digest: str
    n_episodes: int
    consumed_budget: int
    mean_return: float | None = None
    val_mean: float | None = None
    policy_bytes: int = 0


class _Header(msgspec.Struct, frozen=True, kw_only=True):
    schema_version: int | str


_header = msgspec.json.Decoder(_Header)
_meta = msgspec.json.Decoder(CheckpointMeta)
_old_metrics = msgspec.json.Decoder(_OldMetrics)


def write(folder: Path, meta: CheckpointMeta, bundle: Bundle | None) -> CodeMetrics:
    """Makes `folder` anew and returns the metrics in it. `meta` tells of the submit; what it tells of files is filled in."""
    if folder.exists():
        shutil.rmtree(folder)
    files = () if bundle is None else bundle.files
    bundles.unpack(without_metadata(files), folder)
    for path in folder.rglob("*"):
        if path.is_file():
            path.chmod(path.stat().st_mode & 0o555)
    metrics = code_metrics({file.path: file.data for file in files})
    meta = msgspec.structs.replace(
        meta,
        snapshot_size_bytes=sum(len(file.data) for file in files),
        snapshot_files=tuple(file.path for file in files),
        import_scan=ImportScan(
            imports=metrics.imports, denied=tuple(name for name in metrics.imports if name in SIMULATORS)
        ),
        bundle="" if bundle is None else bundle.digest,
        shadowed_files=tuple(file for file in files if file.path in METADATA),
    )
    for name, value in ((META, meta), (METRICS, metrics)):
        write_atomically(folder / name, msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n")
    return metrics


def without_metadata(files: tuple[BundleFile, ...]) -> Bundle:
    """The bundle of the files that do not have a metadata file's name."""
    return bundles.pack([file for file in files if file.path not in METADATA])


def read_meta(folder: Path, episode_budget: int) -> CheckpointMeta | None:
    """What the checkpoint in `folder` tells of its submit; None when it tells nothing. ProtocolError when it is damaged."""
    for name in (META, METRICS):
        try:
            data = (folder / name).read_bytes()
            if name == META:
                return _meta.decode(data)
            if _header.decode(data).schema_version == PUBLISHED_SCHEMA:
                return None  # the file of that name that is written now, without its neighbour
            return _upgraded(_old_metrics.decode(data), episode_budget)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise ProtocolError(f"{name} cannot be read: {error.strerror}") from error
        except DECODE_ERRORS as error:
            raise ProtocolError(f"{name} is not a checkpoint's: {error}") from error
    return None


def _upgraded(old: _OldMetrics, episode_budget: int) -> CheckpointMeta:
    after = episode_budget - old.consumed_budget
    return CheckpointMeta(
        submit_index=old.submit_index,
        submit_time="",
        n_episodes_requested=old.n_episodes,
        remaining_budget_before=after + old.n_episodes,
        remaining_budget_after=after,
        snapshot_size_bytes=old.policy_bytes,
        validation_status=old.status,
        bundle=old.digest,
        mean_return=old.mean_return,
        val_mean=old.val_mean,
    )


def policy_folder(folder: Path) -> Path:
    """Where the policy's files are: in `folder` itself, or in its `system/` where an earlier version wrote it."""
    old = not any((folder / name).exists() for name in (META, "policy.py")) and (folder / "system").is_dir()
    return folder / "system" if old else folder


def bundle_of(folder: Path) -> Bundle:
    """The bundle that was submitted. BundleError when the folder holds none that can be read."""
    if not (folder / META).exists():
        return bundles.snapshot(policy_folder(folder))
    try:
        meta = read_meta(folder, 0)
    except ProtocolError as error:
        raise BundleError(str(error)) from error
    own = () if meta is None else meta.shadowed_files
    return bundles.pack([*bundles.snapshot(folder, METADATA).files, *own])
