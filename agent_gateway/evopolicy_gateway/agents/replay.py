"""`replay`: submits given policies one after another, dividing the budget evenly.

Run as `python -m evopolicy_gateway.agents.replay DIR` in the workspace, with the `EVOPOLICYGYM_*` URLs set. A policy is
a folder with a `policy.py` (such as a run's `checkpoints/submit_NNN/`), or with a `system/` that has one (such as a
workspace). DIR is either a policy, or its subfolders are policies, which are submitted in sorted order. If DIR has a
folder named like the environment, with `_` for `/` and `:`, that folder is used instead: so one DIR serves many
environments, such as `examples/policies`. A world without a folder has that of the unchanged environment, and an
environment without one that of its family, such as `gymnasium_MiniGrid`.
"""

from __future__ import annotations

import os
import re
import shutil
import sys
from collections.abc import Collection
from pathlib import Path

from evopolicy_gateway.agents.client import Client, GatewayError, RefusedSubmit, exit_after

METADATA = frozenset({"_meta.json", "metrics.json"})
"""Equals `records.checkpoints.METADATA`; that module is not in an agent's jail, which shows only the agents."""


def policies_in(folder: Path) -> list[Path]:
    """Folders of the policies in `folder`, in the order of their submits."""
    return _policy(folder) or [
        policy for child in sorted(folder.iterdir()) if child.is_dir() for policy in _policy(child)
    ]


def folder_for(folder: Path, env: str) -> Path:
    """The subfolder of `folder` for this environment, or else for the one that it alters, or else for their family
    (the name up to the first hyphen), or else `folder` itself."""
    names = [re.sub(odd, "_", one) for one in (env, re.sub("@w[0-9]+$", "", env)) for odd in ("[/:]", "/")]
    named = (folder / name for name in (*names, names[0].partition("-")[0]))
    return next((own for own in named if own.is_dir()), folder)


def shares(budget: int, n_policies: int, least: int, most: int) -> list[int]:
    """Episodes for each policy, in order: as even as possible, the first ones one more; [] when the budget suffices for
    none.

    With too small a budget the last policies get none; `least` and `most` bound a submit.
    """
    least = max(1, least)
    n_played = min(n_policies, budget // least)
    even, more = divmod(budget, max(n_played, 1))
    return [min(most, even + (index < more)) for index in range(n_played)]


def stage(policy: Path, system: Path) -> None:
    """Replaces `system` by a copy of `policy` without a run's metadata; links stay links, for the service to judge."""
    system.mkdir(exist_ok=True)
    for old in system.iterdir():
        if old.is_dir() and not old.is_symlink():
            shutil.rmtree(old)
        else:
            old.unlink()
    _copy(policy, system, {"__pycache__", *(METADATA if (policy / "_meta.json").exists() else ())})


def _copy(source: Path, target: Path, left_out: Collection[str]) -> None:
    # Not by `shutil.copytree`: it fails on set-id bits of folders that users share, which the jail refuses.
    target.mkdir(exist_ok=True)
    for entry in source.iterdir():
        place = target / entry.name
        if entry.name in left_out:
            continue
        if entry.is_symlink():
            place.symlink_to(os.readlink(entry))
        elif entry.is_dir():
            _copy(entry, place, ("__pycache__",))
        else:
            shutil.copyfile(entry, place)
            place.chmod(entry.stat().st_mode & 0o777)


def submit_all(client: Client, folder: Path, workspace: Path) -> int:
    """Submits all policies and returns the number of accepted submits. Raises GatewayError if the gateway is
    unreachable."""
    info = client.info()
    n_cases = int(info["env_meta"]["n_env_instances"])
    folder = folder_for(folder, str(info["env_meta"]["env"]))
    policies = policies_in(folder)
    if not policies:
        raise GatewayError(f"{folder} holds no policy: neither policy.py nor folders with one")
    plan = shares(
        int(info["state"]["remaining_budget"]),
        len(policies),
        int(info["min_episodes_per_submit"]),
        int(info["max_episodes_per_submit"]),
    )
    # Report the policies that got no episodes.
    for policy in policies[len(plan) :]:
        print(f"{policy}: no budget left", flush=True)
    n_taken = 0
    for policy, n_episodes in zip(policies, plan, strict=False):
        stage(policy, workspace / "system")
        verdict = client.submit([index % n_cases for index in range(n_episodes)])
        if isinstance(verdict, RefusedSubmit):
            print(f"{policy}: refused, {verdict.status}: {verdict.message}", flush=True)
            continue
        n_taken += 1
        print(f"{policy}: {verdict.name} {verdict.status} {verdict.summary.get('mean_return')}", flush=True)
    return n_taken


def _policy(folder: Path) -> list[Path]:
    """The policy that a folder is or holds; none for any other folder."""
    places = (folder, folder / "system")
    return [place for place in places if os.path.lexists(place / "policy.py")][:1]


def main() -> None:
    """Runs the agent in the current directory."""
    exit_after("replay", lambda client: submit_all(client, Path(sys.argv[1]), Path.cwd()))


if __name__ == "__main__":
    main()
