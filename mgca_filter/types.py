"""Types that several floors share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Union

Providers = Sequence[Union[str, "tuple[str, dict[str, Any]]"]]
