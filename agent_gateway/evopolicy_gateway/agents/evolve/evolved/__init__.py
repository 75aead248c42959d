"""The policy that `evolve` writes into a workspace: a copy of this folder, plus a `candidates.json`.

It imports only the standard library and numpy, and names no environment: a policy's behaviour follows from the two
spaces and its candidate's numbers.
"""
