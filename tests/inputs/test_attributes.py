"""The network's inputs: encoded attributes, candidates, normalised points."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mgca_filter.geometry.cameras import mean_focal_length, normalize_points
from mgca_filter.inputs.attributes import MatchAttributes, candidate_mask


def test_unknown_groups_are_zero() -> None:
    assert not MatchAttributes().encode(5).any()


def test_known_groups_are_encoded_in_their_columns() -> None:
    attributes = MatchAttributes(
        ratio=np.array([0.5, np.nan], dtype=np.float32),
        best=np.array([True, False]),
        size1=np.array([2.0, 2.0], dtype=np.float32),
        size2=np.array([4.0, 2.0], dtype=np.float32),
        angle1=np.array([10.0, -1.0], dtype=np.float32),
        angle2=np.array([100.0, 20.0], dtype=np.float32),
    )
    expected = [[0.5, 1, 1, 0, 1, 1, 1, 1], [0, 0, 0, 0, 0, 0, 1, 0]]
    np.testing.assert_allclose(attributes.encode(2), expected, atol=1e-6)


@given(st.lists(st.floats(width=32), min_size=1, max_size=10))
def test_encoding_is_finite_whatever_comes_in(values: list[float]) -> None:
    column = np.array(values, dtype=np.float32)
    attributes = MatchAttributes(column, None, column, column[::-1], column, column[::-1])
    assert np.isfinite(attributes.encode(len(values))).all()


def noise_of(size1: list[float], size2: list[float], valid: list[int] | None = None) -> np.ndarray:
    sizes = (np.array(size1, dtype=np.float32), np.array(size2, dtype=np.float32))
    known = MatchAttributes(size1=sizes[0], size2=sizes[1])
    return known.relative_noise(np.ones(len(size1), bool) if valid is None else np.array(valid, bool))


def test_noise_follows_the_size_of_keypoints_whatever_its_unit() -> None:
    sizes = [2.0, 2.0, 2.0, 4.0]
    expected = [1, 1, 1, 2**0.75]
    np.testing.assert_allclose(noise_of(sizes, sizes), expected)
    np.testing.assert_allclose(noise_of([31 * s for s in sizes], [31 * s for s in sizes]), expected, rtol=1e-6)
    np.testing.assert_allclose(noise_of([2, 2, 2, 2], [2, 2, 2, 4])[3], 2.5**0.375, rtol=1e-6)
    # Matches without usable coordinates do not tell what is usual.
    np.testing.assert_allclose(noise_of([2, 4, 4, 4], [2, 4, 4, 4], [1, 0, 0, 0]), [1, *[2**0.75] * 3])


def test_noise_has_limits_and_is_usual_where_sizes_are_unknown() -> None:
    np.testing.assert_allclose(noise_of([2, 2, 2, 900, 0.01], [2, 2, 2, 900, 0.01]), [1, 1, 1, 3, 0.4])
    odd = [2.0, np.nan, 0.0, -1.0, np.inf]
    np.testing.assert_array_equal(noise_of(odd, [2.0] * 5), 1.0)
    np.testing.assert_array_equal(noise_of(odd, odd, [0] * 5), 1.0)
    np.testing.assert_array_equal(MatchAttributes().relative_noise(np.ones(3, bool)), 1.0)


def encoded(count: int, hopeless: int) -> np.ndarray:
    ratio = np.where(np.arange(count) < hopeless, 0.97, 0.6).astype(np.float32)
    return MatchAttributes(ratio=ratio, best=np.ones(count, dtype=bool)).encode(count)


def test_hopeless_matches_are_no_candidates_unless_few_remain() -> None:
    assert candidate_mask(encoded(100, 60)).sum() == 40
    assert candidate_mask(encoded(100, 80)).all()
    assert candidate_mask(encoded(100, 80), min_count=10).sum() == 20
    assert candidate_mask(encoded(100, 60), max_ratio=0.98).all()


def test_candidates_need_to_be_known_to_be_hopeless() -> None:
    attributes = encoded(100, 60)
    attributes[:, 6] = 0
    assert candidate_mask(attributes).all()


def test_normalisation_inverts_the_projection_with_skew() -> None:
    K = np.array([[700.0, 3.0, 320.0], [0.0, 650.0, 240.0], [0.0, 0.0, 1.0]])
    points = np.random.default_rng(0).uniform(-1, 1, (20, 2))
    pixels = np.column_stack([points, np.ones(20)]) @ K.T
    np.testing.assert_allclose(normalize_points(pixels[:, :2], K), points, atol=1e-12)
    assert mean_focal_length(K, K) == 675.0


def test_selection_takes_every_known_field() -> None:
    taken = MatchAttributes(ratio=np.array([0.1, 0.2], dtype=np.float32)).take(np.array([1]))
    assert taken.ratio is not None
    assert taken.ratio.tolist() == [np.float32(0.2)]
    assert taken.best is None
