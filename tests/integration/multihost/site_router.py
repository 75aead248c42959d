"""What `zenohd --config FILE` does, where the binary is not installed: a Zenoh router until SIGTERM."""

from __future__ import annotations

import signal
import sys

import zenoh

if __name__ == "__main__":
    signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    session = zenoh.open(zenoh.Config.from_file(sys.argv[1]))
    print("open", flush=True)
    signal.sigwait([signal.SIGTERM])
    session.close()
