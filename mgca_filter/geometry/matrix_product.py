"""Matrix products that stay on the caller's thread.

OpenBLAS, which numpy's wheels bring, shares large products among one thread a processor, which spin for hundredths of a
second afterwards: a call that gains a tenth of a millisecond by it costs as many processors as there are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# OpenBLAS keeps smaller products on one thread: 65536 times its GEMM_MULTITHREAD_THRESHOLD, which is 4.
_MULTIPLICATIONS = 250_000


def product(a: Array, b: Array) -> Array:
    """``a @ b`` (N, M) of (N, K) and (K, M), by blocks of rows."""
    rows = max(1, _MULTIPLICATIONS // max(b.size, 1))
    if len(a) <= rows:
        return np.asarray(a @ b)
    return np.concatenate([a[first : first + rows] @ b for first in range(0, len(a), rows)])
