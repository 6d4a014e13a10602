"""OpenCV is there and new enough, or one line says what to install.

No wheel of OpenCV is among this package's requirements: all of them write the same folder ``cv2``, and requiring one
would put its files over those of another that the user has.
"""

from __future__ import annotations

OLDEST = (4, 10)
"""The oldest OpenCV that the package is tried with (``.ci/try_versions.py``)."""

HOW_TO_INSTALL = (
    "python -m pip install opencv-contrib-python (or, for a machine without a display: "
    "python -m pip install opencv-contrib-python-headless)"
)


def require_opencv() -> None:
    """Import ``cv2``.

    Raises:
        ImportError: there is none, or one older than :data:`OLDEST`; one line that says what to install. One that is
            there and does not load raises what its loader says.
    """
    try:
        import cv2
    except ModuleNotFoundError as error:
        if error.name != "cv2":
            raise
        raise ImportError(f"mgca_filter needs OpenCV, and there is no cv2: {HOW_TO_INSTALL}", name="cv2") from None
    found = getattr(cv2, "__version__", None)
    if found is None:  # a folder that a removed wheel left behind
        raise ImportError(f"mgca_filter needs OpenCV, and cv2 is an empty folder: {HOW_TO_INSTALL}", name="cv2")
    if tuple(int(part) for part in found.split(".")[:2]) < OLDEST:
        oldest = ".".join(map(str, OLDEST))
        raise ImportError(f"mgca_filter needs OpenCV {oldest} or newer, this is {found}: upgrade its wheel", name="cv2")


require_opencv()
