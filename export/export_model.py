"""Write the shipped model files from trained weights and check them: ``python -m mgca_filter.export WEIGHTS``."""

import sys

from mgca_filter.export.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
