"""Results on disk: one JSON file per method, seed and scene, valid for exactly the data and settings it names."""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from ..atomic_file import replaced_when_done
from .methods import PairOutcome

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ResultKey:
    """What a stored result depends on; two runs share results where all of it is equal.

    ``settings`` are the method's own (:meth:`Method.settings`: options, library versions, model hash), ``data_sha256``
    is that of the pairs' source.
    """

    method: str
    scene: str
    seed: int
    data_sha256: str
    settings: dict[str, Any]

    @property
    def file_name(self) -> str:
        """``scene/method.seedN.digest.json``."""
        words = re.sub(r"[^a-z0-9.]+", "-", self.method.lower()).strip("-")
        return f"{self.scene}/{words}.seed{self.seed}.{_digest(asdict(self))}.json"


class ResultStore:
    """Outcomes by key; with ``folder=None`` they live in memory only, and are gone with the object."""

    def __init__(self, folder: str | Path | None) -> None:
        self.folder = None if folder is None else Path(folder)
        self._memory: dict[str, dict[int, PairOutcome]] = {}

    def load(self, key: ResultKey) -> dict[int, PairOutcome]:
        """Outcomes by index of the pair, as far as they are known."""
        if self.folder is None:
            return dict(self._memory.get(key.file_name, {}))
        path = self.folder / key.file_name
        if not path.exists():
            return {}
        try:
            outcomes = [PairOutcome.from_json(row) for row in json.loads(path.read_text())["outcomes"]]
        except (ValueError, KeyError, TypeError) as error:
            logger.warning("%s: unreadable, computed again (%s)", path, error)
            return {}
        return {outcome.pair: outcome for outcome in outcomes}

    def add(self, key: ResultKey, outcomes: Iterable[PairOutcome]) -> None:
        """Merge outcomes into what is known. The file is replaced at once, never left half written."""
        known = self.load(key)
        known.update({outcome.pair: outcome for outcome in outcomes})
        if self.folder is None:
            self._memory[key.file_name] = known
            return
        content = {"key": asdict(key), "outcomes": [asdict(known[pair]) for pair in sorted(known)]}
        _write(self.folder / key.file_name, content)

    def once(self, name: str, depends_on: Any, compute: Callable[[], Any]) -> Any:
        """What ``compute`` gives, kept as ``name.digest.json`` for exactly what it depends on; JSON values both."""
        if self.folder is None:
            return compute()
        path = self.folder / f"{name}.{_digest(depends_on)}.json"
        if not path.exists():
            _write(path, {"key": depends_on, "value": compute()})
        return json.loads(path.read_text())["value"]


def _digest(content: Any) -> str:
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


def _write(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replaced_when_done(path) as temporary:
        temporary.write_text(json.dumps(content))
