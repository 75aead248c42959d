"""Start-up of a worker's child processes: they end with their parent, and talk to it over pipes that no other code
writes to."""

from __future__ import annotations

import os
import signal

from evopolicy_common.processes.parent_death import end_with_parent


def take_pipes() -> tuple[int, int]:
    """Moves standard input and output to new descriptors and returns these: commands, answers.

    From now on standard input is empty, and prints of simulators and drivers go to standard error. Ctrl-C and SIGTERM
    are ignored; the parent handles them, and this process ends with its parent.
    """
    end_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # A batch system sends it to all processes of a job. What is started from here inherits this, and so does a policy,
    # whose failure it would be otherwise.
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    commands, replies = os.dup(0), os.dup(1)
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    os.dup2(2, 1)
    return commands, replies
