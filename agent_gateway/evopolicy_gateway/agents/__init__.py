"""Agents that need no language model. `evolve` is the reference agent."""
