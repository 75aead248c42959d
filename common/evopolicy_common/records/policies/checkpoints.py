"""`checkpoints/submit_NNN/`: a submitted policy's files, with `_meta.json` and `metrics.json` beside them.

The layout is the published one. If a policy has a file with one of these two names, `_meta.json` keeps it
(`shadowed_files`), so that the bundle can be restored from the folder.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, BundleError, ProtocolError
from evopolicy_common.messages.bounds import check_plausible
from evopolicy_common.processes.packages import SIMULATORS
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.records.code_metrics import PUBLISHED_SCHEMA, CodeMetrics, code_metrics
from evopolicy_common.records.policies import bundles
from evopolicy_common.records.policies.bundles import Bundle, BundleFile
from evopolicy_common.regular_files import read_regular

META = "_meta.json"
METRICS = "metrics.json"
METADATA = frozenset({META, METRICS})
"""Files in a checkpoint's folder besides the policy's."""
_MAX_META_BYTES = 2 * bundles.MAX_BYTES
"""Base64 of the policy's own files with these names is in `_meta.json`."""


class ImportScan(msgspec.Struct, frozen=True, kw_only=True):
    """The import statements of a policy's files, parsed without running them."""

    imports: tuple[str, ...]
    """Top-level names, sorted."""
    denied: tuple[str, ...]
    """Those of `imports` that a policy may not import."""


class CheckpointMeta(msgspec.Struct, frozen=True, kw_only=True):
    """`_meta.json`: the published fields, then ours."""

    schema_version: str = PUBLISHED_SCHEMA
    submit_index: int
    submit_time: str
    """Time of acceptance; empty: unknown."""
    n_episodes_requested: int
    remaining_budget_before: int
    remaining_budget_after: int
    snapshot_size_bytes: int = 0
    snapshot_files: Any = ()
    """Paths of the policy's files. Other software may have written this field and `import_scan`."""
    import_scan: Any = None
    validation_status: str
    """The status of the submit's summary."""
    bundle: str = ""
    """Digest of the bundle; empty when `system/` could not be bundled, or other software wrote the file."""
    mean_return: float | None = None
    """Visible mean return over the train episodes; None when not ok."""
    val_mean: float | None = None
    """Hidden validation mean; None when not ok or not eligible."""
    shadowed_files: tuple[BundleFile, ...] = ()
    """The policy's own files that the metadata replace: path, whether it is executable, base64 of its bytes."""


_meta = msgspec.json.Decoder(CheckpointMeta)


def measured(bundle: Bundle | None) -> CodeMetrics:
    """The metrics of a submitted policy; None: `system/` could not be bundled."""
    return code_metrics({} if bundle is None else {file.path: file.data for file in bundle.files})


def write(folder: Path, meta: CheckpointMeta, bundle: Bundle | None, metrics: CodeMetrics | None) -> None:
    """Creates `folder` anew. `meta` describes the submit; its fields on files are set here. `metrics`: of the
    bundle; None leaves out `metrics.json` and `import_scan`."""
    if folder.exists():
        shutil.rmtree(folder)
    files = () if bundle is None else bundle.files
    bundles.unpack(without_metadata(files), folder)
    for path in folder.rglob("*"):
        if path.is_file():
            path.chmod(path.stat().st_mode & 0o555)
    imports = () if metrics is None else metrics.imports
    scan = ImportScan(imports=imports, denied=tuple(name for name in imports if name in SIMULATORS))
    meta = msgspec.structs.replace(
        meta,
        snapshot_size_bytes=sum(len(file.data) for file in files),
        snapshot_files=tuple(file.path for file in files),
        import_scan=None if metrics is None else scan,
        bundle="" if bundle is None else bundle.digest,
        shadowed_files=tuple(file for file in files if file.path in METADATA),
    )
    for name, value in ((META, meta), (METRICS, metrics)):
        if value is not None:
            write_atomically(folder / name, msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n")


def without_metadata(files: tuple[BundleFile, ...]) -> Bundle:
    return bundles.pack([file for file in files if file.path not in METADATA])


def read_meta(folder: Path) -> CheckpointMeta | None:
    """The metadata of the checkpoint in `folder`; None when it has none. Raises ProtocolError when they are damaged."""
    try:
        return check_plausible(_meta.decode(read_regular(folder / META, _MAX_META_BYTES)))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ProtocolError(f"{META} cannot be read: {error.strerror}") from error
    except (*DECODE_ERRORS, ValueError) as error:
        raise ProtocolError(f"{META} is not a checkpoint's: {error}") from error


def bundle_of(folder: Path) -> Bundle:
    """The submitted bundle. Raises BundleError when the folder has none that can be read."""
    if not (folder / META).exists():
        return bundles.snapshot(folder)
    try:
        meta = read_meta(folder)
    except ProtocolError as error:
        raise BundleError(str(error)) from error
    own = () if meta is None else meta.shadowed_files
    return bundles.pack([*bundles.snapshot(folder, METADATA).files, *own])
