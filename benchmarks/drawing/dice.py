"""What is drawn of a campaign, from its seed and number."""

from typing import Any

import numpy as np

CHANCE_OF_A_FLAW = 0.08
"""How often something is imperfect on purpose."""


class Dice:
    """Draws of one campaign."""

    def __init__(self, seed: int, number: int) -> None:
        self.generator = np.random.default_rng([seed, number])

    def between(self, low: float, high: float) -> float:
        """Return a number whose logarithm is uniform."""
        return float(np.exp(self.generator.uniform(np.log(low), np.log(high))))

    def uniform(self, low: float, high: float) -> float:
        """Return a uniform number."""
        return float(self.generator.uniform(low, high))

    def one_of(self, *choices: Any) -> Any:
        """Return one of some values."""
        return choices[int(self.generator.integers(len(choices)))]

    def chance(self, of: float) -> bool:
        """Return true as often as asked."""
        return bool(self.generator.random() < of)
