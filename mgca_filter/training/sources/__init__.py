"""Where training pairs come from: scene bundles, OANet dumps, rendered worlds, image-free pairs; mixed by weights.

A source draws a pair from a random generator and from nothing else, so that what a step sees depends on the seed
and the step's number alone, however many processes draw.
"""

from .base import DataSource, MixedSource
from .opening import OpenedSources, open_sources

__all__ = ["DataSource", "MixedSource", "OpenedSources", "open_sources"]
