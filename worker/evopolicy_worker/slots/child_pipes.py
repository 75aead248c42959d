"""How a worker's child processes begin: they end with their parent, and talk to it where nothing else can talk."""

from __future__ import annotations

import os
import signal

from evopolicy_common.processes.parent_death import end_with_parent


def take_pipes() -> tuple[int, int]:
    """What standard input and output were, as descriptors of this process's own: commands and answers.

    From now on standard input is empty, and what simulators and drivers print goes to standard error. Ctrl-C is left to
    the parent, whose end is this process's.
    """
    end_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    commands, answers = os.dup(0), os.dup(1)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    return commands, answers
