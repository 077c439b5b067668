"""One body fitted to the pictures of several cameras at once.

A joint that one camera can't see, a view that names left what is right, a landmark that jumps to
the load: joint by joint none of these can be told from a true position, but a body of constant
size that moves smoothly on the floor leaves little choice. So the pictures are not intersected;
the figure of the solver `least-squares` is fitted to the landmarks of all views and all frames,
each as certain as its picture allows.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_dilation, binary_propagation

from engine.datatypes import (
    Array,
    Camera,
    JointAngles,
    KinematicFit,
    Measurement,
    PoseTrack,
    Status,
    Subject,
    ViewPose,
)
from engine.errors import DataError, ShapeError
from engine.kinematics.fitting._banded import make_roughness
from engine.kinematics.fitting._clip import ROOT, ClipFit, fit_clip
from engine.kinematics.fitting._initial import (
    find_reversed,
    guess_angles,
    guess_root,
    interpolate_missing,
)
from engine.kinematics.fitting._report import find_state_errors, read_angles
from engine.kinematics.fitting.base import require_world_metres
from engine.kinematics.fitting.least_squares import (
    MIN_POINTS,
    REFINED_LENGTHS,
    WAIST_FLOOR_DEG,
    TrackFit,
    choose_points,
    find_quick_share,
    fit_nothing,
    make_body,
    make_priors,
    roughness_weight,
    warn_of_fit,
)
from engine.kinematics.fusion._depth import believe_depths
from engine.kinematics.fusion._feet import find_standing_places
from engine.kinematics.fusion._noise import find_hidden, landmark_sigma_m
from engine.kinematics.fusion._pictures import PictureProblem, turn_to_model_axes
from engine.kinematics.fusion._result import (
    DEFINITION_DEG,
    DEFINITION_M,
    OTHER_DEFINITION_DEG,
    OTHER_DEFINITION_M,
    carry_along,
    part_of,
    place_points,
    point_variance,
)
from engine.kinematics.fusion._sight import Sight, find_exchanged, list_exchanges, look_at
from engine.kinematics.humanoid.lengths import (
    SegmentLengths,
    estimate_segment_lengths,
    prior_sigma_m,
)
from engine.kinematics.humanoid.model import ANGLE_VARIABLES, to_model_axes, to_world_axes
from engine.kinematics.humanoid.tree import Tree
from engine.optics import camera_centre, project, to_camera_axes
from engine.skeletons import Skeleton, get_skeleton

__all__ = ["FusedFit", "FusionSettings", "fuse_views"]

TWISTS = ("phi_ws", "psi_ws")
FIGURE_SIGMA_M: Mapping[str, float] = {"shoulder": 0.020, "hip": 0.010}
OTHER_FIGURE_SIGMA_M = 0.005
"""How far a joint is from where a figure of rigid segments has it."""
MIN_SIGMA_PX = 1.0
MIN_DEPTH_M = 0.3
DOUBTFUL_MISFIT, POOR_MISFIT = 4.0, 2.0
"""Misfit of a frame, as a multiple of the usual one, from which its names are in doubt, and those
of the frames next to it."""
MAX_DOUBTFUL_SHARE = 0.6
ASTRAY = 4.0
"""Standard errors from the figure beyond which a landmark counts as rejected."""
MAX_BRIDGED_S = 0.5


@dataclass(frozen=True, eq=False)
class FusedFit:
    """A body fitted to several views.

    Parameters
    ----------
    track
        World metres: the figure's joints where it has them, drawn towards the landmarks as far as
        a body allows; fingers and face go along with wrist and nose, as far from them as the start
        had them. NaN where no view shows the person for longer than a moment.
    fit
        Joint angles with standard errors, and the body model.
    reprojection_px
        Shape (V, T, K): how far the landmark is from the track's projection; NaN where either is
        missing. Exchanged names are put right before.
    rejected
        Shape (V, T, K): landmarks too far off to count.
    """

    track: PoseTrack
    fit: KinematicFit
    reprojection_px: Array
    rejected: NDArray[np.bool_]


@dataclass(frozen=True)
class FusionSettings:
    """What the fit assumes; parts can be switched off to see what they are worth.

    Parameters
    ----------
    smoothness, root_smoothness
        Power density of the acceleration that is expected of angles, rad^2/s^3, and of the pelvis,
        m^2/s^3.
    waist_share, waist_sigma
        Share of the waist in the pitch of the trunk, and its standard deviation.
    twist_sigma_deg
        Standard deviation of the trunk's bend to the side and its turn against the pelvis.
    softness
        Distance in standard errors from which a landmark counts less.
    weighs_landmarks, looks_behind
        Whether a landmark's error depends on its kind and confidence, and on what hides it.
    believes_depths, refines_lengths, stands, puts_names_right
        Whether the network's depths are used, segment lengths refined, resting feet held in
        place, and exchanged names put right.
    """

    smoothness: float = 10.0
    root_smoothness: float = 0.5
    waist_share: float = 0.6
    waist_sigma: float = 0.2
    twist_sigma_deg: float = 12.0
    softness: float = 2.5
    weighs_landmarks: bool = True
    looks_behind: bool = True
    believes_depths: bool = True
    refines_lengths: bool = True
    stands: bool = True
    puts_names_right: bool = True


def fuse_views(
    views: Sequence[ViewPose],
    cameras: Sequence[Camera],
    track: PoseTrack,
    subject: Subject,
    *,
    settings: FusionSettings | None = None,
) -> FusedFit:
    """Fit one body to the landmarks of all views.

    Parameters
    ----------
    views
        What each camera shows, at the same times as `track`; NaN where a view lacks a landmark.
    cameras
        One a view, in the trial's world: Y up, floor at height 0.
    track
        World metres: a first guess of the joints, such as their triangulation.
    subject
        The stature guides the segment lengths.
    settings
        What the fit assumes; the defaults if None.

    Returns
    -------
    FusedFit
        Track, angles and what each view contributed.

    Raises
    ------
    ShapeError
        If views, cameras and track don't belong together.
    UnitError
        If the track is not in world metres.
    """
    _require_together(views, cameras, track)
    return _Fusion(views, cameras, track, subject, settings or FusionSettings()).run()


def _require_together(
    views: Sequence[ViewPose], cameras: Sequence[Camera], track: PoseTrack
) -> None:
    require_world_metres(track)
    if not views or len(views) != len(cameras):
        raise ShapeError(
            f"Every view needs its camera, got {len(views)} views and {len(cameras)} cameras; "
            "give one camera a view, in the same order."
        )
    for view in views:
        if view.image.skeleton != track.skeleton:
            raise DataError(
                f"Views and track need the same skeleton, got {view.image.skeleton!r} and "
                f"{track.skeleton!r}; estimate both from the same backend."
            )
        same = view.image.time_s.shape == track.time_s.shape
        if not same or not np.allclose(view.image.time_s, track.time_s, rtol=0, atol=1e-3):
            raise ShapeError(
                f"Views and track need the same times, got {view.image.n_frames} and "
                f"{track.n_frames} frames that don't agree; bring the views to common times first."
            )


class _Fusion:
    """The steps of one fusion, and what they share."""

    def __init__(
        self,
        views: Sequence[ViewPose],
        cameras: Sequence[Camera],
        track: PoseTrack,
        subject: Subject,
        settings: FusionSettings,
    ) -> None:
        self.cameras, self.track, self.subject, self.settings = cameras, track, subject, settings
        self.skeleton: Skeleton = get_skeleton(track.skeleton)
        self.names = choose_points(track.skeleton)
        self.columns = [self.skeleton.index(name) for name in self.names]
        self.sight = look_at(views)
        self.own_cameras = tuple(turn_to_model_axes(camera) for camera in cameras)
        self.exchanged = np.zeros((len(views), track.n_frames), dtype=np.intp)

    @property
    def time_s(self) -> Array:
        """Times of the frames."""
        return self.track.time_s

    def run(self) -> FusedFit:
        """Guess, fit, put names right, fit again with what the first fit showed."""
        points = self._start_points()
        shown = np.isfinite(self.sight.choose(self.columns).pixel).all(axis=3).any(axis=0)
        if points is None or (shown.sum(axis=0) >= MIN_POINTS).sum() == 0:
            return self._nothing()
        problem, start = self._pose_problem(points)
        fit = self._fit(problem, start)
        if self.settings.puts_names_right:
            fit = self._put_names_right(fit)
        for _ in range(2):
            fit = self._fit(replace(self._look_again(fit), is_fading=True), fit.state)
        return self._report(fit)

    # ------------------------------------------------------------------------- the problem

    def _start_points(self) -> dict[str, Array] | None:
        """Return the first guess of every point, (T, 3) in the figure's axes; None without any."""
        target = to_model_axes(self.track.position[:, self.columns])
        points = {name: target[:, i] for i, name in enumerate(self.names)}
        if not all(f"{side}_{part}" in points for side in ("left", "right") for part in _TORSO):
            return None
        target[find_reversed(points, self.time_s)] = np.nan
        return points if np.isfinite(target).all(axis=2).any() else None

    def _pose_problem(self, points: Mapping[str, Array]) -> tuple[PictureProblem, Array]:
        settings, time_s = self.settings, self.time_s
        tree = Tree(self.names, by_vector=("shoulder_l", "shoulder_r"))
        angles = guess_angles(points, time_s, waist_share=settings.waist_share)
        start = np.concatenate([guess_root(points, time_s), angles[list(tree.variables)]]).T
        mean, prior_weight = make_priors(tree, start)
        for i, place in enumerate(tree.variables, start=ROOT):
            if ANGLE_VARIABLES[place].name in TWISTS:
                prior_weight[i] = np.radians(settings.twist_sigma_deg) ** -2
        pitch = angles[0] + angles[3]
        waist_variance = np.radians(WAIST_FLOOR_DEG) ** 2 + (settings.waist_sigma * pitch) ** 2
        lengths = estimate_segment_lengths(self.track, self.subject.stature)
        empty = np.zeros((len(self.names), time_s.size))
        rough = roughness_weight(tree, time_s.size, settings.smoothness, settings.root_smoothness)
        problem = PictureProblem(
            tree=tree,
            target=np.zeros((len(self.names), 3, time_s.size)),
            weight=empty,
            lengths=lengths.as_dict(),
            roughness=make_roughness(time_s, rough),
            prior_mean=mean,
            prior_weight=prior_weight,
            waist_share=settings.waist_share,
            waist_weight=1.0 / waist_variance,
            huber=2.5,
            softness=settings.softness,
            cameras=self.own_cameras,
            pixel=np.zeros((len(self.cameras), *empty.shape, 2)),
            pixel_weight=np.zeros((len(self.cameras), *empty.shape)),
        )
        problem = self._look(problem, start)
        views_points = (-1, time_s.size)
        quick = find_quick_share(
            np.moveaxis(problem.pixel.reshape(*views_points, 2), 1, 2),
            problem.pixel_weight.reshape(views_points),
        )
        # Smoothing is only worth what quick noise costs; errors that last are no smoother for it.
        return replace(problem, roughness=make_roughness(time_s, rough * quick)), start

    def _look(self, problem: PictureProblem, state: Array) -> PictureProblem:
        """Weigh what the pictures show, the figure being about here."""
        placed = problem.place(state)
        sight = self.sight.choose(self.columns)
        pixel_weight = self._weigh(sight, placed)
        problem = replace(problem, pixel=np.nan_to_num(sight.pixel), pixel_weight=pixel_weight)
        if not self.settings.believes_depths or not np.isfinite(sight.depth).any():
            return replace(problem, beliefs=None)
        axes = np.stack([camera.rotation[2] for camera in self.own_cameras])
        return replace(problem, beliefs=believe_depths(problem, placed, sight, axes))

    def _look_again(self, fit: ClipFit) -> PictureProblem:
        problem = self._look(_problem_of(fit), fit.state)
        if not self.settings.stands:
            return problem
        place, weight = find_standing_places(self.names, problem.place(fit.state), self.time_s)
        return replace(problem, target=place, weight=weight)

    def _weigh(self, sight: Sight, placed: Array) -> Array:
        """Return one over the squared standard error of every landmark, (V, P, T), 1/px^2."""
        figure = np.array(
            [FIGURE_SIGMA_M.get(part_of(n), OTHER_FIGURE_SIGMA_M) for n in self.names]
        )
        weights = []
        for view, camera in enumerate(self.own_cameras):
            hidden = np.zeros(placed[:, 0].shape)
            if self.settings.looks_behind:
                hidden = find_hidden(self.names, placed, camera_centre(camera))
            sigma = landmark_sigma_m(self.names, sight.confidence[view], hidden)
            if not self.settings.weighs_landmarks:
                sigma = np.full_like(sigma, 0.02)
            sigma = np.hypot(sigma, figure[:, None])
            depth = to_camera_axes(camera, np.moveaxis(placed, 1, 2))[..., 2]
            focal = np.sqrt(np.abs(np.linalg.det(camera.matrix[:2, :2])))
            sigma_px = np.hypot(sigma * focal / np.maximum(depth, MIN_DEPTH_M), MIN_SIGMA_PX)
            weights.append(np.isfinite(sight.pixel[view]).all(axis=2) / sigma_px**2)
        return np.stack(weights)

    # ------------------------------------------------------------------------- the fit

    def _fit(self, problem: PictureProblem, start: Array) -> ClipFit:
        stature: Measurement = self.subject.stature
        refined = {}
        if self.settings.refines_lengths and problem.n_frames >= 5:
            refined = {name: prior_sigma_m(name, stature) for name in REFINED_LENGTHS}
        return fit_clip(problem, start, refine_lengths=refined)

    def _put_names_right(self, fit: ClipFit) -> ClipFit:
        """Find frames that fit badly, say what they should look like, and exchange names.

        What they should look like is told by the frames around them alone.
        """
        problem = _problem_of(fit)
        doubtful = _find_doubtful(problem, fit.state)
        if not doubtful.any():
            return fit
        weight = np.where(doubtful, 0.0, problem.pixel_weight)
        beliefs = problem.beliefs
        if beliefs is not None:
            beliefs = replace(beliefs, weight=np.where(doubtful, 0.0, beliefs.weight))
        # A wrong posture can hold itself: start from the frames before and after instead.
        start = _bridge(fit.state, doubtful, self.time_s)
        bridged = self._fit(replace(problem, pixel_weight=weight, beliefs=beliefs), start)
        whole = replace(_problem_of(bridged), pixel_weight=problem.pixel_weight)
        orders = list_exchanges(self.names, self.skeleton)
        exchanged = find_exchanged(whole, bridged.state, self.time_s, orders)
        if exchanged.any():
            every = list_exchanges(self.skeleton.keypoints, self.skeleton)
            self.sight = self.sight.relabel(exchanged, every)
            self.exchanged = exchanged
        return bridged

    # ------------------------------------------------------------------------- the result

    def _nothing(self) -> FusedFit:
        shape = (len(self.cameras), *self.track.position.shape[:2])
        return FusedFit(
            self.track, fit_nothing(self.track), np.full(shape, np.nan), np.zeros(shape, dtype=bool)
        )

    def _report(self, fit: ClipFit) -> FusedFit:
        problem = _problem_of(fit)
        astray = problem.measure_distance(fit.state) > ASTRAY
        counts = (problem.pixel_weight > 0) & ~astray
        seen = np.asarray(counts.any(axis=0))
        errors = find_state_errors(self.time_s, fit, is_bridged=not seen.all())
        variance = point_variance(problem, fit.state, errors.total)
        track = self._make_track(fit, seen, variance)
        angles, unseen = read_angles(track, fit, seen, errors)
        found = TrackFit(fit, seen, SegmentLengths(**problem.lengths), 0)
        body = make_body(track, found, "fusion")
        warnings = (
            *warn_of_fit(track, found, self.subject, body, unseen),
            *self._warn_of_views(problem),
        )
        rejected = np.zeros((len(self.cameras), *track.position.shape[:2]), dtype=bool)
        rejected[:, :, self.columns] = np.swapaxes(astray, 1, 2)
        return FusedFit(
            track,
            KinematicFit(_widen(angles), body, warnings),
            self._reproject(track),
            rejected,
        )

    def _make_track(self, fit: ClipFit, seen: NDArray[np.bool_], variance: Array) -> PoseTrack:
        problem = _problem_of(fit)
        figure = problem.place(fit.state)
        information, gradient = problem.weigh_pictures(figure)
        interval_s = float(np.median(np.diff(self.time_s))) if self.time_s.size > 1 else 1.0
        points = place_points(self.names, figure, information, gradient, interval_s)
        definition = np.array(
            [DEFINITION_M.get(part_of(n), OTHER_DEFINITION_M) for n in self.names]
        )
        is_known = _find_supported(seen, self.time_s)
        world = np.where(is_known[:, None, None], to_world_axes(np.moveaxis(points, 2, 0)), np.nan)
        position, sigma = np.array(self.track.position), np.array(self.track.sigma)
        status = np.array(self.track.status)
        position[:, self.columns] = world
        spread = np.sqrt(variance + definition[:, None] ** 2).T
        sigma[:, self.columns] = np.where(is_known[:, None], spread, np.nan)
        repaired = (self.exchanged > 0).any(axis=0)
        own = np.where(repaired, Status.REPAIRED, Status.MEASURED)[:, None]
        own = np.where(seen.T, own, Status.FILLED)
        status[:, self.columns] = np.where(is_known[:, None], own, Status.MISSING)
        carry_along(self.skeleton.keypoints, self.track.position, position, sigma, self.columns)
        present = np.isfinite(position).all(axis=2)
        status[~present] = Status.MISSING
        sigma[~present] = np.nan
        _add_middles(self.skeleton, position, sigma, status)
        return replace(
            self.track,
            position=position,
            sigma=sigma,
            status=status,
            confidence=_best(self.sight.confidence).T,
            provenance={**self.track.provenance, "fusion": "model"},
        )

    def _reproject(self, track: PoseTrack) -> Array:
        pictures = [project(camera, track.position) for camera in self.cameras]
        landmarks = np.swapaxes(self.sight.pixel, 1, 2)
        return np.asarray(np.linalg.norm(np.stack(pictures) - landmarks, axis=3))

    def _warn_of_views(self, problem: PictureProblem) -> Iterator[str]:
        for view, camera in enumerate(self.cameras):
            n_exchanged = int((self.exchanged[view] > 0).sum())
            if n_exchanged:
                yield (
                    f"Camera {camera.name} took left for right in {n_exchanged} pictures; the "
                    "other views and the body model put that right."
                )
            n_lost = int((~(problem.pixel_weight[view] > 0).any(axis=0)).sum())
            if n_lost:
                yield (
                    f"Camera {camera.name} shows nobody in {n_lost} of {problem.n_frames} "
                    "pictures; there the posture is less certain."
                )


def _problem_of(fit: ClipFit) -> PictureProblem:
    """Return the problem of a fit, which is one of pictures here."""
    return cast(PictureProblem, fit.problem)


_TORSO = ("hip", "shoulder", "knee", "ankle", "elbow", "wrist")


def _find_doubtful(problem: PictureProblem, state: Array) -> NDArray[np.bool_]:
    """Mark frames whose landmarks fit much worse than usual, and those next to them."""
    square = np.minimum(problem.measure_distance(state) ** 2, 25.0)
    count = np.maximum((problem.pixel_weight > 0).sum(axis=(0, 1)), 1)
    misfit = square.sum(axis=(0, 1)) / count
    usual = max(float(np.median(misfit)), 1.0)
    poor = binary_closing(misfit > POOR_MISFIT * usual)
    doubtful = binary_propagation(misfit > DOUBTFUL_MISFIT * usual, mask=poor)
    doubtful = binary_dilation(doubtful)
    return doubtful if doubtful.mean() <= MAX_DOUBTFUL_SHARE else np.zeros_like(doubtful)


def _bridge(state: Array, doubtful: NDArray[np.bool_], time_s: Array) -> Array:
    """Interpolate states (T, n) over frames in doubt, without whole turns from side to side."""
    known = np.array(state[~doubtful])
    known[:, ROOT:] = np.unwrap(known[:, ROOT:], axis=0)
    bridged = np.full_like(state, np.nan)
    bridged[~doubtful] = known
    return np.stack([interpolate_missing(column, time_s) for column in bridged.T], axis=1)


def _find_supported(seen: NDArray[np.bool_], time_s: Array) -> NDArray[np.bool_]:
    """Mark frames that show the person in some view, and short gaps between them."""
    known = seen.sum(axis=0) >= MIN_POINTS
    index = np.arange(known.size)
    before = np.maximum.accumulate(np.where(known, index, -1))
    after = np.minimum.accumulate(np.where(known, index, known.size)[::-1])[::-1]
    inside = (before >= 0) & (after < known.size)
    span = time_s[np.minimum(after, known.size - 1)] - time_s[np.maximum(before, 0)]
    return np.asarray(known | (inside & (span <= MAX_BRIDGED_S)))


def _add_middles(
    skeleton: Skeleton, position: Array, sigma: Array, status: NDArray[np.uint8]
) -> None:
    """Put keypoints that are the middle of two joints there, in place."""
    for middle, pair in (("pelvis", "hip"), ("thorax", "shoulder")):
        if middle in skeleton.keypoints:
            ends = [skeleton.index(f"{side}_{pair}") for side in ("left", "right")]
            at = skeleton.index(middle)
            position[:, at] = position[:, ends].mean(axis=1)
            sigma[:, at] = sigma[:, ends].max(axis=1)
            status[:, at] = status[:, ends].max(axis=1)


def _best(confidence: Array) -> Array:
    """Return the highest confidence over the views; NaN where none is known."""
    known = np.where(np.isfinite(confidence), confidence, -np.inf).max(axis=0)
    return np.asarray(np.where(np.isfinite(known), known, np.nan))


def _widen(angles: JointAngles) -> JointAngles:
    """Add what landmarks that are no joint centres cost the angles."""
    own = [
        DEFINITION_DEG.get(name.removesuffix("_l").removesuffix("_r"), OTHER_DEFINITION_DEG)
        for name in angles.names
    ]
    return replace(angles, sigma_deg=np.hypot(angles.sigma_deg, own))
