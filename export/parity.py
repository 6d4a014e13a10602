"""Compare all runtimes on a model file: ``python -m mgca_filter.export.parity``."""

import sys

from mgca_filter.export.parity import main

if __name__ == "__main__":
    sys.exit(main())
