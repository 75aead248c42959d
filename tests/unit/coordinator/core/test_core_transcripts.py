"""The core's worked examples: what it is told, which rules act, what it asks of its shell.

A transcript is a list of steps, parted by empty lines: a comment, what happens, `----`, and what comes of it. The lines
under
`----` are compared with what the core does; `pytest --rewrite-transcripts` writes them anew.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rigs.core_rig import Rig

import evopolicy_coordinator.core
from evopolicy_common.messages import worker as wire
from evopolicy_coordinator.core import machine
from evopolicy_coordinator.core.contract.effects import Effect, Log, Persist, Refuse, Reply
from evopolicy_coordinator.core.tables import step

FOLDER = Path(evopolicy_coordinator.core.__file__).parent / "transcripts"

SHOWN = {
    "SubmitRow": ("run", "submit_index", "status", "remaining_budget", "released", "mean_return"),
    "OutcomeRow": ("group", "index", "seq", "attempt", "worker"),
    "RunStateRow": ("run", "phase", "fingerprint_class"),
    "RunRow": ("run", "budget"),
    "KernelRow": ("worker", "boot_id"),
    "PermitRow": ("run", "boot_id"),
    "ReadResults": ("run", "submit_index", "cursor", "upto"),
    "SubmitAccepted": ("submit_index", "first_global_episode", "remaining_budget"),
    "HandInReply": ("n",),
}
"""The shown fields of rows and messages; of others, only the name is shown."""


class Transcript(Rig):
    """Does what a transcript's lines say, and writes down what comes of it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.lines: list[str] = []
        self._sessions: dict[str, str] = {}
        self._leases: dict[str, wire.Lease] = {}
        self._askers: dict[Any, str] = {}
        for message, rule in machine.EVENTS.items():
            monkeypatch.setitem(machine.EVENTS, message, self._noted(message.__name__, rule))
        for timer, rule in machine.TIMERS.items():
            monkeypatch.setitem(machine.TIMERS, timer, self._noted(f"deadline {timer}", rule))
        for (kind, of), rules in machine.NEWS.items():
            noted = tuple(self._noted(f"news {kind.__name__} {of}".rstrip(), rule) for rule in rules)
            monkeypatch.setitem(machine.NEWS, (kind, of), noted)
        super().__init__()
        self.lines.clear()

    def _noted(self, what: str, rule: machine.Rule) -> machine.Rule:
        def noted(state: Any, news: Any, this: step.CoreStep) -> None:
            about = f" {news}" if isinstance(news, str) else ""  # whom a deadline is about
            name = f"{rule.__module__.removeprefix('evopolicy_coordinator.core.')}.{rule.__name__}"
            self.lines.append(f"{what}{about} → {name}")
            rule(state, news, this)

        return noted

    def do(self, line: str) -> str:
        """The lines of the transcript that follow from one line."""
        self.lines.clear()
        verb, *words = shlex.split(line)
        plain = [word for word in words if "=" not in word]
        options = dict(word.split("=", 1) for word in words if "=" in word)
        doing: dict[str, Callable[..., None]] = {
            "register": self._register,
            "create": self._create,
            "lease-poll": self._lease_poll,
            "submit": self._submit,
            "results-poll": self._results_poll,
            "hand-in": self._report_results,
            "pass": lambda seconds: self.pass_time(float(seconds)),
        }
        doing[verb](*plain, **options)
        due = self.core.next_deadline()
        self.lines.append("no deadline" if due is None else f"next deadline in {due - self.now:.1f} s")
        return "\n".join(self.lines)

    def _asks(self, who: str) -> None:
        self._askers[self._requests + 1] = who

    def _register(self, worker: str, slots: str) -> None:
        self._askers[self._requests + 2] = f"{worker}'s registration"
        self._sessions[worker] = self.register(worker, slots=int(slots))

    def _create(self, run: str, budget: str) -> None:
        self._asks(f"the creation of {run}")
        self._askers[self._requests + 2] = f"{run}'s permit"
        self.create(run, budget=int(budget))

    def _lease_poll(self, worker: str, n: str, wait_s: str) -> None:
        self._asks(f"{worker}'s lease poll")
        self.poll(self._sessions[worker], int(n), float(wait_s))

    def _submit(self, run: str, *cases: str, key: str) -> None:
        self._asks(f"{run}'s submit")
        self.submit(*(int(case) for case in cases), run=run, key=key)

    def _results_poll(self, run: str, cursor: str, wait_s: str) -> None:
        self._asks(f"{run}'s results poll")
        self.results(cursor=int(cursor), wait_s=float(wait_s), run=run)

    def _report_results(self, worker: str, *jobs: str, value: str) -> None:
        self._asks(f"{worker}'s hand-in")
        self.play(self._sessions[worker], *(self._leases[job] for job in jobs), value=float(value))

    def _carry_out(self, effects: list[Effect]) -> None:
        for effect in effects:
            self.lines += self._shown(effect)
            if isinstance(effect, Reply) and isinstance(effect.message, wire.Leases):
                self._leases |= {lease.job.job_id: lease for lease in effect.message.leases}
        super()._carry_out(effects)

    def _shown(self, effect: Effect) -> list[str]:
        match effect:
            case Persist():
                return ["persist", *(f"    {shown(row)}" for row in effect.rows)]
            case Reply():
                return [f"reply to {self._askers[effect.request]}: {shown(effect.message)}"]
            case Refuse():
                about = ", ".join(f"{name}={value}" for name, value in effect.reason.about.items())
                return [
                    f"refuse {self._askers[effect.request]}: {effect.status}, {effect.reason.code}({about})"
                ]
            case Log():
                fields = " ".join(f"{name}={value}" for name, value in effect.fields.items())
                return [f"log {effect.event} {fields}"]
            case _:
                asker = self._askers.get(getattr(effect, "request", None), "")
                return [f"{shown(effect)}" + (f" for {asker}" if asker else "")]


def shown(value: Any) -> str:
    """A row, a message or an effect in a line."""
    name = type(value).__name__
    if isinstance(value, wire.Leases):
        leases = ", ".join(f"{lease.job.job_id} attempt {lease.attempt}" for lease in value.leases) or "none"
        return f"Leases({leases})"
    fields = ((field, getattr(value, field)) for field in SHOWN.get(name, ()))
    return f"{name}({', '.join(f'{field}={content}' for field, content in fields if content is not None)})"


def replayed(text: str, transcript: Transcript) -> str:
    """The transcript as it comes out now."""
    blocks = []
    for block in text.strip().split("\n\n"):
        command = block.partition("\n----")[0]
        if all(line.startswith("#") for line in command.splitlines()):
            blocks.append(command)
            continue
        (line,) = [line for line in command.splitlines() if not line.startswith("#")]
        blocks.append(f"{command}\n----\n{transcript.do(line)}")
    return "\n\n".join(blocks) + "\n"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.txt")), ids=lambda path: path.stem)
def test_a_transcript_tells_what_the_core_does(
    path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> None:
    text = path.read_text(encoding="utf-8")
    now = replayed(text, Transcript(monkeypatch))
    if request.config.getoption("--rewrite-transcripts"):
        path.write_text(now, encoding="utf-8")
    else:
        assert now == text, "if this is meant, run pytest with --rewrite-transcripts"


def test_there_are_transcripts_of_a_submit_and_of_a_result_report() -> None:
    assert {"submit", "result_report"} <= {path.stem for path in FOLDER.glob("*.txt")}
