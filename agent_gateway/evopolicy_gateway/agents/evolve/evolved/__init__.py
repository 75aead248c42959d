"""The policy that `evolve` writes into a workspace: this folder, copied, plus a `candidates.json`.

Nothing here imports anything but the standard library and numpy, and nothing names an environment: what a policy does
follows from the two spaces and from its candidate's numbers.
"""
