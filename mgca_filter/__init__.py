"""Drop-in robust matching filter for OpenCV pipelines.

``filter_matches(kp1, kp2, matches)`` scores putative matches with MGCA-Net, fits the two-view geometry to the
best of them and re-tests every match against it. Importing the package loads neither PyTorch, ONNX nor
Matplotlib; ONNX Runtime is loaded when the first model is opened.
"""

from . import opencv_version  # noqa: F401  # before all that needs OpenCV
from .errors import BackendError, BundleError, MgcaFilterError, ModelError
from .geometry.cameras import Fisheye
from .inputs.attributes import MatchAttributes
from .inputs.pair import MatchPair
from .match_filter import MatchFilter, filter_many, filter_matches, model_path
from .match_images import ImageMatchResult, match_images
from .opencv.patch import patch_cv2
from .opencv.twins import (
    estimateAffine2D,
    estimateAffinePartial2D,
    findEssentialMat,
    findFundamentalMat,
    findHomography,
    matchMGCA,
)
from .result import FilterResult, Status

__version__ = "0.1.0"

__all__ = [
    "BackendError",
    "BundleError",
    "FilterResult",
    "Fisheye",
    "ImageMatchResult",
    "MatchAttributes",
    "MatchFilter",
    "MatchPair",
    "MgcaFilterError",
    "ModelError",
    "Status",
    "__version__",
    "estimateAffine2D",
    "estimateAffinePartial2D",
    "filter_many",
    "filter_matches",
    "findEssentialMat",
    "findFundamentalMat",
    "findHomography",
    "matchMGCA",
    "match_images",
    "model_path",
    "patch_cv2",
]
