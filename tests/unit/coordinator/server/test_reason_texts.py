"""The core's codes and the shell's words for them belong together."""

from __future__ import annotations

import ast
import inspect
import string
from pathlib import Path

import pytest

import evopolicy_coordinator.core
from evopolicy_common.messages import gateway
from evopolicy_common.messages.operator import RunProgress
from evopolicy_common.messages.worker import Refused
from evopolicy_common.refusals import Refusal
from evopolicy_coordinator.core.contract.effects import Refuse, Reply
from evopolicy_coordinator.core.contract.reasons import REFUSALS, because
from evopolicy_coordinator.server.reason_texts import TEXTS, message, reason_text

CORE = Path(evopolicy_coordinator.core.__file__).parent


def given() -> list[tuple[str, set[str]]]:
    """Codes that the core's rules give, each with the names of its arguments."""
    found = []
    for path in sorted(CORE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = node.func.id if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) else ""
            if isinstance(node, ast.Call) and name in ("because", "NotDoneError"):
                about = {keyword.arg or "" for keyword in node.keywords}
                found += [
                    (each.value, about) for each in ast.walk(node.args[0]) if isinstance(each, ast.Constant)
                ]
    return found


def test_every_code_has_words_and_is_given_somewhere() -> None:
    assert set(REFUSALS) < set(TEXTS) == {code for code, _ in given()}


@pytest.mark.parametrize(("code", "about"), given())
def test_words_name_exactly_what_a_reason_is_about(code: str, about: set[str]) -> None:
    text = TEXTS[code]
    if isinstance(text, str):
        wanted = {name for _, name, _, _ in string.Formatter().parse(text) if name}
    else:
        wanted = set(inspect.signature(text).parameters)
    assert about == wanted - {"state"}


def test_why_an_environment_failed_is_told_to_operators_alone() -> None:
    """Attack: fails its try-out with an error that tells an agent of the machine's files and code.
    Defence: agents learn on which worker it failed; only operators get the reason, of at most 2,000
    characters, and 64 KiB for all of a worker."""
    about = {"env": "my/x", "tier": "bwrap", "same_versions": False, "away": (), "connected": True}
    why = 'step 3: it raised KeyError: 7; File "/home/me/secret.py", line 3'
    waits = because("workers", lacking=(), failed=(("lab-1", why), ("lab-2", "another")), **about)
    for_agents = "a worker that offers my/x with sandbox tier bwrap; it failed on lab-1, lab-2"
    assert reason_text(waits) == for_agents
    progress = message(Reply(request=1, message=RunProgress(phase="open", done=0, total=1), waits_for=waits))
    assert isinstance(progress, RunProgress)
    assert (progress.waits_for, progress.env_failure) == (f"{for_agents}: {why}", why)
    permit = message(Reply(request=1, message=gateway.Permit(granted=False), waits_for=waits))
    assert isinstance(permit, gateway.Permit)
    assert permit.waits_for == for_agents


def test_a_refusal_is_answered_with_its_status_and_words() -> None:
    text = message(Refuse(request=1, reason=because("busy", submit=3)))
    assert text == Refused(status=Refusal.BUSY, message="submit 3 is still running; one runs at a time")


def test_a_runs_state_names_its_open_submits_wait() -> None:
    state = gateway.RunState(remaining_budget=1, n_submits=1, is_finalized=False, n_done=2)
    text = message(Reply(request=1, message=state, waits_for=because("scoring")))
    assert isinstance(text, gateway.RunState)
    assert text.waits_for == "hidden cases of another run to be scored"
    assert text.n_done == 2
