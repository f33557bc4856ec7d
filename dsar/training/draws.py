"""What is left to chance in an update, so that it does not depend on who computes it."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Draws:
    """Random numbers of one update: each rollout, or frame of the template, has its own.

    So any number of workers that share a batch draw the same.
    """

    seed: int
    """The run's."""
    step: int
    """Number of the update."""
    worker: int = 0
    """Number of the worker; all have equally many."""

    def generators(self, count: int) -> list[np.random.Generator]:
        """Return the generators of this worker's share, so many rollouts or frames."""
        first = self.worker * count
        return [
            np.random.default_rng([self.seed, number, self.step]) for number in range(first, first + count)
        ]
