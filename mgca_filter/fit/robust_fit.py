"""The robust fit: what is proposed, refined, chosen, in this order.

An easy pair ends before the network: a run or two on the list alone explain it, no other pose comes near, and its
inliers hold it firmly. Otherwise unlike sources propose, on the scores of a quick network; where the first of them
agree, the deeper network and the other sources are left out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import acos, degrees

import numpy as np
from numpy.typing import NDArray

from ..geometry.epipolar import (
    decompose_essential,
    essential_from_pose,
    parallax,
    pose_error_deg,
    project_to_essential,
    sampson_distance,
)
from ..geometry.pose_refinement import refine_pose, refine_pose_by_weights
from ..inputs.options import FilterOptions
from ..inputs.pair import PairInput
from . import choice, sources
from .bayes_estimate import expected_best
from .choice import Coefficients, Hypotheses, Judgement, Residuals
from .estimators import EstimatorOptions
from .evidence import ACCEPTED_SCORE, MIN_MATCHES, Evidence, listed_rows
from .sources import Family, Proposal

Array = NDArray[np.float64]

REFINE_PX = 1.0
# The last refinement: a match counts half at three times the median distance of the inliers, between these limits; none
# counts beyond the reach, nor with so many times the inliers' median parallax: a wrong match of two images that hardly
# differ is far from still, and the farther it moved, the longer is its lever.
HALF_WEIGHT_MEDIANS, LEAST_HALF_WEIGHT_PX, HALF_WEIGHT_PX, LAST_REACH_PX = 3.0, 1e-3, 0.5, 6.0
LARGEST_PARALLAX_MEDIANS = 25.0
# A hypothesis this close to a refined one would end there; one this close to the best is no twin of it.
SAME_DEG, TWIN_DEG = 0.3, 2.0
# The early end is given up where a run explains less than the first share of the list; above the second, one will do.
PROMISING, CERTAIN = 0.3, 0.7
# Without intrinsics two runs must agree: on this share of the matches within so many pixels of one or the other, on
# more than so many of these, and on the direction of the epipolar lines, which lenses that nobody has calibrated bend.
AGREED_PX, AGREED_SHARE, AGREED_LEAST, AGREED_DEG = 2.0, 0.95, 15, 2.0
# A twin that explains less than this share of what the best pose does within so many pixels, before it is refined, is
# no alternative.
TWIN_SHARE, TWIN_PX = 0.5, 2.0
# Of fewer matches than this the best explanation is best by luck. From this angle on the pose that is expected nearest
# to the truth is another answer; else the refined one is finer.
FEW_MATCHES, EXPECTED_DEG = 200, 2.0
EXPECTED = "expected best"
"""Origin of an answer that no source proposed."""

# What needs no network; then what uses it; then what is still tried where those do not settle it.
BEFORE_NETWORK = (
    Proposal("list", Family.LIST_UNIFORM, sources.listed, "magsac", 0.5, 300, 0, rough=True),
    Proposal("list, 1 px", Family.LIST_UNIFORM, sources.listed, "magsac", 1.0, 300, 4, rough=True),
)
FIRST = (
    Proposal("network", Family.NETWORK, sources.network),
    Proposal("accepted", Family.ACCEPTED, sources.accepted, "magsac", 0.5, 300, 1, rough=True),
    Proposal("score order", Family.SCORE_ORDER, sources.above(-1.0), "prosac", 1.0, 1000, 0),
)
SECOND = (
    BEFORE_NETWORK[1],
    Proposal("list order", Family.LIST_ORDERED, sources.listed, "prosac", 0.5, 1000, 0),
    Proposal("score order, all", Family.SCORE_ORDER, sources.above(-2.0), "prosac", 0.5, 1000, 3),
)
POSELIB = Proposal("PoseLib", Family.POSELIB, sources.listed, "poselib", 0.75, 10_000, 0)
# One robust estimator alone, for those who ask for it.
ALONE = {
    "prosac": Proposal("prosac", Family.SCORE_ORDER, sources.above(-1.0), "prosac", 0.5, 5000, 0),
    "magsac": Proposal("magsac", Family.ACCEPTED, sources.accepted, "magsac", 0.5, 5000, 0),
    "ransac": Proposal("ransac", Family.ACCEPTED, sources.accepted, "ransac", 0.5, 5000, 0),
}


@dataclass(frozen=True)
class Plan:
    """Which sources propose, and when.

    Attributes:
        before: those that need no network, one after the other. first: those that use it.
        second: those that are tried where the first do not settle it.
        twins: propose the twin that the dominant plane allows as well.
        settle: leave the second out where the first agree.
        last_refinement: refine what was chosen once more, on all matches by what each is worth.
        expected: where the choice is unsure, answer with the pose that is expected to lie nearest to the truth.
    """

    before: tuple[Proposal, ...] = BEFORE_NETWORK
    first: tuple[Proposal, ...] = FIRST
    second: tuple[Proposal, ...] = SECOND
    twins: bool = True
    settle: bool = True
    last_refinement: bool = True
    expected: bool = True


PLAN = Plan()


@dataclass(frozen=True)
class TwoViewModel:
    """Model of a pair of images, on the normalised image planes.

    Attributes:
        M: (3, 3) of unit Frobenius norm, ``x2^T M x1 = 0``: the essential matrix, or, with guessed intrinsics,
            the fundamental matrix expressed in normalised coordinates.
        E: (3, 3) essential matrix of unit Frobenius norm. R: (3, 3) rotation. t: (3,) unit norm.
        origin: name of the source that proposed it.
        ended: ``"before the network"``, ``"first sources"`` or ``"all sources"``.
        confidence: probability that the pose is within 10 degrees; None with guessed intrinsics.
        judgement: the measurements behind the choice; None likewise.
        plane: homography (3, 3) of the dominant plane among its inliers, where it was looked for; else None.
        expected: R, t that are expected to lie nearer to the truth than the best explanation of the matches, which is
            what M, E, R and t are; None where that is no other answer.
    """

    M: Array
    E: Array
    R: Array
    t: Array
    origin: str
    ended: str
    confidence: float | None = None
    judgement: Judgement | None = None
    plane: Array | None = None
    expected: tuple[Array, Array] | None = None

    @property
    def answer(self) -> TwoViewModel:
        """What is answered where the matches hold a pose at all: the same with the expected one, where there is one."""
        if self.expected is None:
            return self
        R, t = self.expected
        E = essential_from_pose(R, t)
        return replace(self, M=E, E=E, R=R, t=t, origin=EXPECTED, expected=None)


@dataclass(frozen=True)
class _Pose:
    """A refined hypothesis."""

    R: Array
    t: Array
    family: Family
    origin: str


class Search:
    """Hypotheses of a pair as they come, refined, and the choice among them.

    Args:
        evidence: what is known before the network.
        coefficients: of the choice, from the model file.
        options: method, confidence, largest number of iterations and seed count here.
        plan: which sources propose, and when.
    """

    def __init__(
        self, evidence: Evidence, coefficients: Coefficients, options: FilterOptions, plan: Plan = PLAN
    ) -> None:
        self._coefficients, self._options, self._plan = coefficients, options, plan
        self._poses: list[_Pose] = []
        self._twins_of: _Pose | None = None
        self._plane: Array | None = None
        self._judgement: Judgement | None = None
        self._take(evidence)

    def before_network(self) -> TwoViewModel | None:
        """The model of a list that explains itself; None where the network is wanted."""
        if len(self._evidence) < MIN_MATCHES or not self._evidence.calibrated:
            return None
        for proposal in self._plan.before:
            self._propose((proposal,))
            share = self._explained()
            if share < PROMISING:
                return None
            if share > CERTAIN:
                break
        self._propose_twins()
        model = self.current("before the network")
        judgement = None if model is None else model.judgement
        if model is None or judgement is None or not choice.explains_list(judgement, self._coefficients):
            return None
        same = self._twins_of is not None and _angle_deg(self._twins_of, self._best()) < TWIN_DEG
        return self._refined(replace(model, plane=self._plane) if same else model)

    def after_first_look(self, evidence: Evidence) -> TwoViewModel | None:
        """The model where the scores of a quick network settle it; None where a deeper one is wanted."""
        if len(evidence) < MIN_MATCHES or not evidence.calibrated or self._options.method != "auto":
            return None
        self._take(evidence)
        self._propose(self._plan.first)
        if not self._settled():
            return None
        self._propose_twins()
        return self._refined(self.current("first sources"))

    def with_network(self, evidence: Evidence) -> TwoViewModel | None:
        """The model by all sources, on scored matches; None where nothing is found."""
        self._take(evidence)
        if len(evidence) < MIN_MATCHES:
            return None
        if not evidence.calibrated:
            return self._fundamental()
        alone = ALONE.get(self._options.method)
        if alone is not None:
            self._poses = []
            self._propose((alone,))
            return self._refined(self.current("all sources"))
        self._propose(self._plan.first)
        ended = "first sources"
        poselib = self._options.method == "poselib"
        if poselib or not self._settled():
            ended = "all sources"
            if self._poses:
                self._propose_twins()
            known = {pose.origin for pose in self._poses}
            self._propose([proposal for proposal in self._plan.second if proposal.name not in known])
            self._propose((POSELIB,) if poselib else ())
        if self._poses:
            self._propose_twins()
        return self._expected(self._refined(self.current(ended)))

    def _take(self, evidence: Evidence) -> None:
        self._evidence, self._judgement = evidence, None
        self._judged = evidence.correspondences[evidence.once]
        fitted = evidence.listed
        if evidence.scores is not None:
            fitted = fitted | (evidence.scores > ACCEPTED_SCORE)
        fitted = fitted & evidence.once
        enough = np.count_nonzero(fitted) >= MIN_MATCHES
        self._fitted = evidence.correspondences[fitted] if enough else self._judged

    def _run(self, proposal: Proposal) -> list[Array]:
        """What a source proposes."""
        options = self._options
        iterations = min(proposal.iterations, options.max_iterations)
        seed = options.seed + proposal.number
        rough = proposal.rough and self._evidence.calibrated
        run = EstimatorOptions(proposal.method, proposal.threshold_px, options.confidence, iterations, seed, rough)
        return proposal.source(self._evidence, run)

    def _propose(self, proposals: Sequence[Proposal]) -> None:
        for proposal in proposals:
            for E in self._run(proposal):
                pose = pose_from_essential(E, self._fitted, self._evidence.focal_px)
                if pose is not None:
                    self._add(_Pose(*pose, proposal.family, proposal.name))

    def _propose_twins(self) -> None:
        """Under a dominant plane every pose has a twin that explains it as well: let both be judged."""
        if not self._plan.twins:
            return
        best = self._best()
        if self._twins_of is not None and _angle_deg(self._twins_of, best) < TWIN_DEG:
            return
        self._twins_of = best
        self._plane = sources.dominant_plane(self._evidence, best.R, best.t, self._options.seed)
        found = [pose_from_essential(E, self._fitted, self._evidence.focal_px) for E in sources.plane(self._plane)]
        twins = [_Pose(*pose, Family.PLANE, "plane") for pose in found if pose is not None]
        near = self._near([best, *twins], self._fitted, TWIN_PX)
        for twin, count in zip(twins, near[1:]):
            if count > TWIN_SHARE * near[0] and all(_angle_deg(twin, other) > TWIN_DEG for other in self._poses):
                self._add(twin)

    def _add(self, found: _Pose) -> None:
        """Refine what was found; what was found before is there refined."""
        for other in self._poses:
            if _angle_deg(found, other) < SAME_DEG:
                R, t = other.R, other.t
                break
        else:
            R, t = refine_pose(self._fitted, found.R, found.t, REFINE_PX / self._evidence.focal_px)
        self._poses.append(_Pose(R, t, found.family, found.origin))
        self._judgement = None

    def _near(self, poses: Sequence[_Pose], matches: Array, reach_px: float) -> list[int]:
        """Numbers of matches (N, 4) within a distance of each pose and in front of it."""
        R, t = np.stack([pose.R for pose in poses]), np.stack([pose.t for pose in poses])
        residuals = choice.measure_residuals(matches, R, t, self._evidence.focal_px)
        return [int(count) for count in residuals.explained(reach_px).sum(axis=1)]

    def _best(self) -> _Pose:
        """The best of what was found so far."""
        return self._poses[0 if len(self._poses) == 1 else self._judge().chosen]

    def _explained(self) -> float:
        """Share of the matches that the best of what was found explains."""
        if not self._poses:
            return 0.0
        inliers = self._near([self._best()], self._judged, choice.INLIER_PX)[0]
        return choice.explained_share(inliers, len(self._judged))

    def _settled(self) -> bool:
        """True where nothing more needs to be tried: unlike sources agree, or hope is lost.

        ``coefficients["settled"]``: number of other families that agree, confidence above which their agreement is
        enough, confidence below which more of the same has never helped.
        """
        if not self._poses or not self._plan.settle:
            return False
        families, certain, hopeless = self._coefficients["settled"]
        judgement = self._judge()
        confidence = choice.confidence(judgement, self._coefficients)
        agreed = judgement.features["other families within 2 deg"] >= families and confidence > certain
        return agreed or confidence < hopeless

    def _judge(self) -> Judgement:
        """Measure all hypotheses and choose; once as long as none is added."""
        if self._judgement is None:
            evidence = self._evidence
            hypotheses = Hypotheses(
                np.stack([pose.R for pose in self._poses]),
                np.stack([pose.t for pose in self._poses]),
                np.array([int(pose.family) for pose in self._poses]),
            )
            self._judgement = choice.judge(
                self._judged,
                None if evidence.scores is None else evidence.scores[evidence.once],
                hypotheses,
                evidence.focal_px,
                _poses_of_network(evidence),
                self._coefficients,
            )
        return self._judgement

    def current(self, ended: str = "") -> TwoViewModel | None:
        """The best of what was found so far, whatever it is worth; None where nothing was."""
        if not self._poses:
            return None
        judgement = self._judge()
        rate = choice.early_confidence if self._evidence.scores is None else choice.confidence
        pose = self._poses[judgement.chosen]
        E = essential_from_pose(pose.R, pose.t)
        confidence = rate(judgement, self._coefficients)
        return TwoViewModel(E, E, pose.R, pose.t, pose.origin, ended, confidence, judgement)

    def _refined(self, model: TwoViewModel | None) -> TwoViewModel | None:
        """The model after the last refinement: a match counts by its noise and by the probability that it is right.

        That is its score, more where most of the list agrees with the pose: then the list knows better.
        """
        if model is None or model.judgement is None or not self._plan.last_refinement:
            return model
        evidence = self._evidence
        weights = np.ones(len(self._judged))
        if evidence.scores is not None:
            share = np.exp(model.judgement.features["log share"])
            agreement = share**3 / (share**3 + (1.0 - share) ** 3)
            weights = 1.0 - (1.0 - evidence.scores[evidence.once]) * (1.0 - agreement)
        distance = model.judgement.distance_px
        inlier = distance < choice.INLIER_PX
        if not inlier.any():
            return model
        half_px = HALF_WEIGHT_MEDIANS * float(np.median(distance[inlier]))
        half_px = min(max(half_px, LEAST_HALF_WEIGHT_PX), HALF_WEIGHT_PX)
        pixel = 1.0 / evidence.focal_px
        scale = half_px * pixel * evidence.noise[evidence.once]
        moved = parallax(self._judged, model.R)
        still = moved <= LARGEST_PARALLAX_MEDIANS * float(np.median(moved[inlier]))
        R, t = refine_pose_by_weights(
            self._judged[still], model.R, model.t, scale[still], weights[still], LAST_REACH_PX * pixel
        )
        E = essential_from_pose(R, t)
        return replace(model, M=E, E=E, R=R, t=t)

    def _expected(self, model: TwoViewModel | None) -> TwoViewModel | None:
        """The model, and the pose that is expected to lie nearest to the truth, where that is another answer.

        Nothing is asked of many matches, nor of an answer that is sure, or hopeless.
        """
        evidence, scores = self._evidence, self._evidence.scores
        if model is None or model.judgement is None or model.confidence is None or scores is None:
            return model
        if len(self._judged) >= FEW_MATCHES:
            return model
        _, certain, hopeless = self._coefficients["settled"]
        if not self._plan.expected or not hopeless < model.confidence <= certain:
            return model
        R, t = np.stack([pose.R for pose in self._poses]), np.stack([pose.t for pose in self._poses])
        scale = model.judgement.scale
        found = expected_best(self._judged, scores[evidence.once], R, t, scale, evidence.focal_px, self._coefficients)
        if found is None or pose_error_deg(*found, model.R, model.t) < EXPECTED_DEG:
            return model
        return replace(model, expected=found)

    def agreed_fundamental(self) -> TwoViewModel | None:
        """The fundamental matrix of a list that explains itself; None where the network is wanted.

        Two runs agree on most of the matches and on the way that the epipolar lines take through them. It tells right
        matches apart as well as :meth:`with_network` does; a pose that is taken from it is less exact, for no score
        tells which of the few others to leave alone.
        """
        if len(self._evidence) < MIN_MATCHES:
            return None
        found = list[tuple[Array, str]]()
        distance = np.zeros((0, len(self._judged)))
        for proposal in self._plan.before:
            new = [(F, proposal.name) for F in self._run(proposal)]
            residuals = [sampson_distance(self._judged, F) * self._evidence.focal_px for F, _ in new]
            found, distance = found + new, np.vstack([distance, *residuals])
            least = max(CERTAIN * len(self._judged), AGREED_LEAST)
            if not new or np.count_nonzero(residuals[0] < AGREED_PX) <= least:
                return None
        near = distance < AGREED_PX
        both = near.all(axis=0)
        if np.count_nonzero(both) < AGREED_SHARE * np.count_nonzero(near.any(axis=0)):
            return None
        if epipolar_angle_deg(self._judged[both], found[0][0], found[1][0]) > AGREED_DEG:
            return None
        found += [(F, SECOND[1].name) for F in self._run(SECOND[1])]
        return self._likeliest(found, np.ones(len(self._judged)), "before the network")

    def _fundamental(self) -> TwoViewModel | None:
        """The fundamental matrix of a pair without intrinsics, and the pose that the guessed ones make of it.

        The same sources with F estimators. The choice is the likelihood alone: without intrinsics depths mean little.
        """
        evidence, method = self._evidence, self._options.method
        wanted = (ALONE[method],) if method in ALONE else (BEFORE_NETWORK[0], *FIRST[1:], *SECOND[1:3])
        if method == "poselib":
            wanted = (*wanted, POSELIB)
        found = [(F, proposal.name) for proposal in wanted for F in self._run(proposal)]
        return self._likeliest(found, np.asarray(evidence.scores)[evidence.once], "all sources") if found else None

    def _likeliest(self, found: Sequence[tuple[Array, str]], scores: Array, ended: str) -> TwoViewModel | None:
        """The model of the likeliest of fundamental matrices, by its matches' scores (N,)."""
        evidence = self._evidence
        distance = np.stack([sampson_distance(self._judged, F) for F, _ in found]) * evidence.focal_px
        probability = choice.prior(scores, self._coefficients)
        counts = choice.independent_counts(self._judged, scores, self._coefficients)
        residuals = Residuals(distance, np.zeros(distance.shape, dtype=bool))
        likelihood = choice.log_likelihoods(residuals, probability, self._coefficients, counts)
        F, origin = found[int(np.argmax(likelihood[:, int(np.argmax(likelihood.max(axis=0)))]))]
        E = project_to_essential(F)
        pose = pose_from_essential(F, evidence.correspondences, evidence.focal_px)
        return None if pose is None else TwoViewModel(F, E, *pose, origin, ended)


def epipolar_angle_deg(matches: Array, F1: Array, F2: Array) -> float:
    """Median angle, degrees, between the epipolar lines that two fundamental matrices (3, 3) give matches (N, 4)."""
    angles = []
    for points, A, B in ((matches[:, :2], F1, F2), (matches[:, 2:], F1.T, F2.T)):
        normals1, normals2 = (points @ F[:2, :2].T + F[:2, 2] for F in (A, B))
        cosine = np.abs((normals1 * normals2).sum(axis=1))
        cosine /= np.maximum(np.linalg.norm(normals1, axis=1) * np.linalg.norm(normals2, axis=1), 1e-300)
        angles.append(np.median(np.degrees(np.arccos(np.minimum(cosine, 1.0)))))
    return float(max(angles))


def scores_by_residuals(pair: PairInput, model: TwoViewModel, coefficients: Coefficients) -> NDArray[np.float32]:
    """Scores (M,) of a pair that ended before the network, from the residuals of its matches to the model."""
    valid, listed = pair.valid, listed_rows(pair.attributes, pair.valid)
    scores = np.zeros(len(valid), dtype=np.float32)
    matches = pair.correspondences[valid]
    if pair.calibrated:
        residuals = choice.measure_residuals(matches, model.R[None], model.t[None], pair.focal_px)
    else:  # depths mean little
        distance = sampson_distance(matches, model.M)[None] * pair.focal_px
        residuals = Residuals(distance, np.zeros(distance.shape, dtype=bool))
    scale = 1.0 if model.judgement is None else model.judgement.scale
    groups = (listed[valid], ~listed[valid])
    scores[valid] = choice.posterior(residuals, groups, scale, coefficients)
    return scores


def fit_alone(evidence: Evidence, method: str, threshold_px: float, options: FilterOptions) -> TwoViewModel | None:
    """One robust estimator on the list as it is, unrefined: what a classical pipeline does.

    Args:
        evidence: the list. method: as in :class:`EstimatorOptions`. threshold_px: of an inlier, pixels.
        options: confidence, largest number of iterations and seed count here.
    """
    run = EstimatorOptions(method, threshold_px, options.confidence, options.max_iterations, options.seed)
    found = sources.listed(evidence, run)
    if not found:
        return None
    M = found[0]
    pose = pose_from_essential(M, evidence.correspondences, evidence.focal_px)
    return None if pose is None else TwoViewModel(M, project_to_essential(M), *pose, method, "all sources")


def pose_from_essential(E: Array, correspondences: Array, focal_px: float) -> tuple[Array, Array] | None:
    """The pose of an essential matrix (3, 3) that puts most of the matches (N, 4) near it in front of both cameras.

    However far they are: ``cv2.recoverPose``, which takes five times as long, drops what is beyond its limit.
    """
    if not np.isfinite(E).all() or not np.any(E):
        return None
    near = correspondences[sampson_distance(correspondences, E) < REFINE_PX / focal_px]
    if len(near) == 0:
        return None
    poses = decompose_essential(E)
    R, t = np.stack([pose[0] for pose in poses]), np.stack([pose[1] for pose in poses])
    behind = choice.lie_behind(near, R, t, focal_px)
    return poses[int(np.argmin(behind.sum(axis=1)))]


def _poses_of_network(evidence: Evidence) -> tuple[Array, Array] | None:
    """R (4, 3, 3), t (4, 3): the poses that the network E allows, or None."""
    E = evidence.network_essential
    if E is None or not np.isfinite(E).all() or not np.any(E):
        return None
    R, t = zip(*decompose_essential(E))
    return np.stack(R), np.stack(t)


def _angle_deg(a: _Pose, b: _Pose) -> float:
    """Larger of the angles of rotation and of direction (sign ignored) between two poses."""
    cosine = min(0.5 * (float(np.vdot(a.R, b.R)) - 1.0), abs(float(a.t @ b.t)))
    return degrees(acos(max(-1.0, min(1.0, cosine))))
