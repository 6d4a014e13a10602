"""One training sample: a pair, its input, its augmentation, and the arrays that the network and the loss take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import homogeneous, symmetric_epipolar_distance_squared
from ..inputs.attributes import Column
from .augmentation import (
    AugmentationConfig,
    draw_homographies,
    sees_all,
    transform_attributes,
    transform_epipolar,
    transform_points,
)
from .pairs import POSITIVE, TrainingPair
from .sampling import Regime, SamplingConfig, draw_input
from .sources import DataSource

VIRTUAL_GRID = 20
SAMPSON_STEPS = 8
MINIMUM_POSITIVES = 8
MINIMUM_DISTINCT = 16  # fewer different matches leave the eight-point solve, and its gradient, without an answer
PRIOR_MATCHES = 256
DRAW_TRIES = 50


class DegenerateDataError(ValueError):
    """A data source gives nothing but pairs whose matches are all alike."""


@dataclass(frozen=True)
class Draw:
    """One sample before it is built: its pair, how its input looks, which matches may enter."""

    pair: TrainingPair
    regime: Regime
    seed: tuple[int, ...]
    rows: NDArray[np.intp]
    attributes: NDArray[np.float32]  # encoded, of all raw matches of the pair


def draw_sample(source: DataSource, sampling: SamplingConfig, seed: tuple[int, ...]) -> Draw:
    """Pair first, then the kind of input; drawn again where the matches are too few or all alike.

    Raises:
        DegenerateDataError: fifty pairs in a row were no good.
    """
    rng = np.random.default_rng(seed)
    for _ in range(DRAW_TRIES):
        pair = source.draw(rng)
        regime, rows, attributes = draw_input(rng, pair, sampling)
        if has_variety(pair.correspondences[rows]):
            return Draw(pair, regime, seed, rows, attributes)
    raise DegenerateDataError(
        f"{pair.name}: {DRAW_TRIES} pairs in a row had fewer than {MINIMUM_DISTINCT} matches apart"
    )


def has_variety(correspondences: NDArray[np.float64]) -> bool:
    """Whether enough rows (N, 4) differ, in both images, to tell a geometry."""
    halves = (correspondences[:, :2], correspondences[:, 2:])
    return all(
        len(np.unique(x @ [1.0, np.pi / 2])) >= MINIMUM_DISTINCT and np.ptp(x, axis=0).max() > 1e-4 for x in halves
    )


def build_sample(draw: Draw, count: int, augmentation: AugmentationConfig) -> dict[str, NDArray[np.generic]]:
    """Arrays of one sample.

    ``correspondences`` (N, 4), ``attributes`` (N, 8), ``labels`` (N,) 1 / 0 / −1; ``virtual`` (400, 4) points on
    the true epipolar geometry and ``virtual_valid`` (); ``prior_attributes`` (256, 8) and ``prior_labels`` (256,)
    of raw matches, candidates or not.
    """
    rng = np.random.default_rng((*draw.seed, 1))
    pair = draw.pair
    rows = rng.permutation(draw.rows)[:count]
    correspondences, attributes, F = _augment(rng, draw, rows, augmentation)
    if draw.regime == "bare" and rng.random() < 0.5:  # no ratio, no best-of-list: a swap stays true
        correspondences, F = correspondences[:, [2, 3, 0, 1]], F.T
        attributes[:, [Column.LOG2_SIZE, Column.SIN_TURN]] *= -1.0
    virtual, valid = virtual_correspondences(F)
    prior_rows = rng.integers(len(pair), size=PRIOR_MATCHES)
    return {
        "correspondences": correspondences.astype(np.float32),
        "attributes": attributes,
        "labels": pair.labels[rows],
        "virtual": virtual,
        "virtual_valid": np.float32(valid and np.count_nonzero(pair.labels[rows] == POSITIVE) >= MINIMUM_POSITIVES),
        "prior_attributes": draw.attributes[prior_rows],
        "prior_labels": pair.labels[prior_rows],
    }


def _augment(
    rng: np.random.Generator, draw: Draw, rows: NDArray[np.intp], augmentation: AugmentationConfig
) -> tuple[NDArray[np.float64], NDArray[np.float32], NDArray[np.float64]]:
    """Correspondences (N, 4), attributes (N, 8) and epipolar matrix after both cameras changed."""
    pair = draw.pair
    x = pair.correspondences[rows]
    H1, H2 = draw_homographies(rng, augmentation)
    if not (sees_all(H1, x[:, :2]) and sees_all(H2, x[:, 2:])):
        H1, H2 = np.eye(3), np.eye(3)
    x1, J1 = transform_points(H1, x[:, :2])
    x2, J2 = transform_points(H2, x[:, 2:])
    angle = pair.attributes.angle1
    angle1 = np.zeros(len(rows)) if angle is None else np.radians(angle[rows].astype(np.float64))
    attributes = transform_attributes(draw.attributes[rows], angle1, J1, J2)
    return np.hstack([x1, x2]), attributes, transform_epipolar(pair.E, H1, H2)


def virtual_correspondences(F: NDArray[np.float64]) -> tuple[NDArray[np.float32], bool]:
    """Grid of 20 x 20 points on [−1, 1)² of both images, moved onto epipolar geometry F → (400, 4), usable.

    Repeated Sampson corrections (Hartley & Zisserman 12.4) reach the variety in a few steps and cost a
    hundredth of ``cv2.correctMatches``, which finds the nearest point of it; rows that do not converge, near
    the epipoles, are replaced by one that did.
    """
    ticks = np.arange(VIRTUAL_GRID) * (2.0 / VIRTUAL_GRID) - 1.0
    grid = np.stack(np.meshgrid(ticks, ticks, indexing="xy"), -1).reshape(-1, 2)
    virtual = np.hstack([grid, grid])
    for _ in range(SAMPSON_STEPS):
        line2, line1 = homogeneous(virtual[:, :2]) @ F.T, homogeneous(virtual[:, 2:]) @ F
        error = np.sum(homogeneous(virtual[:, 2:]) * line2, axis=1)
        gradient = np.hstack([line1[:, :2], line2[:, :2]])
        virtual = virtual - gradient * (error / np.maximum(np.sum(gradient**2, axis=1), 1e-12))[:, None]
    good = np.isfinite(virtual).all(1) & (np.abs(virtual).max(1) < 3.0)
    good &= symmetric_epipolar_distance_squared(np.where(np.isfinite(virtual), virtual, 0.0), F) < 1e-8
    if not good.any():
        return np.zeros(virtual.shape, np.float32), False
    virtual[~good] = virtual[good][0]
    return virtual.astype(np.float32), True
