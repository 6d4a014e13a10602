"""Pairs without overlap: what the one image shows, the other one does not."""

from __future__ import annotations

from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import pytest

from mgca_filter.data.source import read_image
from mgca_filter.export import pairs_apart
from mgca_filter.export.pairs_apart import PairApart, crop, lists_of, parts_of_photographs, plausible_camera
from mgca_filter.features import create_detector
from mgca_filter.training.worlds.truth import visible_share
from mgca_filter.training.worlds.visibility import see


@pytest.fixture
def ramps(tmp_path: Path) -> Path:
    """Photographs that grow brighter along their longer side, from 0 to 250: a pixel tells where it comes from."""
    ramp = np.repeat(np.round(np.linspace(0, 250, 400)).astype(np.uint8)[None], 240, axis=0)
    for number, image in enumerate((ramp, ramp.T, ramp, ramp.T)):
        cv2.imwrite(str(tmp_path / f"{number}.png"), image)
    return tmp_path


def test_the_parts_of_a_photograph_have_a_gap_between_them(ramps: Path) -> None:
    pairs = list(parts_of_photographs(ramps, 9, seed=0))
    assert {pair.place for pair in pairs} == {"0", "1", "2", "3"}
    for pair in pairs:  # turned or not
        one, two = pair.images
        assert int(two.min()) - int(one.max()) >= 0.75 * pairs_apart._GAP * 250
        assert min(one.size, two.size) > 0.4 * 3 * 240 * 400


def test_a_part_keeps_the_rays_of_the_photograph(ramps: Path) -> None:
    pair = next(parts_of_photographs(ramps, 1, seed=0))  # the first is not turned
    whole = plausible_camera(read_image(ramps / f"{pair.place}.png").shape[1::-1])
    corner = np.array([np.array(read_image(ramps / f"{pair.place}.png").shape[1::-1]) - pair.images[1].shape[1::-1]])[0]
    ray = np.linalg.inv(whole) @ [corner[0] + 7.0, corner[1] + 9.0, 1.0]
    np.testing.assert_allclose(np.linalg.inv(pair.K[1]) @ [7.0, 9.0, 1.0], ray)
    np.testing.assert_allclose(pair.K[0], whole)


def test_every_second_photograph_is_turned(ramps: Path) -> None:
    pairs = list(parts_of_photographs(ramps, 4, seed=0))
    for number, pair in enumerate(pairs):
        height, width = pair.images[1].shape[:2]
        centred = np.allclose(pair.K[1][:2, 2], [(width - 1) / 2, (height - 1) / 2])
        assert centred == (number % 2 == 1)
        assert (pair.images[1] > 0).all()  # no black edge


def test_a_turned_part_shows_the_same_rays_elsewhere() -> None:
    image = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 256, (200, 300), dtype=np.uint8), (0, 0), 4)
    K = np.array([[300.0, 0.0, -40.0], [0.0, 300.0, 90.0], [0.0, 0.0, 1.0]])
    turned, K2 = pairs_apart._turned(image, K, np.zeros(3))
    np.testing.assert_allclose(turned[99:101, 149:151].mean(), image[99:101, 149:151].mean(), atol=1.5)
    # 30 degrees from the middle of the one lie 30 degrees from the middle of the other.
    other, _ = pairs_apart._turned(image, K, np.radians([0.0, 10.0, 0.0]))
    shift = 300 * np.tan(np.radians(10.0))
    seen = other[99:101, round(149.5 + shift) - 1 : round(149.5 + shift) + 2].mean()
    assert seen == pytest.approx(image[99:101, 148:152].mean(), abs=3.0)
    assert K2[0, 0] == K[0, 0]


def test_crop_moves_the_principal_point() -> None:
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    part, K = crop(image, plausible_camera((4, 3)), (1, 2, 3, 3))
    np.testing.assert_array_equal(part, [[9, 10]])
    np.testing.assert_allclose(K[:2, 2], [0.5, -1.0])


def test_rendered_views_see_nothing_of_each_other() -> None:
    for seed in range(3):
        world, cameras = pairs_apart._draw_scene_apart(np.random.default_rng(seed))
        one, two = (camera.shrunk(1 / 3) for camera in cameras)
        seen = see(world, one), see(world, two)
        assert visible_share(one, two, *seen) < 1e-3
        assert visible_share(two, one, *seen[::-1]) < 1e-3


def test_what_is_drawn_depends_on_the_seed_alone(ramps: Path) -> None:
    for source in (pairs_apart.parts_of_photographs, pairs_apart.rendered_apart):
        first, other = next(source(ramps, 1, 5)), next(source(ramps, 1, 6))
        again = next(islice(source(ramps, 3, 5), 1))
        np.testing.assert_array_equal(first.images[1], again.images[1])
        assert len(list(source(ramps, 2, 5))) == 2
        assert first.images[1].shape != other.images[1].shape or (first.images[1] != other.images[1]).any()


def test_lists_are_all_matches_and_the_filtered_ones() -> None:
    noise = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    image = cv2.resize(noise, (320, 240), interpolation=cv2.INTER_CUBIC)
    camera, dist = plausible_camera((320, 240)), np.array([0.1, 0.0, 0.0, 0.0])
    pair = PairApart("wall", (image, np.roll(image, 20, axis=1)), (camera, camera), (dist, None))
    lists = dict(lists_of(pair, create_detector("sift", 300)))
    assert list(lists) == ["raw", "cross and ratio"]
    raw, filtered = lists["raw"], lists["cross and ratio"]
    assert 20 < len(filtered.kp1) < len(raw.kp1)
    assert raw.attributes is not None
    assert filtered.attributes is not None
    assert filtered.attributes.ratio.max() < pairs_apart.CROSS_RATIO < raw.attributes.ratio.max()
    assert filtered.attributes.best.all()
    assert not raw.attributes.best.all()
    assert filtered.attributes.size1 is not None
    assert len(filtered.attributes.size1) == len(filtered.kp1)
    assert raw.dist1 is dist
    assert raw.dist2 is None
    assert raw.size1 == (320, 240)
    flat = np.zeros((240, 320), dtype=np.uint8)
    assert not list(lists_of(PairApart("fog", (flat, image), (camera, camera)), create_detector("sift", 300)))
