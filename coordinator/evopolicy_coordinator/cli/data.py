"""`evopolicy data`: making split files and checking them.

An operator's commands: they read and write hidden cases, so they come with the coordinator's extra and must not be
reachable from an agent's host. Exit codes: 0 all well, 1 findings, 2 wrong usage.
"""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Annotated

import msgspec
import typer

from evopolicy_common import catalogue
from evopolicy_common.catalogue.worlds import unchanged
from evopolicy_common.cli.conventions import fail
from evopolicy_common.cli.frame import App
from evopolicy_common.console import table, terminal
from evopolicy_common.errors import ConfigError, StorageError
from evopolicy_common.messages.environment import Split
from evopolicy_common.messages.run_settings import MAX_HIDDEN
from evopolicy_common.records import splits as split_files
from evopolicy_common.records.blobs import write_atomically
from evopolicy_common.terminal import counted, say
from evopolicy_coordinator import splits, worlds

_Report = tuple[Path, splits.EnvironmentSplits | None, list[str]]
MAX_TRAIN = 1_000_000
"""As many as `--cases` can name."""

app = App(
    name="data",
    help="Make and check the split files of environments (hidden cases: keep them from agents).",
    no_args_is_help=True,
)


@app.command(
    epilog="Example: evopolicy data make --env core16 --root data --train 64 --valid 16 --heldout 32"
)
def make(
    env: Annotated[list[str], typer.Option(help="Suite, suite id or glob; may be repeated.")],
    root: Annotated[Path, typer.Option(help="Folder to write.")],
    seed: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Public seed, from which anyone can derive the cases: the files say `secret:"
            " false`. Default: random bits that are not stored.",
        ),
    ] = None,
    train: Annotated[
        int | None, typer.Option(min=1, max=MAX_TRAIN, help="Train cases [the suite's number].")
    ] = None,
    valid: Annotated[
        int | None, typer.Option(min=1, max=MAX_HIDDEN, help="Validation cases [the suite's number].")
    ] = None,
    heldout: Annotated[
        int | None, typer.Option(min=1, max=MAX_HIDDEN, help="Held-out cases [the suite's number].")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite files that differ.")] = False,
) -> None:
    """Write train.json, valid.json and heldout.json of each environment."""
    planned = _plan(catalogue.resolve(env), root, seed, train, valid, heldout)
    stored = {path: path.read_bytes() for path in planned if path.exists()}
    written = [path for path, data in planned.items() if stored.get(path) != data]
    if not force and (others := [path for path in written if path in stored]):
        raise ConfigError(
            f"{others[0]} exists and differs from what would be written; give --force to replace it"
        )
    try:
        for path in written:
            path.parent.mkdir(parents=True, exist_ok=True)
            write_atomically(path, planned[path], mode=0o600)
    except (OSError, StorageError) as error:
        fail(str(error))
    kept = len(planned) - len(written)
    same = f", {kept} {'was' if kept == 1 else 'were'} the same already" if kept else ""
    say(f"{counted(len(written), 'file')} written under {root}{same}")


def _plan(
    envs: list[str], root: Path, seed: int | None, train: int | None, valid: int | None, heldout: int | None
) -> dict[Path, bytes]:
    secret = secrets.token_bytes(splits.SECRET_BYTES) if seed is None else splits.public_secret(seed)
    planned: dict[Path, bytes] = {}
    for env in envs:
        suite = catalogue.suite_of(env)
        counts: dict[Split, int] = {
            "train": train or suite.n_train,
            "validation": valid or suite.n_validation,
            "heldout": heldout or suite.n_heldout,
        }
        derived = splits.derive(secret, suite.name, env, counts)
        is_world = unchanged(env) != env
        key = worlds.key_of(secret, env, worlds.number_of(env, secret, None)[0]) if is_world else ""
        cases_of = splits.in_world(env, key, derived)
        for split, cases in cases_of.items():
            stem = split_files.FILE_STEMS[split]
            content = split_files.SplitFile(env=env, split=stem, cases=cases, secret=seed is None)
            planned[split_files.folder_of(root, env) / f"{stem}.json"] = (
                msgspec.json.format(msgspec.json.encode(content), indent=1) + b"\n"
            )
    return planned


@app.command(epilog="Example: evopolicy data check data")
def check(
    folder: Annotated[Path, typer.Argument(help="The root of a data tree, or one environment's folder.")],
) -> None:
    """Check that split files are well-formed and disjoint, and print their hashes."""
    if not folder.is_dir():
        fail(f"{folder} is not a folder")
    folders = split_files.folders_below(folder)
    if not folders:
        fail(f"no train.json, valid.json or heldout.json in {folder} or in its folders")
    reports = [_report(item.resolve()) for item in folders]
    _print(reports)
    if any(findings for _, _, findings in reports):
        raise typer.Exit(1)


def _report(folder: Path) -> _Report:
    loaded, findings = splits.load(folder)
    if loaded is not None and loaded.env not in catalogue.entries():
        findings.append(f"{folder.name}: {loaded.env!r} is not in the catalogue")
    return folder, loaded, findings


def _print(reports: list[_Report]) -> None:
    shown = table("environment", "train", "valid", "heldout", "secret", "sha256 of each", "checks")
    for folder, loaded, findings in reports:
        verdict = counted(len(findings), "finding") if findings else "ok"
        if loaded is None:
            shown.add_row(folder.name, "", "", "", "", "", verdict)
            continue
        counts = [str(len(loaded.cases(split))) for split in split_files.SPLITS]
        sha256 = loaded.hashes()
        hashes = " ".join(sha256[split][:8] for split in split_files.SPLITS)
        shown.add_row(loaded.env, *counts, "yes" if loaded.secret else "no", hashes, verdict)
    console = terminal()
    console.print(shown)
    for _, _, findings in reports:
        for finding in findings:
            console.print(finding, style="red", soft_wrap=True)
