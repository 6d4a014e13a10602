"""What points may come as: the layouts that OpenCV takes, and coordinates that no camera sees."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

# From pixels (N, 2) float64.
LAYOUTS: dict[str, Callable[[np.ndarray], Any]] = {
    "float32": np.float32,
    "N1": lambda p: p[:, None],
    "1N": lambda p: p[None],
    "list": lambda p: p.tolist(),
    "int": lambda p: np.round(p).astype(int),
}
# (60, 2), by what is wrong with them; nothing may raise on them.
HOSTILE_POINTS = {
    "equal": np.full((60, 2), 5.0),
    "nan": np.full((60, 2), np.nan),
    "line": np.column_stack([np.arange(60.0), 2 * np.arange(60.0)]),
    "inf": np.where(np.arange(120).reshape(60, 2) % 7 == 0, np.inf, np.random.default_rng(1).uniform(0, 400, (60, 2))),
    "huge": np.random.default_rng(1).uniform(0, 1e300, (60, 2)),
    "tiny": np.random.default_rng(1).uniform(0, 1e-300, (60, 2)),
}
