"""The high part of a camera's clock, sent at intervals as a wrapping counter."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass
class WrappingCounter:
    """Follows a counter from block to block.

    Attributes:
        n_bits: the counter wraps at 2**n_bits.
        max_step_back: smaller steps back are not wraps; cameras mix their words a little.
        last: value of the last word, wraps included; None before the first.
        n_repaired: words that did not fit those around them, for which the one before was taken.
    """

    n_bits: int
    max_step_back: int
    last: int | None = None
    n_repaired: int = 0

    def unwrap(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Add the wraps to the next values (N,) of the counter."""
        if not len(values):
            return values
        values = self._repaired(values)
        last = int(values[0]) if self.last is None else self.last
        previous = np.concatenate(([last % (1 << self.n_bits)], values[:-1]))
        wraps = np.cumsum(values + self.max_step_back < previous) + (last >> self.n_bits)
        unwrapped = values + (wraps << self.n_bits)
        self.last = int(unwrapped[-1])
        return np.asarray(unwrapped, dtype=np.int64)

    def _repaired(self, values: NDArray[np.int64]) -> NDArray[np.int64]:
        """Replace single words that leap out of a steady row: each would be a wrap added for good."""
        before, word, after = values[:-2], values[1:-1], values[2:]
        is_steady = (after >= before) & (after - before <= self.max_step_back)
        is_odd = is_steady & (np.abs(word - before) > self.max_step_back)
        self.n_repaired += int(np.count_nonzero(is_odd))
        repaired: NDArray[np.int64] = values.copy()
        repaired[1:-1] = np.where(is_odd, before, word)
        return repaired
