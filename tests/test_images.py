"""From the bytes of a file to pixels: depth, orientation, size; and what speaks against a principal point."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from image_files import promising

from mgca_filter.images import decode_image, principal_point_doubt

AS_STORED = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION


@pytest.fixture(scope="module")
def grey() -> np.ndarray:
    noise = np.random.default_rng(0).integers(0, 256, (60, 80), dtype=np.uint8)
    return cv2.GaussianBlur(cv2.resize(noise, (160, 120)), (0, 0), 1.5)


def encoded(image: np.ndarray, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".webp", ".ppm"])
def test_eight_bits_are_those_of_opencv(suffix: str, grey: np.ndarray) -> None:
    colour = np.dstack([grey, grey[::-1], grey[:, ::-1]])
    for flags in (cv2.IMREAD_COLOR, AS_STORED):
        expected = cv2.imdecode(np.frombuffer(encoded(colour, suffix), np.uint8), flags)
        found = decode_image(encoded(colour, suffix), flags)
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_sixteen_bits_that_fill_the_range_give_the_high_byte(suffix: str, grey: np.ndarray) -> None:
    wide = cv2.normalize(grey, None, 0, 255, cv2.NORM_MINMAX)
    found = decode_image(encoded(wide.astype(np.uint16) * 257, suffix))
    np.testing.assert_array_equal(found, np.repeat(wide[:, :, None], 3, axis=2))


@pytest.mark.parametrize(("gain", "offset"), [(4, 0), (16, 0), (5, 7000), (1, 7424), (1, 0)])
def test_sixteen_bits_that_do_not_fill_the_range_are_stretched(gain: int, offset: int, grey: np.ndarray) -> None:
    """10 and 12 bits, a thermal camera, few counts, 8 bits stored in 16: the picture is there, whatever the gain."""
    values = grey.astype(np.uint16) * gain + offset
    values[0, 0], values[5, 5] = 0, 65535  # a dead and a hot pixel
    found = decode_image(encoded(values))
    assert found.dtype == np.uint8
    assert found.shape == (*grey.shape, 3)
    assert found.max() == 255
    assert np.corrcoef(found[10:, 10:, 0].ravel(), grey[10:, 10:].ravel())[0, 1] > 0.999


def test_sixteen_bits_of_one_value_and_of_several_channels() -> None:
    assert not decode_image(encoded(np.full((20, 30), 700, np.uint16))).any()
    colour = np.zeros((64, 64, 3), np.uint16)
    colour[:, :32, 2] = 1000
    found = decode_image(encoded(colour))
    assert found[:, :32].reshape(-1, 3).tolist() == [[0, 0, 255]] * 64 * 32
    assert not found[:, 32:].any()


def test_orientation_is_followed_unless_forbidden(grey: np.ndarray) -> None:
    """EXIF orientation 6: the camera was turned, and the picture is shown a quarter turn clockwise."""
    jpeg = encoded(grey, ".jpg")
    tiff = b"II*\0" + struct.pack("<IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    segment = b"Exif\0\0" + tiff
    turned = jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]
    stored = decode_image(turned, AS_STORED)
    np.testing.assert_array_equal(stored, decode_image(jpeg))
    np.testing.assert_array_equal(decode_image(turned), cv2.rotate(stored, cv2.ROTATE_90_CLOCKWISE))


@pytest.mark.parametrize("data", [b"", b"no image", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0"])
def test_what_is_no_image_is_a_value_error(data: bytes) -> None:
    with pytest.raises(ValueError, match=r"empty|not an image"):
        decode_image(data)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".bmp", ".tiff", ".ppm"])
def test_too_many_pixels_are_a_value_error(suffix: str) -> None:
    with pytest.raises(ValueError, match=r"too large|not an image"):
        decode_image(promising(suffix, 65_000, 65_000))


def camera(f: float, x: float, y: float) -> np.ndarray:
    return np.array([[f, 0, x], [0, f, y], [0, 0, 1.0]])


@pytest.mark.parametrize(
    ("K", "size"), [(camera(820, 511.5, 383.5), (1024, 768)), (camera(820, 400, 300), (1024, 768))]
)
def test_a_principal_point_near_the_middle_raises_no_doubt(K: np.ndarray, size: tuple[int, int]) -> None:
    assert principal_point_doubt(K, size) is None


@pytest.mark.parametrize("size", [(410, 307), (2560, 1920)])
def test_a_principal_point_far_from_the_middle_raises_a_doubt(size: tuple[int, int]) -> None:
    words = f"the principal point 511.5,383.5 is far from the middle of an image of {size[0]} x {size[1]}"
    assert principal_point_doubt(camera(820, 511.5, 383.5), size) == words
