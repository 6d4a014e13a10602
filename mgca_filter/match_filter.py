"""The public door: ``filter_matches`` and ``MatchFilter``; the flow of one pair, one call per step, in order."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .fit.evidence import FIRM_MATCHES, Evidence, gather_before, gather_scored
from .fit.focal_estimate import (
    FocalEstimate,
    agrees_as_well,
    confidence_under_estimate,
    estimate_focals,
    pose_sigma_deg,
)
from .fit.mirror import judge_mirror
from .fit.robust_fit import Search, TwoViewModel, scores_by_residuals
from .fit.verdict import Verdict, judge, judge_homography, too_few
from .geometry.cameras import Fisheye, mean_focal_length
from .geometry.epipolar import project_to_essential
from .inference import BACKENDS, Backend, ModelMetadata, shared_backend
from .inference.calibration import largest_set_of_precision
from .inference.scoring import (
    INVALID_LOGIT,
    NetworkInput,
    NetworkOutput,
    Opinion,
    prior_logits,
    run_network,
    select_network_input,
)
from .inputs.attributes import MatchAttributes
from .inputs.options import FilterOptions, check_choice, check_providers, method_name
from .inputs.pair import MatchPair, PairInput, prepare_pair
from .result import FilterResult, Status
from .types import MatchesLike, MatrixLike, PointsLike, Providers, SizeLike

_BATCH_PAIRS = 8
_log = logging.getLogger("mgca_filter")


PUBLISHED_MODELS = {"default": "mgca_small", "fast": "mgca_fast"}


def model_path(name: str = "default") -> Path:
    """Where the ONNX file of a published model lies: ``"default"``, or ``"fast"``, a network of one stage.

    The default filter asks the fast one first.

    Raises:
        ValueError: no model of this name is published.
    """
    if name not in PUBLISHED_MODELS:
        raise ValueError(f"model: expected one of {', '.join(PUBLISHED_MODELS)}, got {name!r}")
    return Path(__file__).resolve().parent / "models" / f"{PUBLISHED_MODELS[name]}.onnx"


def find_models(model: str | Path | None) -> tuple[Path, ...]:
    """The files of the networks that the option ``model`` means, in the order in which they are asked.

    None and ``"default"`` = a first look by the fast model, and the deep one where that does not settle a pair;
    ``"fast"``, or a path = this one alone.

    Raises:
        TypeError: neither a name nor a path.
    """
    if model is None or model == "default":
        return model_path("fast"), model_path("default")
    if isinstance(model, str) and model in PUBLISHED_MODELS:
        return (model_path(model),)
    if not isinstance(model, (str, Path)):
        raise TypeError(f"model: expected a path or a name, got {type(model).__name__}")
    return (Path(model),)


class MatchFilter:
    """The filter as an object that keeps its session, for loops and threads.

    Thread-safe; picklable, with the session reopened on the other side.

    Args:
        threshold, keep_precision, confidence, method, effort, geometry: as in :func:`filter_matches`.
        max_iterations, model, providers, backend, seed: likewise.

    Raises:
        TypeError, ValueError: an option is not one of the above.
        ModelError: the model file is missing, truncated or of another contract.
        BackendError: no runtime can be started.
        ImportError: ``method="poselib"`` without PoseLib.
    """

    def __init__(
        self,
        *,
        threshold: float = FilterOptions.threshold,
        keep_precision: float | None = FilterOptions.keep_precision,
        confidence: float = FilterOptions.confidence,
        method: str | int = FilterOptions.method,
        effort: str = FilterOptions.effort,
        geometry: str = FilterOptions.geometry,
        max_iterations: int = FilterOptions.max_iterations,
        model: str | Path | None = None,
        providers: Providers | None = None,
        backend: str = "auto",
        seed: int = FilterOptions.seed,
    ) -> None:
        check_choice(backend, BACKENDS, "backend")
        self.options = FilterOptions(
            threshold=threshold,
            keep_precision=keep_precision,
            confidence=confidence,
            method=method_name(method),
            effort=effort,
            geometry=geometry,
            max_iterations=max_iterations,
            seed=seed,
        )
        asked = check_providers(providers)
        self._backends = tuple(shared_backend(path, backend, asked) for path in find_models(model))

    @classmethod
    def over(cls, *backends: Backend, options: FilterOptions | None = None) -> MatchFilter:
        """A filter over backends that are open already, the deepest last, such as a network that is being trained."""
        match_filter = cls.__new__(cls)
        match_filter.options = FilterOptions() if options is None else options
        match_filter._backends = backends
        return match_filter

    @property
    def metadata(self) -> ModelMetadata:
        """What the model file says of itself; of several networks the deepest's."""
        return self._backends[-1].metadata

    def filter(
        self,
        kp1: PointsLike,
        kp2: PointsLike,
        matches: MatchesLike | None,
        *,
        K1: MatrixLike | None = None,
        K2: MatrixLike | None = None,
        dist1: ArrayLike | Fisheye | None = None,
        dist2: ArrayLike | Fisheye | None = None,
        size1: SizeLike | None = None,
        size2: SizeLike | None = None,
        attributes: MatchAttributes | None = None,
        K: MatrixLike | None = None,
        resolution: float = 1.0,
    ) -> FilterResult:
        """Filter the matches of one pair; arguments, result and errors as in :func:`filter_matches`."""
        K1 = _shared_intrinsics(K, K1, K2)
        pair = MatchPair(kp1, kp2, matches, K1, K2, dist1, dist2, size1, size2, attributes, resolution)
        return self.filter_many([pair])[0]

    @np.errstate(all="ignore")  # data never raises, whatever the caller's numpy.seterr says
    def filter_many(self, pairs: Iterable[MatchPair | tuple[Any, Any, Any]]) -> list[FilterResult]:
        """Filter many pairs; those that send equally many matches go through a network in one batch.

        Args:
            pairs: :class:`MatchPair` objects or tuples ``(kp1, kp2, matches)``.

        Returns:
            One result per pair, in their order; equal to single calls up to the rounding of the batched network.

        Raises:
            As :func:`filter_matches`.
        """
        jobs = [self._start(pair, index) for index, pair in enumerate(pairs)]
        for number, backend in enumerate(self._backends, 1):
            waiting = [job for job in jobs if job.sent is not None]
            self._ask(backend, waiting)
            for job in waiting:
                self._weigh(job, backend, last=number == len(self._backends))
        return [self._finish(job) for job in jobs]

    @np.errstate(all="ignore")
    def filter_list(self, pair: MatchPair | tuple[Any, Any, Any]) -> FilterResult | None:
        """Filter a pair whose matches explain themselves; None where a network is wanted, or was asked for.

        With intrinsics the answer is that of :meth:`filter_many`. Without, its mask is as good, where two fits of the
        fundamental matrix agree, but there is no pose, and F is less exact: for those who want matches in little time.

        Raises:
            As :func:`filter_matches`.
        """
        job = self._start(pair, 0, list_alone=True)
        return None if job.model is None else self._finish(job)

    def _start(self, pair: MatchPair | tuple[Any, Any, Any], index: int, list_alone: bool = False) -> _Job:
        """Steps 1 and 2: read the pair; choose what enters the first network, if any, unless there shall be none."""
        started = time.perf_counter()
        if isinstance(pair, tuple) and len(pair) == 3:
            pair = MatchPair(*pair)
        if not isinstance(pair, MatchPair):
            raise TypeError(f"pairs[{index}]: expected MatchPair or (kp1, kp2, matches), got {type(pair).__name__}")
        prepared = prepare_pair(pair)
        given = prepared.calibrated
        if self.options.geometry == "essential" and not given:
            raise ValueError("K1: geometry='essential' needs the intrinsics")
        if self.options.geometry == "fundamental":
            camera1, camera2 = (replace(c, guessed=True) for c in (prepared.intrinsics1, prepared.intrinsics2))
            prepared = replace(prepared, intrinsics1=camera1, intrinsics2=camera2)
        job = _Job(prepared, given, timings_ms={"prepare": _milliseconds_since(started)})
        started = time.perf_counter()
        if self.options.method != "none":
            job.evidence = gather_before(prepared)
            if self.options.geometry != "homography":
                job.search = Search(job.evidence, self.metadata.choice, self.options)
                if self.options.method == "auto" and self.options.effort == "auto":
                    job.model = job.search.before_network()
                    if list_alone and not prepared.calibrated:
                        job.model = job.search.agreed_fundamental()
            job.timings_ms["fit"] = _milliseconds_since(started)
        if job.model is None and not list_alone:
            job.sent = select_network_input(
                prepared.correspondences, prepared.attributes, prepared.valid, self._backends[0], self.options.seed
            )
            job.rows = job.sent.rows
        return job

    def _ask(self, backend: Backend, jobs: list[_Job]) -> None:
        """Step 3: what a network says of the pairs that wait for it."""
        by_count: dict[int, list[_Job]] = {}
        for job in jobs:
            if job.sent is not None and len(job.sent.rows):
                by_count.setdefault(len(job.sent.rows), []).append(job)
        for group in by_count.values():
            for first in range(0, len(group), _BATCH_PAIRS):
                self._run_batch(backend, group[first : first + _BATCH_PAIRS])

    def _run_batch(self, backend: Backend, jobs: list[_Job]) -> None:
        """One forward pass."""
        started = time.perf_counter()
        outputs = run_network(backend, [job.sent for job in jobs if job.sent is not None])
        elapsed = _milliseconds_since(started) / len(jobs)
        for job, output in zip(jobs, outputs):
            job.output = output
            job.timings_ms["network"] = job.timings_ms.get("network", 0.0) + elapsed

    def _weigh(self, job: _Job, backend: Backend, last: bool) -> None:
        """Steps 4 and 5: scores and robust fit; or what a deeper network shall see, where they settle nothing."""
        pair, sent = job.pair, job.sent
        assert sent is not None
        job.asked.append(backend.metadata.name)
        if job.opinion is None:
            job.opinion = self._prior_opinion(pair, sent)
        if job.output is not None:
            job.opinion = job.opinion.joined(Opinion.of(job.output.finite_logits, backend.metadata), sent.rows)
        if last or self.options.effort == "auto":
            self._fit(job, last)
        job.sent = None if last or job.model is not None else sent[job.opinion.undecided(sent.rows)]

    def _finish(self, job: _Job) -> FilterResult:
        """Steps 6 and 7: re-test of all matches, verdict."""
        pair = job.pair  # under another focal length now, where that was estimated
        if job.opinion is not None:
            logits = job.opinion.margins + np.float32(self.metadata.decision_threshold)
            scores = self._scores(job)
        else:
            assert job.model is not None
            logits, scores = self._score_by_residuals(pair, job.model)
        started = time.perf_counter()
        verdict = self._judge(job, scores)
        job.timings_ms["verdict"] = _milliseconds_since(started)
        return FilterResult(
            mask=verdict.mask,
            scores=scores,
            matches=pair.matches.select(verdict.mask),
            E=verdict.E,
            F=verdict.F,
            R=verdict.R,
            t=verdict.t,
            H=verdict.H,
            status=verdict.status,
            num_inliers=int(np.count_nonzero(verdict.mask)),
            confidence=None if verdict.t is None or job.model is None else job.model.confidence,
            points1=pair.points1,
            points2=pair.points2,
            indices=np.stack([pair.matches.index1, pair.matches.index2], axis=1),
            info={
                **self._describe(job),
                "assumptions": [*self._assumptions(job), *self._remarks(verdict, scores)],
                "logits": logits,
                "num_accepted": int(np.count_nonzero(logits > self.metadata.decision_threshold)),
                **verdict.info,
            },
        )

    def _judge(self, job: _Job, scores: NDArray[np.float32]) -> Verdict:
        """The verdict on the model, and what stays of it where nobody knows the intrinsics."""
        pair, options = job.pair, self.options
        if job.evidence is None:
            return _verdict_by_scores(pair, self._keep_by_scores(pair, scores))
        threshold_px, choice = pair.threshold_px(options.threshold), self.metadata.choice
        if options.geometry == "homography":
            verdict = judge_homography(pair, job.evidence, threshold_px, options)
        else:
            verdict = judge(pair, job.model, job.evidence, threshold_px, choice, options)
        if job.focal is not None and verdict.status is Status.SUSPICIOUS_INTRINSICS:
            # The intrinsics are nobody's claim.
            verdict = replace(verdict, status=Status.LOW_SUPPORT if verdict.H is None else Status.PLANAR)
        if job.focal is not None and verdict.status is Status.PLANAR:
            verdict = replace(verdict, E=None, R=None, t=None)  # a plane tells no focal length
        if not job.given and job.focal is None and options.geometry == "auto" and verdict.t is not None:
            verdict = replace(verdict, E=None, R=None, t=None)  # nor do matches that no focal length explains
        verdict = judge_mirror(pair, job.evidence, verdict, threshold_px, options)
        if verdict.t is not None:
            verdict = self._doubt_focals(job, verdict)
        found = any(model is not None for model in (verdict.F, verdict.R, verdict.H))
        if options.keep_precision is not None and found:
            verdict = replace(verdict, mask=self._keep_by_scores(pair, scores))
        return verdict

    def _doubt_focals(self, job: _Job, verdict: Verdict) -> Verdict:
        """The verdict on a pose that is no surer than its focal lengths; the matches are not in doubt with it."""
        if job.focal is None or job.model is None or job.model.confidence is None or job.evidence is None:
            return verdict
        sigma_deg = pose_sigma_deg(job.evidence, job.model, job.focal)
        confidence = confidence_under_estimate(job.model.confidence, sigma_deg)
        info = {**verdict.info, "focal_sigma_deg": sigma_deg, "fitted_confidence": job.model.confidence}
        job.model = replace(job.model, confidence=confidence)
        _, usable = self.metadata.choice["verdict"]
        if verdict.status is Status.OK and confidence < usable:
            return replace(verdict, status=Status.LOW_SUPPORT, info={**info, "focal_doubt": True})
        return replace(verdict, info=info)

    def _remarks(self, verdict: Verdict, scores: NDArray[np.float32]) -> list[str]:
        """Sentences on what may surprise about the answer."""
        remarks = []
        if verdict.info.get("mirrored"):
            remarks.append("one of the images is mirrored: the matches agree with a view that no camera has")
        asked = self.options.keep_precision
        if (
            asked is not None
            and not verdict.mask.any()
            and any(m is not None for m in (verdict.F, verdict.R, verdict.H))
        ):
            best = float(scores.max(initial=0.0))
            remarks.append(
                f"keep_precision={asked:g} keeps no match, for the best score is {best:.2f}: the status speaks of the "
                "geometry alone; a threshold keeps what agrees with it"
            )
            _log.warning("%s", remarks[-1])
        return remarks

    def _prior_opinion(self, pair: PairInput, sent: NetworkInput) -> Opinion:
        """The mean of the networks' priors, of the matches that enter none of them."""
        unseen = pair.valid.copy()
        unseen[sent.rows] = False
        models = [backend.metadata for backend in self._backends]
        return Opinion.mean([Opinion.of(prior_logits(pair.attributes, unseen, model), model) for model in models])

    def _scores(self, job: _Job) -> NDArray[np.float32]:
        """Scores (M,) by the networks that were asked."""
        assert job.opinion is not None
        return np.where(job.pair.valid, job.opinion.scores, np.float32(0.0))

    def _fit(self, job: _Job, last: bool) -> None:
        """The model on what the network saw; unless no deeper one is left, where that settles it alone."""
        if job.evidence is None:
            return
        assert job.opinion is not None
        started = time.perf_counter()
        scores, margins = self._scores(job), job.opinion.margins
        evidence = gather_scored(job.pair, job.rows, scores, margins, job.network_essential)
        if job.search is not None:
            job.model = job.search.with_network(evidence) if last else job.search.after_first_look(evidence)
        job.evidence = evidence
        if job.model is not None and not job.given and self.options.geometry == "auto":
            self._fit_under_estimated_focal(job, scores, margins)
        job.timings_ms["fit"] += _milliseconds_since(started)

    def _fit_under_estimated_focal(self, job: _Job, scores: NDArray[np.float32], margins: NDArray[np.float32]) -> None:
        """A second fit, of an essential matrix, where the matches tell the focal length that was guessed."""
        assert job.model is not None
        assert job.evidence is not None
        for estimate in estimate_focals(job.evidence, job.model.M):
            pair = job.pair.with_focals(*estimate.factors)
            zoom1, zoom2 = (np.diag([factor, factor, 1.0]) for factor in estimate.factors)
            E = None if job.network_essential is None else project_to_essential(zoom2 @ job.network_essential @ zoom1)
            evidence = gather_scored(pair, job.rows, scores, margins, E)
            search = Search(gather_before(pair), self.metadata.choice, self.options)
            model = search.with_network(evidence)
            if model is not None and agrees_as_well(evidence, model, job.evidence, job.model):
                job.pair, job.evidence, job.model, job.focal = pair, evidence, model, estimate
                return

    def _score_by_residuals(
        self, pair: PairInput, model: TwoViewModel
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The same (M,), (M,) of a pair that needed no network: how likely each residual is among right matches."""
        metadata = self.metadata
        scores = scores_by_residuals(pair, model, metadata.choice)
        return np.where(pair.valid, metadata.calibration.logits(scores), np.float32(INVALID_LOGIT)), scores

    def _keep_by_scores(self, pair: PairInput, scores: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Mask (M,) that asks the network alone."""
        if self.options.keep_precision is None:
            return (scores > 0.5) & pair.valid
        kept = np.zeros(len(scores), dtype=bool)
        kept[pair.valid] = largest_set_of_precision(scores[pair.valid], self.options.keep_precision)
        return kept

    def _assumptions(self, job: _Job) -> list[str]:
        """Sentences on what was assumed of the cameras."""
        if job.focal is None:
            return list(job.pair.assumptions)
        focals = [
            f"focal length {focal:.0f} px of {{}} estimated from the matches, to {100 * sigma:.0f} %"
            for focal, sigma in zip(job.focal_px, job.focal.sigmas)
        ]
        if job.focal_px[0] == job.focal_px[1]:
            return [*job.pair.assumptions, focals[0].format("both images")]
        return [*job.pair.assumptions, *(text.format(f"image {i}") for i, text in enumerate(focals, 1))]

    def _describe_cameras(self, job: _Job) -> dict[str, Any]:
        """Where the intrinsics come from."""
        if job.focal is None:
            return {"intrinsics": "given" if job.given else "guessed"}
        return {"intrinsics": "estimated", "focal_px": job.focal_px, "focal_sigma": job.focal.sigmas}

    def _describe(self, job: _Job) -> dict[str, Any]:
        job.timings_ms["total"] = sum(job.timings_ms.values())
        answer = None if job.model is None else job.model.answer
        return {
            "timings_ms": job.timings_ms,
            "backend": self._backends[-1].name,
            "model": " + ".join(backend.metadata.name for backend in self._backends),
            "model_sha256": " + ".join(backend.metadata.sha256 for backend in self._backends),
            "networks": job.asked,
            **self._describe_cameras(job),
            "num_network_matches": len(job.rows),
            "network_rows": job.rows,
            "network_essential": job.network_essential,
            "fitted_essential": None if answer is None else answer.E,
            "origin": None if answer is None else answer.origin,
            "ended": None if answer is None else answer.ended,
        }


@dataclass
class _Job:
    """One pair on its way through the steps."""

    pair: PairInput
    given: bool
    timings_ms: dict[str, float]
    evidence: Evidence | None = None
    search: Search | None = None
    model: TwoViewModel | None = None
    sent: NetworkInput | None = None  # to the network that is asked next
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))  # sent to the first one
    output: NetworkOutput | None = None
    opinion: Opinion | None = None
    asked: list[str] = field(default_factory=list)
    focal: FocalEstimate | None = None

    @property
    def focal_px(self) -> tuple[float, float]:
        """Focal lengths of both images in the caller's unit."""
        camera1, camera2 = self.pair.intrinsics1.K, self.pair.intrinsics2.K
        return (
            mean_focal_length(camera1, camera1) / self.pair.unit_px,
            mean_focal_length(camera2, camera2) / self.pair.unit_px,
        )

    @property
    def network_essential(self) -> NDArray[np.float32] | None:
        """The network E (3, 3), where one was asked."""
        return None if self.output is None else self.output.essential


def filter_matches(
    kp1: PointsLike,
    kp2: PointsLike,
    matches: MatchesLike | None,
    *,
    K1: MatrixLike | None = None,
    K2: MatrixLike | None = None,
    dist1: ArrayLike | Fisheye | None = None,
    dist2: ArrayLike | Fisheye | None = None,
    size1: SizeLike | None = None,
    size2: SizeLike | None = None,
    threshold: float = FilterOptions.threshold,
    keep_precision: float | None = FilterOptions.keep_precision,
    confidence: float = FilterOptions.confidence,
    method: str | int = FilterOptions.method,
    effort: str = FilterOptions.effort,
    geometry: str = FilterOptions.geometry,
    max_iterations: int = FilterOptions.max_iterations,
    attributes: MatchAttributes | None = None,
    K: MatrixLike | None = None,
    resolution: float = 1.0,
    model: str | Path | None = None,
    providers: Providers | None = None,
    backend: str = "auto",
    seed: int = FilterOptions.seed,
) -> FilterResult:
    """Tell right matches from wrong ones and estimate the two-view geometry.

    Pixels follow OpenCV (the centre of the top-left pixel is (0, 0)); ``x2^T E x1 = 0``, ``X2 = R X1 + t``.

    Args:
        kp1, kp2: ``cv2.KeyPoint`` objects in any container that keeps an order, or arrays (N, 2), (N, 1, 2) or
            (1, N, 2) of pixels.
        matches: ``cv2.DMatch`` objects; ``knnMatch`` output, whose second candidates give the ratio; an integer
            array (M, 2); or None = row i matches row i. What matches and keypoints know beyond position (ratio,
            best of the list, size, angle) is used and never required.
        K1, K2: (3, 3) intrinsics; ``K1`` alone means that both images share it. Without, the focal lengths are
            estimated from the matches, one or, where they ask for it, two (``info["focal_px"]``, with
            ``info["focal_sigma"]``); where that fails F comes without E, R and t.
        dist1, dist2: OpenCV distortion coefficients: an array of 4, 5, 8, 12 or 14 is of the pinhole model,
            ``Fisheye(k1, k2, k3, k4)`` of ``cv2.fisheye``. E and F then hold for undistorted points, the threshold for
            the pixels that came in.
        size1, size2: (width, height), pixels; they help the guess of missing intrinsics.
        threshold: inlier threshold of the mask, pixels (Sampson distance); the fit has its own.
        keep_precision: instead of a threshold: the mask holds the most matches whose expected precision, the mean of
            their scores, is at least this (above 0, below 1), whatever their distance to the model. All False where
            there is no model, as ever, and where no score is so high, which ``info["assumptions"]`` then says.
        confidence: of the robust fit, between 0 and 1.
        method: robust fit: ``"auto"``, several unlike estimators and the most likely of what they find;
            ``"poselib"``, PoseLib's (needs that package) among them; ``"prosac"``, ``"magsac"``, ``"ransac"`` (or
            ``cv2.USAC_PROSAC``, ``cv2.USAC_MAGSAC``, ``cv2.RANSAC``), that one alone on what the network accepts; or
            ``"none"``, which returns scores and a mask of scores above 0.5 (or by ``keep_precision``), no geometry.
        effort: ``"auto"`` leaves the networks out where a run on the list alone explains it, and takes the scores from
            the residuals; ``"full"`` always runs them all.
        geometry: ``"auto"``: an essential matrix where intrinsics are given, else a fundamental matrix, and a
            homography beside or instead of it where that explains the pair; ``"essential"`` demands the intrinsics;
            ``"fundamental"`` does not let them constrain the model; ``"homography"`` fits one and no more.
        max_iterations: largest number of samples that one run of a robust estimator draws.
        attributes: what the caller knows of each match in arrays (M,); overrides what was read, field by field.
        K: another way to say that both images share ``K1``.
        resolution: pixels of the original per pixel of the image in which the keypoints were found: the factor by which
            coordinates that were found in a smaller copy were multiplied, the larger of the two images'. ``threshold``,
            and the pixels by which the fit judges, are then those of the copy.
        model: ``"default"``: the fast network, and the deep one where that does not settle the pair; ``"fast"``: a
            network of one stage alone, for video; or the path of a model file (``.onnx`` or ``.safetensors``), that one
            alone. None = the default.
        providers: ONNX Runtime's execution providers; one that fails gives way to the CPU with one warning.
        backend: ``"auto"``, ``"onnxruntime"``, ``"opencv"`` (OpenCV 5) or ``"torch"``.
        seed: of every random choice; same seed, input and machine give the same bits.

    Returns:
        Mask, scores, kept matches, E, F, R, t and a status. Data never raises: where there is no geometry the
        status says why, the mask is all False and the matrices are None.

    Raises:
        TypeError, ValueError: an argument is of another type, shape, length or range; the message names it.
        ModelError: the model file is missing, truncated or of another contract.
        BackendError: no runtime can be started, or it refused.
        ImportError: ``method="poselib"`` without PoseLib.
    """
    match_filter = MatchFilter(
        threshold=threshold,
        keep_precision=keep_precision,
        confidence=confidence,
        method=method,
        effort=effort,
        geometry=geometry,
        max_iterations=max_iterations,
        model=model,
        providers=providers,
        backend=backend,
        seed=seed,
    )
    return match_filter.filter(
        kp1,
        kp2,
        matches,
        K1=K1,
        K2=K2,
        dist1=dist1,
        dist2=dist2,
        size1=size1,
        size2=size2,
        attributes=attributes,
        K=K,
        resolution=resolution,
    )


def filter_many(pairs: Iterable[MatchPair | tuple[Any, Any, Any]], **options: Any) -> list[FilterResult]:
    """Filter many pairs with the options of :class:`MatchFilter`; see :meth:`MatchFilter.filter_many`."""
    return MatchFilter(**options).filter_many(pairs)


def _shared_intrinsics(K: MatrixLike | None, K1: MatrixLike | None, K2: MatrixLike | None) -> MatrixLike | None:
    """``K1``, or ``K`` in its place."""
    if K is None:
        return K1
    if K1 is not None or K2 is not None:
        raise ValueError("K: both images share it, so that K1 and K2 cannot be given as well")
    return K


def _verdict_by_scores(pair: PairInput, kept: NDArray[np.bool_]) -> Verdict:
    """Answer without a robust fit: the mask is the network's opinion, and there is no geometry to judge."""
    if too_few(pair):
        return Verdict(Status.TOO_FEW_MATCHES, np.zeros_like(kept))
    return Verdict(Status.OK if np.count_nonzero(kept) >= FIRM_MATCHES else Status.LOW_SUPPORT, kept)


def _milliseconds_since(started: float) -> float:
    return 1000.0 * (time.perf_counter() - started)
