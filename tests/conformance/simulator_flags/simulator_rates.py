"""How many disguised simulators are flagged, and how much honest code:

    python tests/conformance/simulator_flags/simulator_rates.py

The cases of `held_out/` were written before any rule. A case is a file, or a folder whose files belong together. Each
is searched as code of each environment whose numbers are known. The command names the cases that it misses or flags
wrongly.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import evopolicy_gateway.agents
from evopolicy_results.scan.code import DYNAMICS, code_signals

HERE = Path(__file__).parent
EXAMPLES = HERE.parents[2] / "examples" / "policies"
REHEARSING = (
    "gym_acrobot",
    "gym_continuouscar",
    "gym_reacher5",
    "gymnasium_parking-v0",
    "gymnasium_roundabout-v0",
)
"""Examples that play strategies in a model of the environment: simulators by the rule, and by their own words."""


class Rate(NamedTuple):
    flagged: list[str]
    passed: list[str]

    def __str__(self) -> str:
        return f"{len(self.flagged)} of {len(self.flagged) + len(self.passed)}"


def rate(cases: Iterator[Path]) -> Rate:
    found = Rate([], [])
    for case in cases:
        paths = [case] if case.is_file() else sorted(case.rglob("*.py"))
        files = {path.name: path.read_bytes() for path in paths}
        kinds = {one.kind for env in DYNAMICS for one in code_signals(0, files, env)}
        (found.flagged if "simulator" in kinds else found.passed).append(case.name)
    return found


def held_out(kind: str) -> Rate:
    """`kind` is `simulators` or `honest`."""
    return rate(case for case in sorted((HERE / "held_out" / kind).iterdir()) if case.name != "__pycache__")


def examples(*, rehearsing: bool) -> Rate:
    cases = (case for case in sorted(EXAMPLES.iterdir()) if case.is_dir())
    return rate(case for case in cases if (case.name in REHEARSING) == rehearsing)


def agents() -> Rate:
    """The gateway's own agents: all together, and the policy that `evolve` writes into workspaces."""
    folder = Path(evopolicy_gateway.agents.__file__).parent
    return rate(iter((folder, folder / "evolve" / "evolved")))


def main() -> None:
    for title, found, should in (
        ("disguised simulators flagged", held_out("simulators"), True),
        ("examples with a model flagged", examples(rehearsing=True), True),
        ("honest code flagged", held_out("honest"), False),
        ("other examples flagged", examples(rehearsing=False), False),
        ("the gateway's agents flagged", agents(), False),
    ):
        wrong = found.passed if should else found.flagged
        print(f"{title:32} {found!s:>9}" + (f"   wrong: {', '.join(wrong)}" if wrong else ""))


if __name__ == "__main__":
    main()
