"""Fit the calibration of a model file on scene bundles: ``python -m mgca_filter.export.calibration_fit``."""

from mgca_filter.export.calibration_fit import main

if __name__ == "__main__":
    main()
