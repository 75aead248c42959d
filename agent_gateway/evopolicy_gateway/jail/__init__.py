"""The agent's jail: which files of this machine an agent's programs see, and which hosts they reach.

Rules:
- A program sees its workspace, the system, its own installation and the operator's additions; nothing of the cluster.
- Its network namespace has no route. It reaches other hosts only through listening sockets that it sends to its agent
  supervisor at its start: the gateway's port, and a proxy that permits the harness's hosts.
- The jail is never dropped silently: if it cannot be built the run is refused, and `run.json` records the mode used.
"""
