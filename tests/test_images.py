"""From the bytes of a file to pixels: depth, orientation, size; and what speaks against a principal point."""

from __future__ import annotations

import struct

import cv2
import numpy as np
import pytest
from image_files import promising, turned

from mgca_filter.exif import exif_orientation
from mgca_filter.geometry.orientation import shown_pixels, shown_size
from mgca_filter.image_header import promised_size
from mgca_filter.images import decode_image, decode_photo, principal_point_doubt

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


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp", ".tiff"])
def test_a_photo_is_shown_as_its_exif_says(suffix: str, orientation: int, grey: np.ndarray) -> None:
    """As cv2.imread shows it, and the orientation leads back to what is stored."""
    data = turned(suffix, grey, orientation)
    shown, found = decode_photo(data)
    assert found == orientation
    np.testing.assert_array_equal(shown, cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    stored = decode_photo(turned(suffix, grey, 1))[0]
    size = (stored.shape[1], stored.shape[0])
    assert shown_size(orientation, size) == (shown.shape[1], shown.shape[0])
    T = shown_pixels(orientation, size)
    for x, y in ((0, 0), (3, 7), (size[0] - 1, size[1] - 2)):
        u, v, _ = (T @ [x, y, 1]).astype(int)
        assert shown[v, u].tolist() == stored[y, x].tolist()


def test_what_carries_no_exif_is_shown_as_it_is(grey: np.ndarray) -> None:
    for suffix in (".bmp", ".pgm", ".png"):
        shown, orientation = decode_photo(encoded(grey, suffix))
        assert orientation == 1
        np.testing.assert_array_equal(shown[:, :, 0], grey)


FORMATS = [
    *(".png", ".jpg", ".webp", ".tiff", ".bmp", ".ppm", ".pfm", ".pam", ".hdr", ".sr", ".gif", ".jp2", ".avif"),
]


def written(suffix: str, image: np.ndarray) -> bytes:
    if not cv2.haveImageWriter(f"x{suffix}"):
        pytest.skip(f"this OpenCV writes no {suffix}")
    try:
        return encoded(image, suffix)
    except cv2.error:
        return encoded(image.astype(np.float32), suffix)


@pytest.mark.parametrize("suffix", FORMATS)
def test_the_header_tells_the_size(suffix: str) -> None:
    image = np.random.default_rng(0).integers(0, 256, (37, 53, 3), dtype=np.uint8)
    data = written(suffix, image)
    assert promised_size(data) == (53, 37)
    for length in range(0, min(len(data), 700)):
        assert promised_size(data[:length]) in (None, (53, 37))


@pytest.mark.parametrize("suffix", FORMATS)
def test_a_file_that_promises_too_much_is_refused_before_it_is_decoded(
    suffix: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Under OpenCV's own limit of 2^30, where it would allocate gigabytes."""
    written(suffix, np.zeros((48, 72, 3), np.uint8))
    monkeypatch.setattr(cv2, "imdecode", lambda *arguments: pytest.fail("it was decoded"))
    width, height = (16_384, 16_384) if suffix == ".webp" else (30_000, 30_000)
    if suffix == ".webp":  # whose sides are at most 16384: at the limit, not above it
        monkeypatch.setenv("OPENCV_IO_MAX_IMAGE_PIXELS", str(16_383 * 16_384))
    with pytest.raises(ValueError, match=f"promises {width} x {height} pixels, more than"):
        decode_photo(promising(suffix, width, height))


def test_the_environment_moves_the_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    data = encoded(np.zeros((20, 30), np.uint8))
    monkeypatch.setenv("OPENCV_IO_MAX_IMAGE_PIXELS", "599")
    with pytest.raises(ValueError, match="more than 599; OPENCV_IO_MAX_IMAGE_PIXELS"):
        decode_image(data)
    monkeypatch.setenv("OPENCV_IO_MAX_IMAGE_PIXELS", "600")
    assert decode_image(data).shape == (20, 30, 3)
    monkeypatch.setenv("OPENCV_IO_MAX_IMAGE_PIXELS", "many")
    assert decode_image(data).shape == (20, 30, 3)


@pytest.mark.parametrize("suffix", [".tiff", ".png", ".jpg"])
def test_headers_of_any_bytes_raise_nothing(suffix: str, grey: np.ndarray) -> None:
    rng, good = np.random.default_rng(0), encoded(grey, suffix)
    for _ in range(300):
        data = bytearray(good[: rng.integers(1, 400)])
        for place in rng.integers(0, len(data), 6):
            data[place] = rng.integers(256)
        promised_size(bytes(data))
        exif_orientation(bytes(data))


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
