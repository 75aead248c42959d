"""The console scripts before their program begins."""

from __future__ import annotations

import resource

from program_runs import run_python

LIMIT_BYTES = 60_000 << 10


def test_too_little_address_space_is_one_line_with_the_remedy() -> None:
    program = "import sys; sys.argv[0] = 'evopolicy'; from evopolicy_common import entry; entry.evopolicy()"
    words = ("local", "--env", "toy/line", "--agent", "evolve")
    limits = (LIMIT_BYTES, LIMIT_BYTES)
    done = run_python(program, *words, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_AS, limits))
    (line,) = done.stderr.splitlines()
    assert done.returncode == 2
    assert line.startswith("error: a limit of 60,000 KiB on address space (ulimit -v) is too low: ")
    assert line.endswith("; give: ulimit -v unlimited")
