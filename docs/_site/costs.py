"""Measures the processor time of a step of every environment, and writes it onto its page: `python docs/_site/costs.py
[ID…]`.

For machines without other work: a row that was measured with more work than cores is marked with `*`. Without ids it
measures those that have no times. `python docs/_site/families.py` then writes the families' medians.
"""

from __future__ import annotations

import subprocess
import sys

import environments

from evopolicy_common import catalogue
from evopolicy_common.catalogue import installs
from evopolicy_worker.check_env import bare_loop, in_a_slot, tables


def main(ids: list[str]) -> None:
    """Measures these environments, each with the interpreter that has its packages."""
    divided = installs.divided(ids)
    with bare_loop(()) as bare:
        for env_id in divided.pop(sys.executable, []):
            cost = in_a_slot(env_id, (), bare)
            print(env_id, *cost.times(), cost.fault, flush=True)
            if not cost.fault:
                row = f"| `{env_id}` | {' | '.join(cost.times())} |"
                environments.write(None, f"{environments.earlier()}\n{row}")
    for python, elsewhere in divided.items():
        subprocess.run([python, __file__, *elsewhere], check=True)


if __name__ == "__main__":
    played, times = tables(environments.earlier())
    main(catalogue.resolve(sys.argv[1:]) if sys.argv[1:] else [each for each in played if each not in times])
