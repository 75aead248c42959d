"""A disk: rows under their keys, written in atomic transactions."""

from __future__ import annotations

from collections.abc import Iterable

from rigs.core_rig import key_of

from evopolicy_common.messages.operator import RunFinished
from evopolicy_coordinator.core.contract.records import (
    BegunRow,
    DocumentRow,
    EvaluationRow,
    JournalRow,
    KernelRow,
    OutcomeRow,
    PermitRow,
    Row,
    RunRow,
    RunStateRow,
    Snapshot,
    SubmitRow,
    WorkerRow,
    evaluation_group,
    head_of,
)

_TABLES: dict[type, str] = {
    RunRow: "runs",
    RunStateRow: "states",
    SubmitRow: "submits",
    BegunRow: "begun",
    RunFinished: "finished",
    EvaluationRow: "evaluations",
    WorkerRow: "workers",
    PermitRow: "permits",
    KernelRow: "kernels",
}


class Disk:
    """The state that survives the coordinator."""

    def __init__(self) -> None:
        self.incarnation = 0
        self.runs: dict[str, RunRow] = {}
        self.states: dict[str, RunStateRow] = {}
        self.submits: dict[tuple[str, int], SubmitRow] = {}
        self.outcomes: dict[str, dict[int, OutcomeRow]] = {}
        self.begun: dict[tuple[str, int], BegunRow] = {}
        self.evaluations: dict[str, EvaluationRow] = {}
        self.finished: dict[str, RunFinished] = {}
        self.workers: dict[str, WorkerRow] = {}
        self.permits: dict[tuple[str, str], PermitRow] = {}
        self.kernels: dict[str, KernelRow] = {}
        self.journal: list[JournalRow] = []

    def admits(self, term: int) -> bool:
        """Whether the coordinator of that incarnation may write: no other has loaded the rows since."""
        return term == self.incarnation

    def write(self, rows: Iterable[Row]) -> None:
        for row in rows:
            if isinstance(row, OutcomeRow):
                self.outcomes.setdefault(row.group, {})[row.index] = row
            elif isinstance(row, JournalRow):
                assert row.seq == len(self.journal), "the journal has no gaps and is never changed"
                self.journal.append(row)
            elif not isinstance(row, DocumentRow):
                _, *key = key_of(row)
                getattr(self, _TABLES[type(row)])[key[0] if len(key) == 1 else tuple(key)] = row

    def outcome(self, group: str, index: int) -> OutcomeRow | None:
        return self.outcomes.get(group, {}).get(index)

    def page(self, group: str, cursor: int, upto: int, most: int) -> list[OutcomeRow]:
        rows = sorted(self.outcomes.get(group, {}).values(), key=lambda row: row.seq)
        return [row for row in rows if cursor <= row.seq < upto][:most]

    def snapshot(self) -> Snapshot:
        """The snapshot to load a core from: heads of unfinished runs and evaluations only, as the contract requires."""
        live = {name for name, state in self.states.items() if state.phase != "finished"}
        groups = {
            evaluation_group(name) for name, evaluation in self.evaluations.items() if not evaluation.finished
        }

        def wanted(group: str) -> bool:
            return group in groups or group.split("/")[0] in live

        heads = [
            head_of(row) for group in self.outcomes if wanted(group) for row in self.outcomes[group].values()
        ]
        return Snapshot(
            incarnation=self.incarnation,
            runs=tuple(self.runs.values()),
            states=tuple(self.states.values()),
            submits=tuple(row for row in self.submits.values() if row.run in live),
            outcomes=tuple(heads),
            begun=tuple(row for row in self.begun.values() if wanted(row.group)),
            evaluations=tuple(self.evaluations.values()),
            workers=tuple(self.workers.values()),
            permits=tuple(row for row in self.permits.values() if row.ended_at is None),
            kernels=tuple(self.kernels.values()),
            journal=self.journal[-1] if self.journal else None,
        )
