"""When another step of a Levenberg–Marquardt search no longer pays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Of the decrease that ends a search.
_WORTH_TRYING = 0.1


def promises(hessian: Array, gradient: Array, step: Array, least: float) -> bool:
    """False where a step would take so little off the cost that it need not be tried.

    Args:
        hessian, gradient: (P, P) and (P,), of half the sum of squares that stands for the cost near by.
        step: (P,).
        least: a decrease of the cost below this ends the search.
    """
    return -float(step @ (2.0 * gradient + hessian @ step)) >= _WORTH_TRYING * least
