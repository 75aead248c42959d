"""Stages the workspace once, before the agent starts: `AGENTS.md`, `system/policy.py`, `feedback/`."""

from __future__ import annotations

from evopolicy_common.messages.gateway import RunOpened
from evopolicy_common.records.blobs import digest_of, write_atomically
from evopolicy_common.records.run_record import PROTOCOL_VERSION
from evopolicy_gateway.run_folder.layout import RunFolder, Staged, save, saved
from evopolicy_gateway.workspace.agents_md import NO_URLS, Urls, agents_md
from evopolicy_gateway.workspace.initial_policy import initial_policy


def variables(folder: RunFolder) -> dict[str, str]:
    """Variables of an agent's process other than the URLs, named as published."""
    return {
        "EVOPOLICYGYM_WORKSPACE": str(folder.workspace),
        "EVOPOLICYGYM_SYSTEM": str(folder.system),
        "EVOPOLICYGYM_FEEDBACK": str(folder.feedback),
        "EVOPOLICYGYM_AGENTS": str(folder.agents_md),
        "EVOPOLICYGYM_PROTOCOL": PROTOCOL_VERSION,
    }


def stage(folder: RunFolder, run: RunOpened, urls: Urls, text: str = "") -> Staged:
    """Creates the workspace of `run`; leaves an existing one unchanged.

    `AGENTS.md` gets mode 0444. `text`: as for `agents_md`. Raises StorageError when the disk refuses.
    """
    if folder.staged.exists():
        return saved(folder.staged, Staged)
    folder.system.mkdir(parents=True, exist_ok=True)
    folder.feedback.mkdir(exist_ok=True)
    path, started = folder.system / "policy.py", folder.start.exists()
    if not started:
        write_atomically(path, initial_policy(run.env.action_space).encode())
    policy = path.read_bytes() if path.exists() else b""  # a start's submit may have been without a policy
    rules = agents_md(run, urls, text, started=started).encode()
    write_atomically(folder.agents_md, rules, mode=0o444)
    staged = Staged(
        agents_md_hash=digest_of(agents_md(run, NO_URLS, text, started=started).encode()),
        agents_md_file_hash=digest_of(rules),
        initial_policy_hash=digest_of(policy),
        n_train=run.n_env_instances,
        min_episodes_per_submit=run.min_episodes_per_submit,
        max_episodes_per_submit=run.max_episodes_per_submit,
    )
    save(folder.staged, staged)
    return staged
