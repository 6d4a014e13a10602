"""Reports to open in a browser: one HTML file each, without a server and without a network.

``write_pair_report`` shows one pair (images, matches, geometry, comparison), ``write_folder_report`` the match graph of
many, and ``show`` opens the report of a pair at once.
"""

from .folder_report import PairLine, write_folder_report
from .pair_report import Baseline, BaselineLike, Truth, show, write_pair_report

__all__ = ["Baseline", "BaselineLike", "PairLine", "Truth", "show", "write_folder_report", "write_pair_report"]
