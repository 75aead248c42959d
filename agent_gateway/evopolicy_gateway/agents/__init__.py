"""Agents that need no language model. `evolve` is the reference: it behaves as any agent of a run must."""
