"""`evolve`: the reference agent. Improves a parametrised policy within the run's budget, without a language model.

It uses only what every agent may use: `/info`, `/task`, `/submit` and the feedback files. Run as
`python -m evopolicy_gateway.agents.evolve` in the workspace, with the `EVOPOLICYGYM_*` URLs set.

One submit evaluates a whole population, one candidate per episode, since the policy receives the episode's index. The
last submits have one candidate each: they are the checkpoints for the hidden validation, which plays every episode of a
checkpoint, whatever its index.
"""
