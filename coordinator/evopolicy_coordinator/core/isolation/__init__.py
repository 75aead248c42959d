"""Keeps hidden episodes and agents on different kernels, since a kernel's counters reveal one's activity to the other.

`kernels` lists the occupants of a kernel, `occupancies` how long a lease occupies one, `conflicts` which occupants
exclude each other. The folder `agents` has the permits of agents and the order of precedence.
"""
