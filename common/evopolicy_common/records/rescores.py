"""`rescore/NAME.json` beside `run.json`: a finished run's checkpoints on further hidden cases.

A re-score is post hoc: it never changes `run.json` or the selection. The file names the run and the hash of the cases,
so that scores of different cases are never compared. Readers skip unknown fields.
"""

from __future__ import annotations

import re
from pathlib import Path

import msgspec

from evopolicy_common.errors import DECODE_ERRORS, ProtocolError
from evopolicy_common.messages.bounds import LARGEST, Int, Many, Named, Number, Text, Word
from evopolicy_common.records.aggregates import mean
from evopolicy_common.regular_files import read_regular

FORMAT = "evopolicy rescore 1"
FOLDER = "rescore"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_MAX_BYTES = 64 << 20


class Rescored(msgspec.Struct, frozen=True, kw_only=True):
    """One checkpoint's episodes, in the order of the cases."""

    submit_index: Int
    returns: Many[Number]
    lengths: Many[Int]
    failures: Named[Text] = {}
    """Position of an episode (decimal text) to the category of the policy's failure in it."""
    successes: Many[bool | None] = ()
    """Whether each episode solved the task, as the environment reports it; None where it reports nothing."""

    @property
    def mean(self) -> float:
        return mean(self.returns)


class RescoreRecord(msgspec.Struct, frozen=True, kw_only=True):
    """The content of `rescore/NAME.json`."""

    format: Word = FORMAT
    name: Word
    run: Word
    """The coordinator's id of the run, as in `run.json`."""
    env: Word
    selected: Int
    """Submit index of the checkpoint that the run's validation selected."""
    n_cases: Int
    cases_hash: Word
    """`sha256:` and the SHA-256 of the cases as canonical JSON."""
    cases_from: Word
    """`secret`: derived from the coordinator's secret; `files`: from a file of the operator."""
    cases_secret: bool
    """False when the cases can be guessed, or come from a file that does not declare them secret."""
    epoch: Word = ""
    """The epoch of the secret that the cases derive from."""
    software: Word = ""
    played_at: Word = ""
    """UTC, ISO 8601."""
    random_returns: Many[Number] = ()
    """Returns of uniform random actions on the same cases."""
    checkpoints: Many[Rescored] = ()

    def checkpoint(self, submit_index: int | None) -> Rescored | None:
        """The episodes of that submit's checkpoint; None when it was not re-scored."""
        return next((each for each in self.checkpoints if each.submit_index == submit_index), None)


_decoder = msgspec.json.Decoder(RescoreRecord)


def is_name(name: str) -> bool:
    """Whether a re-score may have this name: letters, digits, `.`, `_`, `-`, at most 64."""
    return bool(_NAME.fullmatch(name))


def rescore_path(run: Path, name: str) -> Path:
    """`rescore/NAME.json` of a run directory."""
    return run / FOLDER / f"{name}.json"


def rescore_names(run: Path) -> list[str]:
    """The names of a run directory's re-scores, in order."""
    folder = run / FOLDER
    if folder.is_symlink() or not folder.is_dir():
        return []
    return sorted(path.stem for path in folder.glob("*.json") if is_name(path.stem))


def encode_rescore(record: RescoreRecord) -> bytes:
    """The bytes of `rescore/NAME.json`."""
    return msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n"


def read_rescore(run: Path, name: str) -> RescoreRecord | None:
    """The re-score `name` of a run directory; None when there is none. Raises ProtocolError when it is damaged."""
    path = rescore_path(run, name)
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ProtocolError(f"{path} is larger than {_MAX_BYTES >> 20} MiB")
        record = _decoder.decode(read_regular(path))
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ProtocolError(f"{path} cannot be read: {error.strerror}") from error
    except (*DECODE_ERRORS, ValueError) as error:
        raise ProtocolError(f"{path} is not a re-score: {error}") from error
    if record.format != FORMAT:
        raise ProtocolError(f"{path} has format {record.format!r}; this version reads {FORMAT!r}")
    whole = [record.random_returns, *(each.returns for each in record.checkpoints)]
    if record.n_cases < 1 or any(len(returns) != record.n_cases for returns in whole):
        raise ProtocolError(f"{path} does not have {record.n_cases} returns for each checkpoint")
    if any(abs(value) > LARGEST for returns in whole for value in returns):
        raise ProtocolError(f"{path} has a return beyond {LARGEST:g}, which is not plausible")
    places = {place for each in record.checkpoints for place in each.failures}
    if odd := sorted(
        place for place in places if not (place.isascii() and place.isdecimal() and len(place) < 10)
    ):
        raise ProtocolError(f"{path} has a failure of episode {odd[0][:20]!r}, which is no position")
    return record
