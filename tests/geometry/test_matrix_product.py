"""Products by blocks: the same numbers, in products so small that BLAS keeps them on one thread."""

from __future__ import annotations

import numpy as np
import pytest

from mgca_filter.geometry import matrix_product
from mgca_filter.geometry.matrix_product import product


@pytest.mark.parametrize(("rows", "inner", "columns"), [(0, 3, 4), (1, 3, 4), (7, 3, 4), (300, 9, 200), (5, 600, 600)])
def test_product_is_that_of_numpy(rows: int, inner: int, columns: int) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(rows, inner)), rng.normal(size=(inner, columns))
    np.testing.assert_allclose(product(a, b), a @ b, rtol=1e-12, atol=1e-12)


def test_blocks_are_small(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes = []

    class Watched(np.ndarray):
        def __matmul__(self, other):
            sizes.append(len(self) * other.size)
            return np.asarray(self) @ other

    monkeypatch.setattr(matrix_product, "_MULTIPLICATIONS", 100)
    product(np.ones((40, 3)).view(Watched), np.ones((3, 10)))
    assert sum(sizes) == 40 * 30
    assert max(sizes) <= 100
