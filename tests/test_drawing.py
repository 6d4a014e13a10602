"""Pictures: what must be visible where, for any two images."""

import numpy as np
import pytest

from mgca_filter import drawing
from mgca_filter.drawing import RIGHT_AND_WRONG, MatchPanel, caption, draw_before_after, draw_matches


def grey_image(width: int, height: int) -> np.ndarray:
    return np.full((height, width), 128, np.uint8)


def panel(*mask: bool) -> MatchPanel:
    return MatchPanel(np.array(mask, bool), "ok", (f"{len(mask)} matches in",))


def greenness(picture: np.ndarray) -> np.ndarray:
    """How much more green than red a pixel is; the header is cut off."""
    body = picture[drawing.HEADER_PX :].astype(int)
    return body[:, :, 1] - body[:, :, 2]


@pytest.mark.parametrize(("size1", "size2"), [((800, 600), (800, 600)), ((300, 900), (1600, 200)), ((5, 4), (3, 7))])
@pytest.mark.parametrize("channels", [(), (1,), (3,), (4,)])
def test_any_sizes_and_channels_give_one_colour_picture(size1, size2, channels):
    image1 = np.full((size1[1], size1[0], *channels), 90, np.uint8)
    points = np.zeros((2, 2))
    picture = draw_matches(image1, grey_image(*size2), points, points, panel(True, False))
    assert picture.dtype == np.uint8
    assert picture.ndim == 3
    assert picture.shape[2] == 3
    assert picture.shape[1] <= drawing.MAX_WIDTH_PX


def test_large_images_shrink_to_the_widest_canvas():
    picture = draw_matches(grey_image(6000, 4000), grey_image(4000, 6000), np.empty((0, 2)), np.empty((0, 2)), panel())
    assert abs(picture.shape[1] - drawing.MAX_WIDTH_PX) <= 2


def test_kept_line_joins_its_two_points():
    width, height = 400, 300
    picture = draw_matches(grey_image(width, height), grey_image(width, height), [[40, 60]], [[200, 60]], panel(True))
    green = greenness(picture) > 40
    rows, columns = np.nonzero(green)
    assert abs(rows.mean() - 60) < 1
    assert abs(columns.min() - (40 - 2)) <= 1  # the dot has a radius of 2
    assert abs(columns.max() - (width + drawing.GAP_PX + 200 + 2)) <= 1


def test_line_ends_scale_with_each_image():
    """The same scene point in an image of half the resolution lands at the same place of the canvas."""
    picture = draw_matches(grey_image(400, 300), grey_image(200, 150), [[39.5, 59.5]], [[99.5, 29.5]], panel(True))
    columns = np.nonzero((greenness(picture) > 40).any(axis=0))[0]
    scale = (picture.shape[1] - drawing.GAP_PX) / 800
    assert abs(columns.max() - (400 * scale + drawing.GAP_PX + 200 * scale + 2)) <= 2


def test_kept_matches_lie_above_rejected_ones():
    count = 60
    start, end = np.tile([[40.0, 60.0]], (count, 1)), np.tile([[200.0, 60.0]], (count, 1))
    mask = [True] + [False] * (count - 1)
    picture = draw_matches(grey_image(400, 300), grey_image(400, 300), start, end, panel(*mask))
    assert greenness(picture)[60, 50:300].min() > 40


def test_rejected_matches_are_red_and_a_sample_of_many():
    count = 4 * drawing.MAX_REJECTED_DRAWN
    y = np.linspace(0, 299, count)
    points = np.stack([np.full(count, 20.0), y], axis=1)
    image = grey_image(400, 300)
    picture = draw_matches(image, image, points, points, panel(*[False] * count))
    middle = greenness(picture)[:, 30:400]
    assert (middle < -10).mean() > 0.5
    assert greenness(picture).max() <= 5


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e12, -1e12])
def test_points_that_cannot_be_drawn_do_not_raise(bad):
    picture = draw_matches(grey_image(50, 40), grey_image(50, 40), [[bad, 3.0]], [[4.0, bad]], panel(True))
    assert picture.shape[0] > drawing.HEADER_PX


def test_inputs_are_left_alone():
    image = np.full((60, 80, 3), 200, np.uint8)
    draw_matches(image, image, [[1, 2]], [[3, 4]], panel(True))
    assert (image == 200).all()


def test_header_mark_tells_success():
    image = grey_image(400, 300)
    for success, channel in ((True, 1), (False, 2)):
        picture = draw_matches(image, image, [], [], MatchPanel(np.zeros(0, bool), "x", (), success))
        assert picture[10, 2].argmax() == channel


def test_title_and_facts_change_the_header_only():
    image = grey_image(700, 300)
    plain = draw_matches(image, image, [], [], MatchPanel(np.zeros(0, bool)))
    for other in (MatchPanel(np.zeros(0, bool), "RANSAC"), MatchPanel(np.zeros(0, bool), "", ("1 kept",))):
        picture = draw_matches(image, image, [], [], other)
        assert (picture[: drawing.HEADER_PX] != plain[: drawing.HEADER_PX]).any()
        assert np.array_equal(picture[drawing.HEADER_PX :], plain[drawing.HEADER_PX :])


def test_long_header_fits_a_narrow_picture():
    image = grey_image(40, 300)
    words = MatchPanel(np.zeros(0, bool), "a title", ["a rather long fact about the matches"] * 9)
    assert draw_matches(image, image, [], [], words).shape[2] == 3


def test_colours_are_those_of_the_panel_and_a_caption_is_as_wide_as_asked():
    image = grey_image(400, 300)
    points = [[40.0, 60.0], [200.0, 150.0]]
    for mask, expected in (([True, True], RIGHT_AND_WRONG[0]), ([False, False], RIGHT_AND_WRONG[1])):
        row = MatchPanel(np.array(mask), words=("right", "wrong"), colours=RIGHT_AND_WRONG)
        picture = draw_matches(image, image, points, points, row)[drawing.HEADER_PX :]
        shift = picture.astype(int).max(axis=(0, 1)) - picture.astype(int).min(axis=(0, 1))
        assert np.argmax(shift) == np.argmax(expected)
    for width in (30, 700):
        strip = caption(width, "4001 raw matches, 397 of them right")
        assert strip.shape == (drawing.HEADER_PX, width, 3)
        assert strip.std() > 0


def test_before_after_stacks_both_panels():
    image = grey_image(400, 300)
    points = [[40.0, 60.0]]
    above = draw_matches(image, image, points, points, panel(False))
    below = draw_matches(image, image, points, points, panel(True))
    both = draw_before_after(image, image, points, points, panel(False), panel(True))
    assert np.array_equal(both[: len(above)], above)
    assert np.array_equal(both[-len(below) :], below)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 5), np.float32), "image1 must be a non-empty uint8"),
        (np.zeros((0, 5), np.uint8), "image1 must be a non-empty uint8"),
        (np.zeros((4, 5, 2), np.uint8), "image1 must have 1, 3 or 4 channels"),
    ],
)
def test_wrong_images_are_named(image, message):
    with pytest.raises(ValueError, match=message):
        draw_matches(image, grey_image(5, 4), [], [], panel())


def test_lengths_must_agree():
    with pytest.raises(ValueError, match="one length, got 1, 1, 2"):
        draw_matches(grey_image(5, 4), grey_image(5, 4), [[1, 1]], [[1, 1]], panel(True, True))
