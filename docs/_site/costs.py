"""Measures the processor time of a step of every environment, and writes it into its row: `python docs/_site/costs.py
[ID…]`.

For machines without other work: a row that was measured with more work than cores is marked with `*`. Without ids it
measures those that have no times. `python docs/_site/families.py` then writes the families' medians.
"""

from __future__ import annotations

import asyncio
import subprocess
import sys
from pathlib import Path

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_worker.check_env import COLUMNS, bare_loop, in_a_slot

PAGES = sorted((Path(__file__).parents[1] / "reference" / "environments").glob("*.md"))
FIRST = COLUMNS.index("CPU µs, bare")


def rows() -> dict[str, list[str]]:
    """The cells of each played environment, by id."""
    split = (line.strip("|").split("|") for page in PAGES for line in page.read_text("utf-8").splitlines())
    cells = ([cell.strip() for cell in row] for row in split)
    return {row[0].strip("`"): row for row in cells if len(row) == len(COLUMNS) and row[0].startswith("`")}


def write(env_id: str, times: tuple[str, str]) -> None:
    """Puts both times into the rows of an environment, which may stand on several pages."""
    for page in PAGES:
        lines = page.read_text("utf-8").splitlines()
        for number, line in enumerate(lines):
            if line.startswith(f"| `{env_id}` |"):
                cells = [cell.strip() for cell in line.strip("|").split("|")]
                cells[FIRST : FIRST + 2] = times
                lines[number] = f"| {' | '.join(cells)} |"
        page.write_text("\n".join(lines) + "\n", encoding="utf-8")


def main(ids: list[str]) -> None:
    """Measures these environments, each with the interpreter that has its packages."""
    divided = installs.divided(ids)
    with bare_loop(()) as bare:
        for env_id in divided.pop(sys.executable, []):
            cost = asyncio.run(in_a_slot(env_id, (), bare))
            print(env_id, *cost.times(), cost.fault, flush=True)
            if not cost.fault:
                write(env_id, cost.times())
    for python, elsewhere in divided.items():
        subprocess.run([python, __file__, *elsewhere], check=True)


if __name__ == "__main__":
    main(
        catalogue.resolve(sys.argv[1:])
        if sys.argv[1:]
        else [each for each, row in rows().items() if not row[FIRST]]
    )
