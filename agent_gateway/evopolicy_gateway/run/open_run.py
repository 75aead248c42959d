"""The state that the parts of an open run share: its plan, its times, and the operator's view of it."""

from __future__ import annotations

import msgspec

from evopolicy_common.errors import EvopolicyError
from evopolicy_gateway.run.plan import Plan
from evopolicy_gateway.run.times import Stopwatch
from evopolicy_gateway.run.watch import View
from evopolicy_gateway.run_folder.layout import RunFolder


class RunError(EvopolicyError):
    """The run could not be played to its end; its folder and the message tell how far it came."""


class OpenRun(msgspec.Struct, frozen=True, kw_only=True):
    """One open run."""

    plan: Plan
    run: str
    """Its id at the cluster."""
    stopwatch: Stopwatch
    watch: View

    @property
    def folder(self) -> RunFolder:
        return self.plan.folder

    def note(self, text: str) -> None:
        """Prints a line about the run."""
        self.watch.note(self.plan.name, text)
