"""The submits of a run directory, open or finished, each with its feedback's summary and its checkpoint's metadata.

Rules that this module owns: a file is read when it is asked for, within a limit, and by no link; an error names it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path

from evopolicy_common.errors import ProtocolError, raised_as
from evopolicy_common.records.policies.checkpoints import CheckpointMeta, read_meta
from evopolicy_common.records.run_record import Artifacts
from evopolicy_common.records.summary import Summary, decode_summary
from evopolicy_common.regular_files import MAX_BYTES, Confined, Name

_SUBMIT = re.compile(r"submit_([0-9]{3,9})")


class SubmitFiles:
    def __init__(self, run: Confined, index: int, feedback: str, checkpoint: str, most: int) -> None:
        """`feedback` and `checkpoint`: its folders, relative to the run; `most`: bytes of a summary."""
        self.index = index
        """By the name of its folders."""
        self.feedback = run.root / feedback
        """Whether or not it exists, as `checkpoint`."""
        self.checkpoint = run.root / checkpoint
        self._run = run
        self._summary = f"{feedback}/summary.json"
        self._most = most

    @cached_property
    def summary(self) -> Summary | None:
        """None without one. Raises ProtocolError when it cannot be read."""
        try:
            return decode_summary(self._run.whole(self._summary, self._most))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ProtocolError(f"{self._summary} cannot be read: {error.strerror}") from error
        except ProtocolError as error:
            raise ProtocolError(f"{self._summary}: {error}") from error

    @cached_property
    def meta(self) -> CheckpointMeta | None:
        """The checkpoint's metadata; None without any. Raises ProtocolError when they cannot be read."""
        with raised_as(ProtocolError, self.checkpoint.relative_to(self._run.root), ProtocolError):
            return read_meta(self.checkpoint)

    @property
    def status(self) -> str:
        """Its verdict; empty where no file has it."""
        if self.summary is not None:
            return self.summary.status
        return "" if self.meta is None else self.meta.validation_status

    @property
    def bundle(self) -> str:
        """Digest of its bundle, from the metadata; empty where they have none."""
        return "" if self.meta is None else self.meta.bundle

    @property
    def n_episodes(self) -> int:
        if self.summary is not None:
            return self.summary.n_episodes
        return 0 if self.meta is None else self.meta.n_episodes_requested


def read_submits(
    folder: Path, artifacts: Artifacts | None = None, *, names: int = 1 << 20, size: int = MAX_BYTES
) -> list[SubmitFiles]:
    """The submits with a folder for their feedback or their checkpoint, by index. Links are left out. `names`: limit
    of entries of a folder; `size`: of a summary, bytes."""
    known, run = artifacts or Artifacts(), Confined(folder)
    feedback = Path(known.workspace or "workspace", "feedback").as_posix()
    checkpoints = Path(known.checkpoints or "checkpoints").as_posix()
    shown, kept = (_numbered(run.names(place, names)) for place in (feedback, checkpoints))
    return [
        SubmitFiles(
            run, index, f"{feedback}/{shown.get(index, name)}", f"{checkpoints}/{kept.get(index, name)}", size
        )
        for index, name in sorted({**kept, **shown}.items())
    ]


def _numbered(names: Iterable[Name]) -> dict[int, str]:
    """The names `submit_NNN` of folders by their number. NNN has three digits or more."""
    submits = [
        (match, each.name) for each in names if each.is_folder and (match := _SUBMIT.fullmatch(each.name))
    ]
    # Of several spellings of one number, the shortest.
    submits.sort(key=lambda each: -len(each[1]))
    return {int(match[1]): name for match, name in submits}
