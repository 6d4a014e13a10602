"""Pictures of kept and rejected matches, with OpenCV alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

Image = NDArray[np.uint8]
Colour = tuple[int, int, int]

MAX_WIDTH_PX = 1600
MIN_WIDTH_PX = 720
MAX_REJECTED_DRAWN = 500
GAP_PX = 6
HEADER_PX = 46

_KEPT: Colour = (84, 214, 92)
_REJECTED: Colour = (82, 76, 196)
_BACKGROUND: Colour = (30, 26, 24)
RIGHT_AND_WRONG: tuple[Colour, Colour] = ((233, 180, 86), (0, 94, 213))
"""Sky blue and vermilion, which all eyes tell apart (Okabe & Ito, "Color Universal Design", 2008)."""
_TITLE: Colour = (245, 245, 245)
_TEXT: Colour = (196, 192, 188)
_IMAGE_BRIGHTNESS = 0.72  # lines must stand out against a bright photograph
_SUBPIXEL_BITS = 4  # cv2.line takes fixed-point coordinates
_TEXT_SUPERSAMPLING = 4  # OpenCV's stroke fonts look ragged at reading size


@dataclass(frozen=True)
class MatchPanel:
    """What one filter said of a list of matches: one row of a picture.

    Attributes:
        mask: bool (M,), True = kept.
        title: the first words of the header, the filter's name or its verdict.
        facts: short phrases that follow in the header, such as "2000 matches".
        success: colours the mark in front of the title, green or red.
        words: what the legend calls the two colours.
        colours: of the two kinds of matches, both in plain sight; by default the rejected ones are muted.
    """

    mask: NDArray[np.bool_]
    title: str = ""
    facts: Sequence[str] = ()
    success: bool = True
    words: tuple[str, str] = ("kept", "rejected")
    colours: tuple[Colour, Colour] | None = None


def draw_matches(image1: Image, image2: Image, points1: ArrayLike, points2: ArrayLike, panel: MatchPanel) -> Image:
    """Both images side by side, kept matches in green above rejected ones in muted red, under a header strip.

    Images (h, w), (h, w, 1), (h, w, 3) BGR or (h, w, 4) BGRA, uint8, of any two sizes: both are brought to one
    height, so that the picture is at most 1600 px wide. ``points1``, ``points2`` (M, 2) are pixels of the images as
    given. Of more than 500 rejected matches an even sample of 500 is drawn. Returns (H, W, 3) uint8 BGR.

    Raises:
        ValueError: an image is empty or no uint8 image, or points and mask differ in length.
    """
    canvas, place1, place2 = _side_by_side(as_bgr(image1, "image1"), as_bgr(image2, "image2"))
    start = np.asarray(points1, dtype=np.float64).reshape(-1, 2)
    end = np.asarray(points2, dtype=np.float64).reshape(-1, 2)
    mask = np.asarray(panel.mask, dtype=bool)
    if not len(start) == len(end) == len(mask):
        raise ValueError(f"points1, points2 and mask must have one length, got {len(start)}, {len(end)}, {len(mask)}")
    start, end = place1.to_canvas(start), place2.to_canvas(end)
    drawable = np.isfinite(start).all(axis=1) & np.isfinite(end).all(axis=1)
    rejected = np.flatnonzero(~mask & drawable)
    if len(rejected) > MAX_REJECTED_DRAWN:
        rejected = rejected[np.linspace(0, len(rejected) - 1, MAX_REJECTED_DRAWN).astype(int)]
    kept = np.flatnonzero(mask & drawable)
    good, bad = panel.colours or (_KEPT, _REJECTED)
    highest = 0.45 if panel.colours is None else 0.85
    canvas = _draw_lines(canvas, start[rejected], end[rejected], bad, _opacity(len(rejected), 0.32, highest))
    canvas = _draw_lines(canvas, start[kept], end[kept], good, _opacity(len(kept), 0.65, 0.85))
    _draw_ends(canvas, np.vstack([start[kept], end[kept]]), good)
    return np.vstack([_header(canvas.shape[1], panel), canvas])


def draw_before_after(
    image1: Image, image2: Image, points1: ArrayLike, points2: ArrayLike, before: MatchPanel, after: MatchPanel
) -> Image:
    """Two filters on the same matches, one above the other; arguments as for :func:`draw_matches`."""
    above = draw_matches(image1, image2, points1, points2, before)
    below = draw_matches(image1, image2, points1, points2, after)
    rule = np.full((GAP_PX, above.shape[1], 3), 255, np.uint8)
    return np.vstack([above, rule, below])


def draw_overlay(image1: Image, image2: Image, H: ArrayLike) -> Image:
    """Image 1 as the homography ``H`` (3, 3), ``p2 ~ H p1``, brings it onto image 2, half transparent over it.

    Images as of :func:`draw_matches`. Returns (h2, w2, 3) uint8 BGR, in the pixels of image 2; where image 1 does not
    reach, image 2 alone.

    Raises:
        ValueError: an image is empty or no uint8 image.
    """
    first, second = as_bgr(image1, "image1"), as_bgr(image2, "image2")
    size, matrix = (second.shape[1], second.shape[0]), np.asarray(H, dtype=np.float64)
    warped = cv2.warpPerspective(first, matrix, size)
    reached = cv2.warpPerspective(np.full(first.shape[:2], 255, np.uint8), matrix, size) > 127
    mixed = cv2.addWeighted(warped, 0.5, second, 0.5, 0.0)
    return np.asarray(np.where(reached[..., None], mixed, second), dtype=np.uint8)


def caption(width: int, words: str) -> Image:
    """A strip (h, width, 3) uint8 BGR with words, to stand above or below a picture."""
    strip = np.full((HEADER_PX, width, 3), _BACKGROUND, np.uint8)
    text = _text(words, _TEXT)
    room = min(text.shape[1], max(0, width - 20))
    strip[:, 20 : 20 + room] = text[:, :room]
    return strip


@dataclass(frozen=True)
class _Place:
    """Where an image lies on the canvas: its left edge, its scale and its size there."""

    left_px: int
    scale_x: float
    scale_y: float
    size: tuple[int, int]

    def to_canvas(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Pixels of the original (M, 2) to pixels of the canvas; what lies outside comes to the border."""
        scaled = (points + 0.5) * (self.scale_x, self.scale_y) - 0.5  # pixel centres, as cv2.resize has them
        return np.clip(scaled, 0.0, (self.size[0] - 1.0, self.size[1] - 1.0)) + (self.left_px, 0.0)


def as_bgr(image: ArrayLike, name: str) -> Image:
    """Image (h, w), (h, w, 1), (h, w, 3) BGR or (h, w, 4) BGRA uint8 as (h, w, 3) BGR.

    Raises:
        ValueError: it is empty, of another type or of another number of channels.
    """
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.ndim not in (2, 3) or array.size == 0:
        raise ValueError(f"{name} must be a non-empty uint8 image, got {array.dtype} of shape {array.shape}")
    channels = 1 if array.ndim == 2 else array.shape[2]
    if channels not in (1, 3, 4):
        raise ValueError(f"{name} must have 1, 3 or 4 channels, got {channels}")
    if channels == 1:
        array = np.repeat(array.reshape(*array.shape[:2], 1), 3, axis=2)
    return np.ascontiguousarray(array[:, :, :3])


def _side_by_side(image1: Image, image2: Image) -> tuple[Image, _Place, _Place]:
    """Dimmed canvas with both images at one height, and their places."""
    (h1, w1), (h2, w2) = image1.shape[:2], image2.shape[:2]
    aspect = w1 / h1 + w2 / h2
    natural_width = max(h1, h2) * aspect + GAP_PX
    width = min(max(natural_width, MIN_WIDTH_PX), MAX_WIDTH_PX) - GAP_PX
    height = max(1, round(width / aspect))
    width1 = max(1, round(w1 * height / h1))
    width2 = max(1, round(w2 * height / h2))
    canvas = np.full((height, width1 + GAP_PX + width2, 3), _BACKGROUND, np.uint8)
    places = []
    for image, left, size in ((image1, 0, (width1, height)), (image2, width1 + GAP_PX, (width2, height))):
        shrinks = size[0] < image.shape[1]
        resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC)
        canvas[:, left : left + size[0]] = (resized * _IMAGE_BRIGHTNESS).astype(np.uint8)
        places.append(_Place(left, size[0] / image.shape[1], size[1] / image.shape[0], size))
    return canvas, places[0], places[1]


def _opacity(lines: int, lowest: float, highest: float) -> float:
    """Many lines are drawn fainter, or they hide the images; 100 of them still have the highest opacity."""
    return float(np.clip(highest * 10.0 / np.sqrt(max(lines, 1)), lowest, highest))


def _fixed_point(points: NDArray[np.float64]) -> list[list[int]]:
    return [[int(v) for v in row] for row in np.rint(points * (1 << _SUBPIXEL_BITS))]


def _draw_lines(
    canvas: Image, start: NDArray[np.float64], end: NDArray[np.float64], colour: Colour, opacity: float
) -> Image:
    """The canvas with anti-aliased lines between canvas points (L, 2)."""
    layer = canvas.copy()
    for (x1, y1), (x2, y2) in zip(_fixed_point(start), _fixed_point(end)):
        cv2.line(layer, (x1, y1), (x2, y2), colour, 1, cv2.LINE_AA, _SUBPIXEL_BITS)
    return np.asarray(cv2.addWeighted(layer, opacity, canvas, 1.0 - opacity, 0.0), dtype=np.uint8)


def _draw_ends(canvas: Image, points: NDArray[np.float64], colour: Colour) -> None:
    """Dots at canvas points (L, 2), in place."""
    for x, y in _fixed_point(points):
        cv2.circle(canvas, (x, y), 2 << _SUBPIXEL_BITS, colour, cv2.FILLED, cv2.LINE_AA, _SUBPIXEL_BITS)


def _header(width: int, panel: MatchPanel) -> Image:
    """Strip (46, width, 3): coloured mark, title, facts, and the legend at the right where there is room for it."""
    strip = np.full((HEADER_PX, width, 3), _BACKGROUND, np.uint8)
    strip[:, :6] = _KEPT if panel.success else _REJECTED
    pieces = [_text(panel.title, _TITLE, bold=True)] + [_text(fact, _TEXT) for fact in panel.facts]
    gap = 26
    row = np.full((HEADER_PX, sum(piece.shape[1] + gap for piece in pieces), 3), _BACKGROUND, np.uint8)
    left = 0
    for piece in pieces:
        row[:, left : left + piece.shape[1]] = piece
        left += piece.shape[1] + gap
    room = width - 20
    if left > room:  # a narrow picture: shrink the words rather than lose some
        shrunk = cv2.resize(row, (room, max(1, HEADER_PX * room // left)), interpolation=cv2.INTER_AREA)
        top = (HEADER_PX - shrunk.shape[0]) // 2
        strip[top : top + shrunk.shape[0], 20 : 20 + room] = shrunk
        return strip
    strip[:, 20 : 20 + left] = row
    legend = _legend(panel.words, panel.colours or (_KEPT, _REJECTED))
    if left + legend.shape[1] + gap <= room:
        strip[:, width - legend.shape[1] :] = legend
    return strip


def _legend(words: tuple[str, str], colours: tuple[Colour, Colour]) -> Image:
    pieces = []
    for word, colour in zip(words, colours):
        swatch = np.full((HEADER_PX, 36, 3), _BACKGROUND, np.uint8)
        cv2.line(swatch, (4, HEADER_PX // 2), (26, HEADER_PX // 2), colour, 2, cv2.LINE_AA)
        pieces += [swatch, _text(word, _TEXT), np.full((HEADER_PX, 18, 3), _BACKGROUND, np.uint8)]
    return np.hstack(pieces)


def _text(words: str, colour: Colour, bold: bool = False) -> Image:
    """Words on the background (46, w, 3), centred upright; characters outside ASCII become "?"."""
    words = words.encode("ascii", "replace").decode()
    n = _TEXT_SUPERSAMPLING
    scale, thickness = 0.58 * n, n * 2 if bold else int(n * 1.25)
    (w, h), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, scale, thickness)
    width = -(-(w + thickness) // n)
    large = np.full((HEADER_PX * n, max(1, width) * n, 3), _BACKGROUND, np.uint8)
    # Centred by the height of a capital letter, so that words with and without descenders share a baseline.
    baseline = (0, (HEADER_PX * n + h) // 2)
    cv2.putText(large, words, baseline, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, thickness, cv2.LINE_AA)
    return np.asarray(cv2.resize(large, None, fx=1 / n, fy=1 / n, interpolation=cv2.INTER_AREA), dtype=np.uint8)
