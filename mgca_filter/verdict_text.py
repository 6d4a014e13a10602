"""The verdict on a pair as a person would say it: what was found, and what to do next."""

from __future__ import annotations

import math
from typing import NamedTuple

GOOD, CAUTION, BAD = "good", "caution", "bad"

_MORE_MATCHES = "Try larger images, more keypoints (max_keypoints), another detector, or a closer pair of views."
# Status -> tone, headline, advice; FilterResult's statuses by their words, since this floor lies below it.
_TEXTS = {
    "ok": (
        GOOD,
        "Both images show one scene, and the camera motion between them was found.",
        "Use the kept matches, E, R and t as they are.",
    ),
    "planar": (
        GOOD,
        "The matches agree, and all that are right lie on one plane.",
        "Use the kept matches and the pose. To warp one image onto the other, take the homography in info.",
    ),
    "pure_rotation": (
        CAUTION,
        "The camera turned on the spot: there is a rotation and no translation.",
        "Use R and the homography in info, for a panorama say. Nothing can be triangulated: for depth, take a picture "
        "from another place.",
    ),
    "suspicious_intrinsics": (
        CAUTION,
        "The matches agree with each other and not with the intrinsics.",
        "Check K1, K2 and the image size they belong to, or run without them. Do not use the pose as it is.",
    ),
    "low_support": (
        BAD,
        "A few matches agree, too few to tell from chance.",
        "Do not use the pose. Look at the kept matches below: if they are right, more of them will settle it. "
        + _MORE_MATCHES,
    ),
    "unrelated": (
        BAD,
        "Nothing suggests that the two images show the same scene.",
        "Drop the pair. If you know that they overlap, the view changes too much for these keypoints. " + _MORE_MATCHES,
    ),
    "no_geometry": (
        BAD,
        "No camera motion explains the matches.",
        "Drop the pair, or look at the best scores below: right matches that lie on a line or on one spot determine "
        "nothing. " + _MORE_MATCHES,
    ),
    "too_few_matches": (
        BAD,
        "There are too few matches to say anything.",
        "At least six different ones are needed, eight without intrinsics. " + _MORE_MATCHES,
    ),
}  # fmt: skip
_GUESSED = (
    "Use the kept matches and F as they are. The focal length was guessed, so that E, R and t are rough: give K1 and "
    "K2 (on the command line --K fx,fy,cx,cy) for a pose to rely on."
)
_PLANE_WITHOUT_K = (
    "Use the kept matches and the homography in info. Without intrinsics a plane tells no pose: give K1 and K2 (on the "
    "command line --K fx,fy,cx,cy)."
)
_MIRRORED = (
    "One of the images is mirrored: no camera sees an opaque surface from both sides, so that there is no pose. Flip "
    "one image and match again; the kept matches, and the homography where there is one, are right as they are."
)
_FOCAL_DOUBT = (
    "Both images show one scene; how the camera moved hangs on its focal length, which the matches do not tell well.",
    "Use the kept matches and F as they are, and the pose with care: give K1 and K2 (on the command line --K "
    "fx,fy,cx,cy) for one to rely on.",
)
_UNSURE = 0.5


class VerdictText(NamedTuple):
    """A verdict in words: ``tone`` is "good", "caution" or "bad"; ``headline`` and ``advice`` are sentences."""

    tone: str
    headline: str
    advice: str


def describe_verdict(
    status: str,
    *,
    guessed: bool = False,
    confidence: float | None = None,
    focal_factor: float | None = None,
    mirrored: bool = False,
    focal_doubt: bool = False,
) -> VerdictText:
    """What a status means and what to do next.

    Args:
        status: word of :class:`mgca_filter.Status`; one that is not known is named as it is.
        guessed: the intrinsics were a guess.
        confidence: probability that the pose is within 10 degrees, or None.
        focal_factor: the matches ask for focal lengths that many times those given, or None.
        mirrored: one of the images is mirrored.
        focal_doubt: nothing but the focal lengths is in doubt.
    """
    word = str(status)
    if word not in _TEXTS:
        return VerdictText(CAUTION, f"The filter's verdict is {word.replace('_', ' ')}.", "Look at the kept matches.")
    tone, headline, advice = _TEXTS[word]
    if focal_doubt:
        tone, (headline, advice) = CAUTION, _FOCAL_DOUBT
    if guessed and word == "ok":
        advice = _GUESSED
    if mirrored:
        return VerdictText(tone, headline, _MIRRORED)
    if guessed and word == "planar":
        advice = _PLANE_WITHOUT_K
    if focal_factor is not None and math.isfinite(focal_factor):
        advice += f" The matches ask for focal lengths about {focal_factor:.2g} times those given."
    if confidence is not None and math.isfinite(confidence) and tone == GOOD:
        percent = round(100.0 * confidence)
        if confidence < _UNSURE:
            tone = CAUTION
            advice = f"Be careful: the pose is within 10° with a probability of only {percent} %. " + advice
        else:
            advice += f" The pose is within 10° with a probability of {percent} %."
    return VerdictText(tone, headline, advice)
