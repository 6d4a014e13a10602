"""COLMAP databases with a defect, each with the exit statuses that ``mgca-match colmap`` may answer with."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np

from .matches import HEIGHT, KINDS, WIDTH, K

_TRIPLES = 300


def write_good_database(path: Path) -> None:
    """Three images of a scene, matched with each other; the third one alone has no distortion."""
    import pycolmap

    rng = np.random.default_rng(0)
    first, second = KINDS["true scene"](rng, _TRIPLES)
    with closing(pycolmap.Database.open(path)) as database:
        ids = []
        for name, points in (("one.png", first), ("two.png", second), ("three.png", second + 1.0)):
            params = [K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5]
            camera = pycolmap.Camera(model="PINHOLE", width=int(WIDTH), height=int(HEIGHT), params=params)
            camera.has_prior_focal_length = True
            ids.append(database.write_image(pycolmap.Image(name=name, camera_id=database.write_camera(camera))))
            database.write_keypoints(ids[-1], (points + 0.5).astype(np.float32))
        rows = np.arange(_TRIPLES, dtype=np.uint32)
        for i, j in ((0, 1), (0, 2)):
            database.write_matches(ids[i], ids[j], np.stack([rows, rows], axis=1))


def damage(path: Path, statement: str) -> None:
    """Run SQL on a database that may then break its own rules."""
    with closing(sqlite3.connect(path)) as database:
        database.executescript("PRAGMA foreign_keys = OFF;" + statement)
        database.commit()


DATABASES: dict[str, tuple[str, tuple[int, ...]]] = {
    "whole": ("", (0,)),
    "a camera deleted": ("DELETE FROM cameras WHERE camera_id = 2", (0,)),
    "an image deleted": ("DELETE FROM images WHERE image_id = 2", (0,)),
    "keypoints deleted": ("DELETE FROM keypoints WHERE image_id = 2", (0,)),
    "keypoints cut short": ("UPDATE keypoints SET data = substr(data, 1, 7) WHERE image_id = 2", (0, 2)),
    "matches cut short": ("UPDATE matches SET data = substr(data, 1, 9) WHERE pair_id % 2147483647 = 2", (0, 2)),
    "matches that point nowhere": ("UPDATE matches SET data = zeroblob(length(data))", (1,)),
    "a focal length of zero": ("UPDATE cameras SET params = zeroblob(32) WHERE camera_id = 2", (0,)),
    "a camera of an unknown model": ("UPDATE cameras SET model = 99 WHERE camera_id = 2", (0, 2)),
    "a name in Latin-1": ("UPDATE images SET name = CAST(x'66DF2E706E67' AS TEXT) WHERE image_id = 2", (0,)),
    "no descriptors": ("DROP TABLE descriptors", (2,)),
    "no matches": ("DELETE FROM matches", (1,)),
    "no tables": ("DROP TABLE matches; DROP TABLE keypoints; DROP TABLE descriptors", (2,)),
}
"""By kind: the statement that makes it, and the exit statuses that are right."""
