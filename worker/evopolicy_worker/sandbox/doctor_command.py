"""`evopolicy doctor`: checks the whole machine, and prints what works without each missing part."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from evopolicy_common.cli.frame import App
from evopolicy_common.console import filled_table, terminal
from evopolicy_common.terminal import say, say_json
from evopolicy_worker.sandbox.doctor import Check, best_tier, examine
from evopolicy_worker.sandbox.machine import examine_machine

app = App(name="doctor")


@app.command("doctor", epilog="Example: evopolicy doctor")
def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="Print the checks as JSON.")] = False,
) -> None:
    """Check this machine, and print the remedy for each missing part.

    Exit code 0 if runs can be played here in a sandbox, 1 if not.
    """
    checks = examine_machine()
    linux = sys.platform == "linux"
    checks += examine() if linux else (_no_worker(),)
    tier = best_tier(checks)
    plays = tier is not None and not any(
        check.name.startswith("extra") and check.verdict == "missing" for check in checks
    )
    if as_json:
        say_json({"plays": plays, "tier": tier, "checks": checks})
    else:
        rows = [
            (each.name, each.verdict, each.found, "" if each.verdict == "ok" else each.without, each.advice)
            for each in checks
        ]
        terminal().print(filled_table(("check", "verdict", "found", "works without it", "remedy"), rows))
        say(_next(tier) if plays else "runs cannot be played here yet: see the rows that say missing")
    raise typer.Exit(0 if plays else 1)


def _next(tier: str | None) -> str:
    if tier == "bwrap":
        return "next: evopolicy demo"
    return (
        "next: mend the row tier bwrap, which agents' jails need too; or give up the jail by name:"
        f" evopolicy local --env gym/continuouscar --agent evolve --tier {tier} --jail none"
    )


def _no_worker() -> Check:
    return Check(
        "sandbox",
        "missing",
        f"this is {sys.platform}; the sandbox is made of Linux namespaces",
        without="coordinator, agents on another machine's workers, and reports",
        advice="use Linux or WSL2 for workers",
    )
