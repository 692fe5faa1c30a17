"""Random draws of the parameters of a campaign, from its seed and number."""

from typing import Any

import numpy as np

CHANCE_OF_A_FLAW = 0.08
"""Probability of each intentional flaw."""


class Dice:
    """Random draws of one campaign."""

    def __init__(self, seed: int, number: int) -> None:
        self.generator = np.random.default_rng([seed, number])

    def between(self, low: float, high: float) -> float:
        """Draw a log-uniformly distributed number."""
        return float(np.exp(self.generator.uniform(np.log(low), np.log(high))))

    def uniform(self, low: float, high: float) -> float:
        """Draw a uniformly distributed number."""
        return float(self.generator.uniform(low, high))

    def one_of(self, *choices: Any) -> Any:
        """Draw one of the given values."""
        return choices[int(self.generator.integers(len(choices)))]

    def chance(self, of: float) -> bool:
        """Draw True with a given probability."""
        return bool(self.generator.random() < of)
