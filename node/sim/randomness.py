"""Random numbers that depend on their arguments only, so that all processes get the same ones in any order."""

from __future__ import annotations

import math
import zlib

import numpy as np


def generator(seed: int, stream: str, node: int = 0, index: int = 0) -> np.random.Generator:
    """Return the generator of (seed, stream, node, time index): the same arguments give the same numbers."""
    return np.random.default_rng((seed, zlib.crc32(stream.encode()), node, index))


class Sway:
    """A smooth wandering value: a sum of sinusoids with random periods and phases.

    It is at most 1 in size, with the standard deviation `sd`. It is a function of time, so two processes agree on it.
    """

    def __init__(self, rng: np.random.Generator, shortest_s: float, longest_s: float, components: int = 3) -> None:
        steps = (np.arange(components) + rng.uniform(0.1, 0.9, components)) / components
        periods_s = shortest_s * (longest_s / shortest_s) ** steps
        weights = rng.uniform(0.5, 1.0, components) * periods_s**0.5
        weights /= weights.sum()
        self._terms = [
            (float(2 * math.pi / period), float(phase), float(weight))
            for period, phase, weight in zip(periods_s, rng.uniform(0, 2 * math.pi, components), weights, strict=True)
        ]
        self.sd = math.sqrt(float((weights**2).sum()) / 2)

    def __call__(self, t_s: float) -> float:
        """Return the value at t_s."""
        return sum(weight * math.sin(omega * t_s + phase) for omega, phase, weight in self._terms)
