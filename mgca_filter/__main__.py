"""``python -m mgca_filter``: ``run script.py`` puts the filter into a script of OpenCV; else ``mgca-match``."""

import sys

from . import cli
from .opencv import script as opencv_script

if __name__ == "__main__":
    if sys.argv[1:2] == ["run"]:
        sys.exit(opencv_script.main(sys.argv[2:]))
    sys.exit(cli.main())
