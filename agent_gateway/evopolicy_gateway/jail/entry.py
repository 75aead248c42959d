"""Runs inside the jail before the agent's program: listens on loopback ports, sends the sockets out, executes the
program.

`python -I -S entry.py FD PORT,PORT,… PROCESSES PROGRAM…`. FD is a unix socket to the agent supervisor, `-`
where the network is open. PROCESSES is the greatest number of processes, which the kernel counts in this
user namespace; `-` for no limit. A socket stays in the network namespace in which it was created, so the
agent supervisor serves these ports, while the agent has no route out itself.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import sys

LOOPBACK = "127.0.0.1"
BACKLOG = 128


def main(arguments: list[str]) -> None:
    control, ports, processes, program = arguments[0], arguments[1], arguments[2], arguments[3:]
    if control != "-":
        hand_out(int(control), ports)
    if processes != "-":
        resource.setrlimit(resource.RLIMIT_NPROC, (int(processes), int(processes)))
    # Ignored around bubblewrap, so that the program receives the signals before its jail is torn down.
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGPIPE):
        signal.signal(number, signal.SIG_DFL)
    try:
        os.execvp(program[0], program)
    except OSError as error:
        print(f"cannot start {program[0]}: {error.strerror}", file=sys.stderr)
        raise SystemExit(127) from None


def hand_out(control: int, ports: str) -> None:
    """Listens on the ports and sends the sockets to the agent supervisor."""
    listening = []
    for port in ports.split(","):
        sock = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        sock.bind((LOOPBACK, int(port)))
        sock.listen(BACKLOG)
        listening.append(sock)
    with socket.socket(fileno=control) as supervisor:
        socket.send_fds(supervisor, [b"."], [sock.fileno() for sock in listening])
    for sock in listening:
        sock.close()


if __name__ == "__main__":
    main(sys.argv[1:])
