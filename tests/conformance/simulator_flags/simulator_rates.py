"""How many disguised simulators are flagged, and how much honest code is:

    python tests/conformance/simulator_flags/simulator_rates.py [--each]

`tuned/` was at hand while the signs were made. `held_out/` was written before them and looked at once, afterwards: what it
misses stays missed. A case is a file, or a folder whose files belong together.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import evopolicy_gateway.agents
from evopolicy_results.simulators.look import look

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


def rate(cases: Iterator[tuple[str, dict[str, bytes]]]) -> Rate:
    found = Rate([], [])
    for name, files in cases:
        (found.flagged if look(files, "") else found.passed).append(name)
    return found


def corpus(part: str, kind: str) -> Iterator[tuple[str, dict[str, bytes]]]:
    """`part` is tuned or held_out, `kind` simulators or honest."""
    for case in sorted((HERE / part / kind).iterdir()):
        if case.name != "__pycache__":
            yield case.name, _files(case)


def examples(*, rehearsing: bool) -> Iterator[tuple[str, dict[str, bytes]]]:
    for case in sorted(EXAMPLES.iterdir()):
        if case.is_dir() and (case.name in REHEARSING) == rehearsing:
            yield case.name, _files(case)


def agents() -> Iterator[tuple[str, dict[str, bytes]]]:
    """The gateway's own agents: all together, as they are, and the policy that `evolve` writes into workspaces."""
    folder = Path(evopolicy_gateway.agents.__file__).parent
    yield "agents", _files(folder)
    yield "evolve's policy", _files(folder / "evolved")


def library() -> Iterator[tuple[str, dict[str, bytes]]]:
    """Gymnasium's small environments without their imports: simulators that nobody wrote for this test."""
    import gymnasium

    envs = Path(gymnasium.__file__).parent / "envs"
    for path in sorted([*(envs / "classic_control").glob("*.py"), *(envs / "toy_text").glob("*.py")]):
        tree = ast.parse(path.read_bytes())
        if any(isinstance(node, ast.FunctionDef) and node.name == "step" for node in ast.walk(tree)):
            yield path.name, {path.name: ast.unparse(_WithoutImports().visit(tree)).encode()}


class _WithoutImports(ast.NodeTransformer):
    def visit_Import(self, node: ast.Import) -> ast.Pass:
        return ast.Pass()

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.Pass:
        return ast.Pass()


def _files(case: Path) -> dict[str, bytes]:
    if case.is_file():
        return {case.name: case.read_bytes()}
    return {path.relative_to(case).as_posix(): path.read_bytes() for path in sorted(case.rglob("*.py"))}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", action="store_true", help="name what was missed or flagged wrongly")
    each = parser.parse_args().each
    rows = [
        ("simulators flagged, tuned", rate(corpus("tuned", "simulators")), True),
        ("simulators flagged, held out", rate(corpus("held_out", "simulators")), True),
        ("examples that rehearse flagged", rate(examples(rehearsing=True)), True),
        ("Gymnasium's small environments flagged", rate(library()), True),
        ("honest code flagged, tuned", rate(corpus("tuned", "honest")), False),
        ("honest code flagged, held out", rate(corpus("held_out", "honest")), False),
        ("other examples flagged", rate(examples(rehearsing=False)), False),
        ("the gateway's agents flagged", rate(agents()), False),
    ]
    for title, found, should in rows:
        wrong = found.passed if should else found.flagged
        print(f"{title:40} {found!s:>9}" + (f"   wrong: {', '.join(wrong)}" if each and wrong else ""))


if __name__ == "__main__":
    main()
