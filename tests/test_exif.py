"""The focal length in a photograph's EXIF: read where it is, None where it is not, whatever the bytes."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from exif_files import FOCAL_35MM, FOCAL_MM, ORIENTATION, PIXEL_X, UNIT, X_RESOLUTION, tiff_tags, with_exif

from mgca_filter.exif import exif_intrinsics
from mgca_filter.images import decode_image

JPEG = cv2.imencode(".jpg", np.zeros((30, 40), np.uint8))[1].tobytes()
PHONE = {FOCAL_35MM: 26, FOCAL_MM: 4.25, ORIENTATION: 6}
# A 22.3 mm wide sensor of 5184 pixels, in inches: the 35 mm tag is missing, as in many SLR photographs.
SLR = {FOCAL_MM: 50.0, X_RESOLUTION: 5184 / 22.3 * 25.4, UNIT: 2, PIXEL_X: 5184}


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("size", [(4032, 3024), (3024, 4032), (1008, 756)])
def test_the_equivalent_focal_length_of_a_phone(order: str, size: tuple[int, int]) -> None:
    K = exif_intrinsics(with_exif(JPEG, PHONE, order), size)
    focal = 26 / 35 * max(size)
    np.testing.assert_allclose(K, [[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1]])
    np.testing.assert_array_equal(exif_intrinsics(tiff_tags(PHONE, order), size), K)


@pytest.mark.parametrize(("unit", "mm"), [(2, 25.4), (3, 10.0), (4, 1.0)])
@pytest.mark.parametrize("side", [5184, 1296])
def test_millimetres_and_the_resolution_of_the_sensor(unit: int, mm: float, side: int) -> None:
    tags = SLR | {UNIT: unit, X_RESOLUTION: 5184 / 22.3 * mm}
    K = exif_intrinsics(with_exif(JPEG, tags), (side, side * 2 // 3))
    np.testing.assert_allclose(K[0, 0], 50.0 / 22.3 * side, rtol=1e-4)


def test_the_file_is_still_the_picture() -> None:
    np.testing.assert_array_equal(decode_image(with_exif(JPEG, PHONE)), np.zeros((40, 30, 3), np.uint8))


@pytest.mark.parametrize(
    "tags",
    [
        {},
        {ORIENTATION: 6},
        {FOCAL_MM: 4.25},  # millimetres of an unknown sensor
        {FOCAL_35MM: 0},
        {FOCAL_35MM: 3},  # 160 degrees: no lens that a K describes
        {FOCAL_35MM: 60_000},
        SLR | {UNIT: 1},
        {tag: value for tag, value in SLR.items() if tag != PIXEL_X},
        SLR | {X_RESOLUTION: 0.0},
    ],
)
def test_no_focal_length_is_none(tags: dict[int, float]) -> None:
    assert exif_intrinsics(with_exif(JPEG, tags), (4000, 3000)) is None


@pytest.mark.parametrize("data", [b"", b"\xff\xd8", b"II*\0", JPEG, b"\x89PNG\r\n\x1a\n", bytes(1000), b"\xff" * 1000])
def test_a_file_without_exif_is_none(data: bytes) -> None:
    assert exif_intrinsics(data, (4000, 3000)) is None


def check(data: bytes) -> bool:
    """Nothing raises; returns whether an answer came, which is then one of a lens."""
    K = exif_intrinsics(data, (4000, 3000))
    assert K is None or (np.isfinite(K).all() and 800 < K[0, 0] < 200_000)
    return K is not None


@pytest.mark.parametrize("tags", [PHONE, SLR], ids=["phone", "slr"])
def test_torn_files_do_not_raise(tags: dict[int, float]) -> None:
    whole = with_exif(JPEG, tags)
    found = [check(whole[:length]) for length in range(len(whole))]
    assert found[-1]
    assert not found[20]


def test_damaged_files_do_not_raise() -> None:
    rng = np.random.default_rng(0)
    wholes = [with_exif(JPEG, tags, order) for tags in (PHONE, SLR) for order in "<>"] + [tiff_tags(SLR)]
    answers = 0
    for _ in range(20_000):
        data = bytearray(wholes[rng.integers(len(wholes))][:200])
        for _ in range(rng.integers(1, 5)):
            data[rng.integers(len(data))] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
        answers += check(bytes(data))
    assert answers > 5_000


def test_a_directory_that_is_its_own_exif_directory_ends() -> None:
    entry = struct.pack("<HHII", 0x8769, 4, 1, 8)
    assert not check(b"II*\0" + struct.pack("<IH", 8, 65_535) + entry * 65_535)
