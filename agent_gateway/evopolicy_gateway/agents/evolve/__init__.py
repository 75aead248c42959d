"""`evolve`: the reference agent. Improves a parametrised policy under the run's budget, with no language model.

It knows what every agent may know: `/info`, `/task`, `/submit` and the feedback files. Run as
`python -m evopolicy_gateway.agents.evolve` in the workspace, with the `EVOPOLICYGYM_*` URLs set.

One submit plays a whole population, a candidate an episode, since the policy is told the episode's index. The last
submits hold one candidate each: those are the checkpoints meant for the hidden validation, which plays every episode
of a checkpoint, whatever its index.
"""
