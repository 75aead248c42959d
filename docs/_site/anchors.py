"""Measures random actions and the policy of this repository in Core16 and an environment of every family, and
writes both into the catalogue: `python docs/_site/anchors.py [ID…]`.

The cases are drawn by the environment's name, so that nobody chose them. Episodes are whole, played in this
process, without sandbox or limits. Without ids it measures those that have no anchor yet. It also writes the table of
docs/reference/environments.md.
"""

from __future__ import annotations

import hashlib
import math
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np

TOP = Path(__file__).parents[2]
sys.path[:0] = [str(TOP / "examples"), str(TOP / "tests" / "support")]

import proofs  # noqa: E402
from measure_policies import POLICIES, play, play_all  # noqa: E402

from evopolicy_common import catalogue  # noqa: E402
from evopolicy_common.catalogue import Anchor, Measured, installs  # noqa: E402
from evopolicy_common.statistics.intervals import over_cases  # noqa: E402
from evopolicy_worker.environments.interface.base import Environment  # noqa: E402
from evopolicy_worker.environments.registry import make  # noqa: E402

FILE = TOP / "common" / "evopolicy_common" / "catalogue" / "anchors.json"
PAGE = TOP / "docs" / "reference" / "environments.md"
MARKS = ("<!-- Written by docs/_site/anchors.py. -->", "<!-- End of what anchors.py writes. -->")
N_CASES = 32


def policies() -> dict[str, Path]:
    """The folder of each environment's policy, Core16 first."""
    core16 = catalogue.suites()["core16"].environments
    folders = {env_id: catalogue.policy_folder(POLICIES, env_id) for env_id in core16}
    return folders | {each.env: each.policy for each in proofs.table()}


def cases(env_id: str) -> list[int]:
    """Seeds."""
    drawn = (hashlib.sha256(f"anchor {env_id} {k}".encode()).digest()[:4] for k in range(N_CASES))
    return [int.from_bytes(each, "big") >> 1 for each in drawn]


class Uniform:
    """Random actions."""

    def __init__(self, environment: Environment, seed: int) -> None:
        self._codec, self._rng = environment.action_codec, np.random.default_rng(seed)

    def reset(self, episode_index: int) -> None:
        pass

    def act(self, obs: object) -> object:
        return self._codec.sample(self._rng)


def measured(returns: list[float]) -> Measured:
    values = np.array(returns)
    interval = over_cases(values, (values[None, :],))
    low, high = (None if each is None else round(each, 5) for each in (interval.low, interval.high))
    return Measured(mean=round(interval.value, 5), low=low, high=high)


def measure(env_id: str, folder: Path) -> Anchor:
    environment = make(env_id)
    most = catalogue.entry(env_id).published_steps or environment.description.max_episode_steps or sys.maxsize
    seeds = cases(env_id)
    random = [play(environment, Uniform(environment, seed), seed, most)[0] for seed in seeds]
    best = [each[0] for each in play_all(environment, folder, seeds, most)]
    environment.close()
    where = str(folder.relative_to(TOP))
    return Anchor(random=measured(random), best=measured(best), cases=N_CASES, policy=where)


def write(env_id: str, anchor: Anchor) -> None:
    """Adds or replaces one anchor, in the order of `policies`."""
    known = msgspec.json.decode(FILE.read_bytes(), type=dict[str, Anchor]) | {env_id: anchor}
    ordered = {each: known[each] for each in policies() if each in known}
    FILE.write_bytes(msgspec.json.format(msgspec.json.encode(ordered), indent=1) + b"\n")


def table() -> str:
    """The table of all anchors, as Markdown."""

    def cell(one: Measured) -> str:
        if one.low is None or one.high is None:
            return f"{one.mean:.4g}"
        half = (one.high - one.low) / 2
        if abs(one.mean - one.low - half) > half / 100:
            return f"{one.mean:.4g} ({one.low:.4g} to {one.high:.4g})"
        digits = max(0, 1 - math.floor(math.log10(half)))
        return f"{one.mean:.{digits}f} ± {half:.{digits}f}"

    lines = ["| environment | random (95 % interval) | best known (95 % interval) |", "|---|---|---|"]
    for env_id, each in catalogue.anchors().items():
        link = f"[{cell(each.best)}](../../{each.policy}/policy.py)"
        lines.append(f"| {env_id} | {cell(each.random)} | {link} |")
    return "\n".join(lines)


def written(page: str) -> str:
    """The page with the table between its marks."""
    before, rest = page.split(MARKS[0])
    return f"{before}{MARKS[0]}\n\n{table()}\n\n{MARKS[1]}{rest.split(MARKS[1])[1]}"


def main(ids: list[str]) -> None:
    divided = installs.divided(ids)
    for env_id in divided.pop(sys.executable, []):
        anchor = measure(env_id, policies()[env_id])
        write(env_id, anchor)
        print(env_id, anchor.random.mean, anchor.best.mean, flush=True)
    for python, elsewhere in divided.items():
        subprocess.run([python, __file__, *elsewhere], check=True)
    catalogue.anchors.cache_clear()
    PAGE.write_text(written(PAGE.read_text("utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:] or [each for each in policies() if each not in catalogue.anchors()])
