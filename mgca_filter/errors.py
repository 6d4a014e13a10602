"""Exceptions of the package: misuse and broken model files raise, data never does."""

from __future__ import annotations


class MgcaFilterError(Exception):
    """Base class of the errors that are the package's own."""


class ModelError(MgcaFilterError):
    """A model file is missing, truncated or of another contract; the message names the file."""


class BackendError(MgcaFilterError):
    """An inference backend could not be started or refused its input."""


class DatasetError(MgcaFilterError, ValueError):
    """Pairs with known pose cannot be read, or hold values that cannot be; the message names file and field."""


class BundleError(DatasetError):
    """A scene bundle lacks a field or holds values that cannot be; the message names file and field."""
