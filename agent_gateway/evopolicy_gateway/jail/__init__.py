"""The agent's jail: what an agent's programs see of this machine, and whom they can talk to.

Rules:
- A program sees its workspace, the system, its own installation and what the operator named; nothing of the cluster.
- Its network namespace has no route. What it reaches, it reaches through listening sockets that it hands out to its
  agent supervisor as it starts: the gateway's port, and a proxy that knows the harness's hosts.
- There is no silent way out of it: where it cannot be built the run is refused, and `run.json` says what was used.
"""
