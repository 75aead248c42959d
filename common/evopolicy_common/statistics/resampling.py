"""Seeded resampling as weights: row b of a matrix holds how often resample b draws each unit."""

from __future__ import annotations

import itertools
import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

RESAMPLES = 2000
EXACT_UP_TO = 1 << 13
"""Up to this number, all patterns of labels are used; above, a random sample of them."""


@lru_cache(maxsize=8)
def weights(n: int, n_drawn: int, resamples: int, seed: int) -> Floats:
    """(resamples, n): counts of `n_drawn` draws with replacement from `n`, read-only."""
    drawn = np.random.default_rng([seed, n, n_drawn]).multinomial(n_drawn, np.full(n, 1.0 / n), resamples)
    counts: Floats = drawn.astype(np.float64)
    counts.setflags(write=False)
    return counts


@lru_cache(maxsize=8)
def t_weights(n: int, draws: int, seed: int) -> Floats:
    """(draws, n) weights w such that `mean + w @ (values − mean)` is distributed as Student's t with n − 1 degrees of
    freedom about the mean of n values, with its standard error as scale. Values of several variables get a common
    multivariate t. Zeros for n = 1. Read-only."""
    if n == 1:
        return np.zeros((draws, 1))
    generator = np.random.default_rng([13, seed, n])
    drawn: Floats = generator.normal(size=(draws, n))
    drawn /= np.sqrt(n * generator.chisquare(n - 1, size=(draws, 1)))
    drawn.setflags(write=False)
    return drawn


@lru_cache(maxsize=4)
def label_patterns(n_first: int, n_second: int, n_random: int) -> tuple[Floats, bool]:
    """(patterns, n_first + n_second), 1 for the first group, and whether all are there. Read-only."""
    n = n_first + n_second
    exact = math.comb(n, n_first) <= EXACT_UP_TO
    if exact:
        firsts = np.array(list(itertools.combinations(range(n), n_first)))
        counts = np.zeros((len(firsts), n))
        np.put_along_axis(counts, firsts, 1.0, axis=1)
    else:
        order = np.random.default_rng([12, n_first, n_second]).random((n_random, n)).argsort(axis=1)
        counts = (order < n_first).astype(np.float64)
    counts.setflags(write=False)
    return counts, exact
