"""Points (60, 2) that no camera sees, by what is wrong with them; nothing may raise on them."""

from __future__ import annotations

import numpy as np

HOSTILE_POINTS = {
    "equal": np.full((60, 2), 5.0),
    "nan": np.full((60, 2), np.nan),
    "line": np.column_stack([np.arange(60.0), 2 * np.arange(60.0)]),
    "inf": np.where(np.arange(120).reshape(60, 2) % 7 == 0, np.inf, np.random.default_rng(1).uniform(0, 400, (60, 2))),
    "huge": np.random.default_rng(1).uniform(0, 1e300, (60, 2)),
    "tiny": np.random.default_rng(1).uniform(0, 1e-300, (60, 2)),
}
