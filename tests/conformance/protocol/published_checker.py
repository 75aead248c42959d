"""Checks a run directory against the published protocol, from `published-protocol.md` beside this file and nothing
else.

Each finding cites the line of that file it rests on. Written without knowledge of the code that writes run directories,
and shares none with it: standard library only.

    python tests/conformance/protocol/published_checker.py RUN_DIRECTORY…
"""

from __future__ import annotations

import ast
import hashlib
import json
import math
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

METADATA = ("_meta.json", "metrics.json")
UNCOUNTED_NAMES = (".keep", *METADATA)
UNCOUNTED_FOLDERS = ("__pycache__", ".pytest_cache", ".mypy_cache", ".ruff_cache")
META_FIELDS = (
    *("schema_version", "submit_index", "submit_time", "n_episodes_requested", "remaining_budget_before"),
    *("remaining_budget_after", "snapshot_size_bytes", "snapshot_files", "import_scan", "validation_status"),
)
METRIC_FIELDS = (
    *("schema_version", "files", "python_files", "bytes", "policy_bytes", "lines", "source_lines", "classes"),
    *("functions", "imports", "import_count", "cyclomatic_total", "cyclomatic_max", "parse_errors"),
    *("test_files", "tree_hash"),
)
TREND_FIELDS = (
    *("submits", "source_lines", "python_files", "functions", "classes"),
    *("cyclomatic_total", "cyclomatic_max", "tree_hash"),
)
ARTIFACTS = ("workspace", "feedback", "checkpoints", "logs_harness", "logs_agent", "logs_env")
VERSIONS = (*("harness", "env", "agents_md_hash", "data_train_hash", "data_valid_hash", "data_heldout_hash"),)
SUMMARY_ARRAYS = ("returns", "episode_lengths", "timeouts", "errors")
SUMMARY_AGGREGATES = ("mean_return", "std_return", "min_return", "max_return", "mean_episode_length")
INLINE_BYTES = 4096


def check_run(root: Path) -> list[str]:
    """All findings of a finished run's directory, each with the line it rests on; empty when it conforms."""
    return list(_run(root))


# ---- run.json and the tree ----


def _run(root: Path) -> Iterator[str]:
    for name in (
        *("run.json", "workspace/AGENTS.md", "logs/harness.log", "logs/agent.jsonl", "logs/env.log"),
    ):
        if not (root / name).is_file():
            yield f"line 17: {name} is missing"
    for name in ("workspace/system", "workspace/feedback", "checkpoints"):
        if not (root / name).is_dir():
            yield f"line 17: {name}/ is missing"
    run = _json(root / "run.json")
    if not isinstance(run, dict):
        yield "line 23: run.json is no object"
        return
    if run.get("schema_version") != "0.1":
        yield f'line 23: run.json schema_version is {run.get("schema_version")!r}, not "0.1"'
    yield from _timing(run)
    yield from _versions(root, run)
    yield from _artifacts(root, run)
    submits = _numbered(root / "workspace" / "feedback")
    checkpoints = _numbered(root / "checkpoints")
    summaries = {index: folder for index, folder in submits.items() if (folder / "summary.json").is_file()}
    # A rejected request may have a folder; it has no checkpoint.
    charged = {
        index: folder
        for index, folder in summaries.items()
        if (_json(folder / "summary.json") or {}).get("n_episodes", 1)
    }
    if checkpoints.keys() != charged.keys():
        yield (
            f"line 17: checkpoints of submits {sorted(checkpoints)}, charged submits {sorted(charged)}:"
            " one for every charged submit"
        )
    for index, folder in summaries.items():
        yield from _summary(folder, index)
    for index, folder in checkpoints.items():
        summary = _json(charged[index] / "summary.json") if index in charged else None
        yield from _checkpoint(folder, index, summary)
    yield from _outcome(root, run, checkpoints)


def _timing(run: dict[str, Any]) -> Iterator[str]:
    timing = run.get("timing")
    if not isinstance(timing, dict):
        yield "line 23: run.json timing is no object"
        return
    for name in ("start_time", "end_time"):
        if not isinstance(timing.get(name), str):
            yield f"line 23: timing.{name} is {timing.get(name)!r}, not a text"
    wall = timing.get("wall_time_seconds")
    if isinstance(wall, bool) or not isinstance(wall, int | float) or not 0 <= wall < math.inf:
        yield f"line 23: timing.wall_time_seconds is {wall!r}"


def _versions(root: Path, run: dict[str, Any]) -> Iterator[str]:
    versions = run.get("versions")
    if not isinstance(versions, dict):
        yield "line 24: run.json versions is no object"
        return
    for name in VERSIONS:
        value = versions.get(name)
        if not isinstance(value, str) or not value:
            yield f"line 24: versions.{name} is {value!r}, not a text"
        elif name.endswith("_hash") and not _is_digest(value):
            yield f"line 24: versions.{name} is {value!r}, not sha256: and 64 hexadecimal digits"
    rules = root / "workspace" / "AGENTS.md"
    if rules.is_file() and versions.get("agents_md_hash") != _digest(rules.read_bytes()):
        yield "line 24: versions.agents_md_hash is not the digest of workspace/AGENTS.md"


def _artifacts(root: Path, run: dict[str, Any]) -> Iterator[str]:
    artifacts = run.get("artifacts")
    if not isinstance(artifacts, dict):
        yield "line 24: run.json artifacts is no object"
        return
    for name in ARTIFACTS:
        if name not in artifacts:
            yield f"line 24: artifacts.{name} is missing"
    for name, value in artifacts.items():
        if not isinstance(value, str):
            yield f"line 24: artifacts.{name} is {value!r}, not a text"
        elif PurePosixPath(value).is_absolute() or ".." in PurePosixPath(value).parts:
            yield f"line 24: artifacts.{name} is {value!r}, not a relative path inside the run"
        elif not (root / value).exists():
            yield f"line 24: artifacts.{name} names {value!r}, which is not there"


def _outcome(root: Path, run: dict[str, Any], checkpoints: dict[int, Path]) -> Iterator[str]:
    outcome = run.get("outcome")
    if not isinstance(outcome, dict):
        yield "line 23: run.json outcome is no object"
        return
    best = outcome.get("best_submit_index")
    if outcome.get("status") == "no_ok_submit":
        if outcome.get("final_score") != 0.0 or outcome.get("val_scores") is not None:
            yield "line 24: no_ok_submit has final_score 0.0 and val_scores null"
    elif outcome.get("status") == "completed":
        if best not in checkpoints:
            yield f"line 18: best_submit_index {best!r} has no checkpoint"
        else:
            yield from _selected(root / "workspace" / "system", checkpoints[best])
    auxiliary = outcome.get("auxiliary")
    if not isinstance(auxiliary, dict):
        yield "line 23: outcome.auxiliary is no object"
        return
    metrics = {index: _json(folder / "metrics.json") for index, folder in checkpoints.items()}
    by_submit = auxiliary.get("code_metrics_by_submit")
    if by_submit != {str(index): found for index, found in metrics.items()}:
        yield "line 23: code_metrics_by_submit is not every checkpoint's metrics by its index as a text"
    wanted = metrics.get(best) if best is not None else None
    if auxiliary.get("code_metrics_best") != wanted:
        yield "line 23: code_metrics_best is not the best checkpoint's metrics"
    yield from _trend(auxiliary.get("code_metrics_trend"), metrics)


def _selected(system: Path, checkpoint: Path) -> Iterator[str]:
    theirs = {name: data for name, data in _files(checkpoint).items() if name not in METADATA}
    if _files(system) != theirs:
        yield "line 18: workspace/system differs from the best checkpoint without its metadata"


def _trend(trend: Any, metrics: dict[int, Any]) -> Iterator[str]:
    if not isinstance(trend, dict):
        yield "line 24: code_metrics_trend is no object"
        return
    indexes = sorted(metrics)
    for name in TREND_FIELDS:
        want = indexes if name == "submits" else [(metrics[index] or {}).get(name) for index in indexes]
        if trend.get(name) != want:
            yield f"line 24: code_metrics_trend.{name} is not its values in submit order"


# ---- submits ----


def _summary(folder: Path, index: int) -> Iterator[str]:
    where = f"feedback/{folder.name}/summary.json"
    summary = _json(folder / "summary.json")
    if not isinstance(summary, dict):
        yield f"line 25: {where} is no object"
        return
    if summary.get("schema_version") != "0.1":
        yield f'line 25: {where} schema_version is {summary.get("schema_version")!r}, not "0.1"'
    if summary.get("submit_index") != index:
        yield f"line 25: {where} has submit_index {summary.get('submit_index')!r}"
    ids = summary.get("env_instances")
    if not isinstance(ids, list) or not all(type(each) is int for each in ids):
        yield f"line 25: {where} env_instances is not the expanded list"
    if summary.get("status") == "ok":
        returns = summary.get("returns")
        if not isinstance(returns, list) or not isinstance(ids, list) or len(returns) != len(ids):
            yield f"line 25: {where} has not one return for each of env_instances"
        yield from _episodes(folder)
        return
    if summary.get("status") == "rollout_timeout" and summary.get("returns") is not None:
        for name in ("mean_return", "std_return"):
            if summary.get(name, "missing") is not None:
                yield f"{where} has failed episodes and {name} is {summary.get(name)!r}, not null"
        return
    for name in ("first_global_episode", *SUMMARY_ARRAYS, *SUMMARY_AGGREGATES):
        if summary.get(name, "missing") is not None:
            yield f"line 25: {where} is not ok and {name} is {summary.get(name)!r}, not null"


def _episodes(folder: Path) -> Iterator[str]:
    for episode in sorted((folder / "episodes").glob("ep_*")):
        where = f"{folder.name}/{episode.name}"
        rows = [json.loads(line) for line in (episode / "trajectory.jsonl").read_text("utf-8").splitlines()]
        if any("steps" not in (row.get("info") or {}) for row in rows):
            yield f"line 13: {where} has a row whose info has no steps"
        external = any((episode / name).is_file() for name in ("observations.npy", "observations.npz"))
        if external and any(row.get("obs") is not None for row in rows):
            yield f"line 12: {where} stores observations outside and in its rows"
        if not external and any(row.get("obs") is None for row in rows):
            yield f"line 12: {where} has no observations"


def _checkpoint(folder: Path, index: int, summary: Any) -> Iterator[str]:
    where = f"checkpoints/{folder.name}"
    meta, metrics = _json(folder / "_meta.json"), _json(folder / "metrics.json")
    if not isinstance(meta, dict) or not isinstance(metrics, dict):
        yield f"line 17: {where} lacks _meta.json or metrics.json"
        return
    for name in META_FIELDS:
        if name not in meta:
            yield f"line 19: {where}/_meta.json has no {name}"
    if meta.get("submit_index") != index:
        yield f"line 19: {where}/_meta.json has submit_index {meta.get('submit_index')!r}"
    if isinstance(summary, dict) and meta.get("validation_status") != summary.get("status"):
        yield f"line 19: {where}/_meta.json validation_status is not the summary's status"
    if isinstance(summary, dict) and meta.get("remaining_budget_after") != summary.get("remaining_budget"):
        yield f"line 19: {where}/_meta.json remaining_budget_after is not the summary's"
    for name in METRIC_FIELDS:
        if name not in metrics:
            yield f"line 20: {where}/metrics.json has no {name}"
    recomputed = code_metrics(folder)
    for name, value in recomputed.items():
        if name in metrics and metrics[name] != value:
            yield f"line 20: {where}/metrics.json {name} is {metrics[name]!r}, recomputed {value!r}"


# ---- code metrics ----


def code_metrics(folder: Path) -> dict[str, Any]:
    """The published metrics of the files in a folder (lines 20 to 22)."""
    files = {
        name: data
        for name, data in _files(folder).items()
        if PurePosixPath(name).name not in UNCOUNTED_NAMES
        and not set(PurePosixPath(name).parts[:-1]) & set(UNCOUNTED_FOLDERS)
    }
    python = {name: data for name, data in files.items() if name.endswith(".py")}
    texts = {name: data.decode("utf-8", "replace") for name, data in python.items()}
    lines = [line for text in texts.values() for line in text.splitlines()]
    trees: list[ast.Module] = []
    errors: list[str] = []
    for name, text in sorted(texts.items()):
        try:
            trees.append(ast.parse(text))
        except (SyntaxError, ValueError):
            errors.append(name)
    complexities = [each for tree in trees for each in _complexities(tree)]
    imports = sorted({name for tree in trees for name in _imports(tree)})
    tree_hash = hashlib.sha256()
    for name, data in sorted(files.items()):
        tree_hash.update(name.encode() + b"\0" + data + b"\0")
    return {
        "schema_version": "0.1",
        "files": len(files),
        "python_files": len(python),
        "bytes": sum(map(len, files.values())),
        "policy_bytes": len(files.get("policy.py", b"")),
        "lines": len(lines),
        "source_lines": sum(1 for line in lines if line.strip() and not line.strip().startswith("#")),
        "classes": sum(isinstance(node, ast.ClassDef) for tree in trees for node in ast.walk(tree)),
        "functions": sum(_is_function(node) for tree in trees for node in ast.walk(tree)),
        "imports": imports,
        "import_count": len(imports),
        "cyclomatic_total": sum(complexities),
        "cyclomatic_max": max(complexities, default=0),
        "parse_errors": errors,
        "test_files": sum(PurePosixPath(name).name.startswith("test_") for name in python),
        "tree_hash": f"sha256:{tree_hash.hexdigest()}",
    }


def _is_function(node: ast.AST) -> bool:
    return isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)


def _complexities(tree: ast.Module) -> list[int]:
    functions = [node for node in ast.walk(tree) if _is_function(node)]
    return [_complexity(node) for node in functions or [tree]]


def _complexity(root: ast.AST) -> int:
    total = 1
    for node in ast.walk(root):
        if isinstance(node, ast.If | ast.For | ast.AsyncFor | ast.While | ast.IfExp | ast.ExceptHandler):
            total += 1
        elif isinstance(node, ast.BoolOp):
            total += len(node.values) - 1
        elif isinstance(node, ast.Try | ast.TryStar):
            total += len(node.handlers)
        elif isinstance(node, ast.comprehension):
            total += len(node.ifs)
        elif isinstance(node, ast.Match):
            total += len(node.cases)
    return total


def _imports(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0 and node.module:
            yield node.module.partition(".")[0]


# ---- files ----


def _numbered(folder: Path) -> dict[int, Path]:
    """`submit_NNN` folders by their number."""
    found = folder.glob("submit_*") if folder.is_dir() else ()
    return {
        int(each.name.removeprefix("submit_")): each
        for each in sorted(found)
        if each.name.removeprefix("submit_").isdecimal()
    }


def _files(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.is_symlink()
    }


def _json(path: Path) -> Any:
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError):
        return None


def _digest(data: bytes) -> str:
    return f"sha256:{hashlib.sha256(data).hexdigest()}"


def _is_digest(value: str) -> bool:
    digits = value.removeprefix("sha256:")
    return value.startswith("sha256:") and len(digits) == 64 and set(digits) <= set("0123456789abcdef")


def main(folders: Iterable[str]) -> int:
    """Prints the findings of each folder; exit code 1 when there are any."""
    failed = False
    for folder in folders:
        findings = check_run(Path(folder))
        failed = failed or bool(findings)
        print(f"{folder}: {len(findings)} findings")
        for finding in findings:
            print(f"  {finding}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
