"""Prompts for agents, by turn. The rules themselves are in the workspace's `AGENTS.md`.

An operator may replace each text. `$standard` in a replacement stands for the standard text, and `$left` for the
episodes that are left; `$$` is a dollar sign.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from string import Template

import msgspec

from evopolicy_common.errors import ConfigError, raised_as
from evopolicy_common.regular_files import read_given

FIRST = (
    "Read AGENTS.md in the current directory. It says what to improve, how to submit and what is allowed. Its rules are"
    " binding, above all the rule of the budget where it has one: no local environments, no other simulators, no copied"
    " dynamics or rewards; what you learn of the environment comes from submits. Work until the episode budget is spent"
    " or, where AGENTS.md lets you stop earlier, you cannot improve the policy any further."
)
GO_ON = (
    "You stopped, and $left episodes of the budget are left. Unspent episodes are lost, and every submit is one more"
    " candidate for selection. Go on improving the policy and submit again; the rules in AGENTS.md still hold."
)
NEXT_TURN = "Go on: $left episodes of the budget are left. Answer with stop set to true if you are done."
"""In place of `GO_ON` for a program that speaks the turn protocol."""
_UNKNOWN = "Ask /info for the budget that is left."
_LEFT = "$left episodes of the budget are left."
INTERRUPTED = (
    "Your session was interrupted by a technical failure and goes on here. A submit that was under way was not lost:"
    " look at feedback/ before you submit anything again. {} Go on where you were."
)

STANDARD = {"first": FIRST, "go_on": GO_ON, "interrupted": INTERRUPTED.format(_LEFT)}
"""The standard texts by the fields of `Prompts`."""

_MAX_BYTES = 256 << 10


class Prompts(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The texts of an agent's prompts; by default the standard ones."""

    first: str = "$standard"
    """Of a session's first turn."""
    go_on: str = "$standard"
    """For an agent that stopped with budget left."""
    interrupted: str = "$standard"
    """For a session that resumes after a failure."""

    @property
    def digest(self) -> str:
        """SHA-256, hex, of the texts; empty for the standard ones."""
        return "" if self == Prompts() else hashlib.sha256(msgspec.json.encode(self)).hexdigest()

    def begin(self) -> str:
        return _filled(self.first, FIRST, None)

    def stopped(self, n_left: int | None, standard: str = GO_ON) -> str:
        """Prompt for an agent that stopped with budget left; `n_left` None: unknown."""
        return self.resumed(None) if n_left is None else _filled(self.go_on, standard, n_left)

    def resumed(self, n_left: int | None) -> str:
        """Prompt for an agent whose session resumes after a failure that was not its own."""
        standard = INTERRUPTED.format(_UNKNOWN if n_left is None else _LEFT)
        return _filled(self.interrupted, standard, n_left)

    def check(self, where: str) -> None:
        """Raises ConfigError for an empty text or an unknown placeholder; `where`: how the error begins."""
        for name in self.__struct_fields__:
            check_text(f"{where}: {name}", getattr(self, name), ("standard", *(["left"] * (name != "first"))))


def warned(warning: str | None) -> str:
    """Addition to a prompt if the policy failed in the last submit."""
    return f" In your last submit {warning}" if warning else ""


def left(wall_s: float, n_tokens: int) -> str:
    """Addition to a prompt that says how much is left of the agent's limits."""
    minutes = max(0, round(wall_s / 60.0))
    return f" Left: {minutes // 60} h {minutes % 60:02} min of time, {n_tokens:,} tokens of the model."


def read_text(path: Path) -> str:
    """An operator's text. Raises ConfigError when the file cannot be read, is not UTF-8, or is over 256 KiB."""
    with raised_as(ConfigError, f"{path} is not UTF-8", UnicodeDecodeError):
        return read_given(path, str(path), _MAX_BYTES).decode()


def check_text(where: str, text: str, known: tuple[str, ...]) -> None:
    """Raises ConfigError for a text without content or with a placeholder that is not `known`."""
    template = Template(text)
    if not text.strip():
        raise ConfigError(f"{where} is empty; write $standard for the standard text")
    if not template.is_valid():
        raise ConfigError(f"{where}: a `$` begins no placeholder; write $$ for a dollar sign")
    unknown = [name for name in template.get_identifiers() if name not in known]
    if unknown:
        raise ConfigError(
            f"{where}: unknown placeholder ${unknown[0]}; there are {', '.join(f'${name}' for name in known)},"
            " and $$ is a dollar sign"
        )


def _filled(text: str, standard: str, n_left: int | None) -> str:
    episodes_left = "unknown" if n_left is None else str(n_left)
    return Template(text).substitute(
        standard=Template(standard).substitute(left=episodes_left), left=episodes_left
    )
