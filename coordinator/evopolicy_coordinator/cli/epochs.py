"""`evopolicy-coordinator epoch`, `evopolicy-coordinator identity`: which cases are still secret, and who signs."""

from __future__ import annotations

import contextlib
from datetime import UTC, datetime
from pathlib import Path

from evopolicy_common.cli.conventions import Json, State
from evopolicy_common.cli.frame import App
from evopolicy_common.console import table, terminal
from evopolicy_common.errors import ConfigError
from evopolicy_common.records import journal
from evopolicy_common.terminal import say, say_json
from evopolicy_common.wire.credentials import default_state_dir, no_state
from evopolicy_coordinator import splits
from evopolicy_coordinator.pki.identity import public_key
from evopolicy_coordinator.storage.engines import place_of
from evopolicy_coordinator.storage.state_folder import StateFolder
from evopolicy_coordinator.storage.store import Reader

_PAGE_BYTES = 1 << 20

app = App(
    help="List epochs, and begin a new one. All runs of an epoch derive their cases from one"
    " secret, which publishing reveals.",
    no_args_is_help=True,
)


@app.command("list", epilog="Example: evopolicy-coordinator epoch list --state /var/lib/evopolicy")
def list_(state: State = None, as_json: Json = False) -> None:
    """List the epochs in the journal, with the number of runs and whether their cases are public."""
    root = state or default_state_dir()
    entries = _journal(root)
    epochs = journal.epochs(map(journal.read_entry, entries))
    current = _current(root)
    head = ([journal.EMPTY_HEAD, *journal.heads(entries)])[-1]
    if as_json:
        say_json({"current": current, "entries": len(entries), "head": head, "epochs": epochs})
        return
    shown = table("epoch", "runs", "finished", "first run", "cases")
    for each in epochs:
        cases = "secret" if each.revealed_at is None else f"public since {_when(each.revealed_at)}"
        name = f"{each.epoch} (current)" if each.epoch == current else each.epoch
        shown.add_row(name, str(each.opened), str(each.ended), _when(each.began_at), cases)
    if current and all(each.epoch != current for each in epochs):
        shown.add_row(f"{current} (current)", "0", "0", "none yet", "secret")
    terminal().print(shown)
    say(f"journal: {len(entries)} {'entry' if len(entries) == 1 else 'entries'}, head {head}")


@app.command(epilog="Example: evopolicy-coordinator epoch new --state /var/lib/evopolicy")
def new(state: State = None) -> None:
    """Begin a new epoch: later runs get a new secret, and new cases. Stop the coordinator first.

    Unfinished runs keep their cases. Scores of different epochs are not comparable: their cases differ.
    """
    root = state or default_state_dir()
    if not (root / "identity.json").is_file():
        raise no_state(root, "identity.json")
    with contextlib.closing(StateFolder.open(root)):
        before, after = _current(root), splits.renew_secrets(root)
    say(f"epoch {after} begins" + (f", after {before}" if before else ""))
    say("next: start the coordinator; runs on files (--data) are not concerned")


def identity(state: State = None) -> None:
    """Print the public key that signs this coordinator's published results; made on first use.

    Publish the key in a place that is known to be yours, so that others can pass it to `evopolicy check --identity`.
    """
    root = state or default_state_dir()
    if not root.is_dir():
        raise ConfigError(f"--state {root}: no such state folder")
    say(public_key(root))


def _current(root: Path) -> str:
    """The epoch that the next run with a jailed agent belongs to; empty while there is no secret."""
    if not (root / splits.SECRET).exists():
        return ""
    return journal.epoch_of(splits.load_or_create_secret(root / splits.SECRET))


def _journal(root: Path) -> list[bytes]:
    entries: list[bytes] = []
    with contextlib.closing(Reader(place_of(root))) as reader:
        while page := reader.journal(len(entries), _PAGE_BYTES):
            entries += [row.entry for row in page]
    return entries


def _when(at: float) -> str:
    return datetime.fromtimestamp(at, UTC).strftime("%Y-%m-%d %H:%M")
