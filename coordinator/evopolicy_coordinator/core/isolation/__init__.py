"""Keeps hidden episodes and agents on different kernels, as a kernel's counters tell one what the other does.

`kernels` says what is on a kernel, `occupancies` how long a lease is on one, `conflicts` what keeps
what away. What agents have to do with it, their permits and who goes first, is in `agents`.
"""
