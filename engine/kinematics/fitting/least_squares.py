"""The solver `least-squares`: a jointed figure of constant size, fitted to the whole clip at once.

Every keypoint pulls on the figure in proportion to its certainty, far-off ones less; every curve
is kept as smooth as human movement is. What the keypoints can't tell is settled by stated
assumptions, whose uncertainty enters the standard errors: how the pitch of the trunk is shared
between pelvis and waist, and how limbs turn about their own length.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from engine.datatypes import (
    Array,
    BodyFit,
    JointAngles,
    KinematicFit,
    Measurement,
    PoseTrack,
    Subject,
)
from engine.kinematics.fitting._banded import make_roughness
from engine.kinematics.fitting._clip import ROOT, ClipFit, ClipProblem, fit_clip, fit_frames
from engine.kinematics.fitting._initial import (
    find_reversed,
    guess_angles,
    guess_root,
    interpolate_missing,
)
from engine.kinematics.fitting._report import ANGLES, read_angles
from engine.kinematics.fitting.base import SolverInfo, require_world_metres
from engine.kinematics.humanoid.lengths import (
    SegmentLengths,
    estimate_segment_lengths,
    prior_sigma_m,
)
from engine.kinematics.humanoid.model import (
    ANGLE_VARIABLES,
    FITTED_JOINTS,
    to_model_axes,
    to_world_axes,
)
from engine.kinematics.humanoid.tree import Tree
from engine.skeletons import get_skeleton

__all__ = [
    "SOLVER",
    "FitSettings",
    "TrackFit",
    "choose_points",
    "find_quick_share",
    "fit_nothing",
    "fit_track",
    "make_body",
    "make_priors",
    "roughness_weight",
    "warn_of_fit",
]

HEAD = ("left_ear", "right_ear", "nose")
FEET = ("left_heel", "right_heel", "left_big_toe", "right_big_toe")

UNKNOWN_SIGMA_M = 0.03
"""Standard error of a keypoint whose track states none; scaled by the residuals afterwards."""
FIGURE_SIGMA_M = 0.005
"""A body is no figure of rigid rods: no keypoint counts as closer to its joint than this."""
SPINE_SIGMA_M = 0.025

REFINED_LENGTHS = (
    "thigh",
    "shank",
    "pelvis_half_width",
    "trunk",
    "shoulder_half_width",
    "upper_arm",
    "forearm",
)
MIN_POINTS = 4
MIN_CHANGES = 100
MIN_QUICK_SHARE = 1e-3
MAX_DISTANCE_M = 50.0
"""Keypoints further from the world's origin are no measurement."""
BAD_FIT_M = 0.05
SIZE_MISMATCH = 0.15
POOR_FIT_M = 0.08


@dataclass(frozen=True)
class FitSettings:
    """What the fit assumes.

    Parameters
    ----------
    is_smooth
        Whether frames are linked by smoothness; otherwise each is fitted by itself.
    smoothness
        Power density of the angular acceleration that is expected, rad^2/s^3: higher values
        follow fast movement, lower ones suppress more noise.
    root_smoothness
        The same of the acceleration of the pelvis, m^2/s^3.
    waist_share, waist_sigma
        Share of the waist in the pitch of the trunk, and its standard deviation between persons
        and postures.
    huber
        Distance in standard errors from which a keypoint counts less.
    refine_lengths
        Whether segment lengths are refined along with the angles.
    """

    is_smooth: bool = True
    smoothness: float = 40.0
    root_smoothness: float = 2.0
    waist_share: float = 0.6
    waist_sigma: float = 0.2
    huber: float = 2.5
    refine_lengths: bool = True


PRIOR_DEG: Mapping[str, tuple[float, float]] = {
    "psi_hp": (-5.0, 20.0),
    "psi_an": (-8.0, 10.0),
    "psi_sh": (10.0, 60.0),
    "psi_nk": (0.0, 45.0),
    "phi_nk": (0.0, 45.0),
}
"""Mean and standard deviation of angles that some postures don't show: turn of the thighs (seen
only when the knee is bent), of the feet against the shanks, and of the upper arms (seen only when
the elbow is bent). Other angles have a prior so wide that it only stops them from drifting."""
WIDE_RAD = 3.0
WAIST_FLOOR_DEG = 5.0


@dataclass(frozen=True, eq=False)
class TrackFit:
    """A fitted track: the fit in the figure's axes, and where each of its points was seen.

    `seen` has shape (P, T); `n_reversed` frames were left out because left and right are
    exchanged in them.
    """

    clip: ClipFit
    seen: NDArray[np.bool_]
    lengths: SegmentLengths
    n_reversed: int


def choose_points(skeleton: str) -> tuple[str, ...]:
    """Return the keypoints of a skeleton that the figure is fitted to."""
    known = get_skeleton(skeleton).keypoints
    points = [name for name in FITTED_JOINTS if name in known]
    for group in (HEAD, FEET, ("spine",)):
        if all(name in known for name in group):
            points += group
    return tuple(points)


def fit_track(
    track: PoseTrack, stature: Measurement, settings: FitSettings | None = None
) -> TrackFit | None:
    """Fit the figure to a track.

    Parameters
    ----------
    track
        World metres; NaN where a keypoint is missing.
    stature
        Metres, with its standard error.
    settings
        What the fit assumes; the defaults if None.

    Returns
    -------
    TrackFit or None
        None where no frame shows enough of the person.
    """
    settings = settings or FitSettings()
    names = choose_points(track.skeleton)
    skeleton = get_skeleton(track.skeleton)
    columns = [skeleton.index(name) for name in names]
    target = to_model_axes(track.position[:, columns])
    seen = np.isfinite(target).all(axis=2) & (np.abs(target).max(axis=2) < MAX_DISTANCE_M)
    if (seen.sum(axis=1) >= MIN_POINTS).sum() == 0:
        return None
    target[~seen] = np.nan
    points = {name: target[:, i] for i, name in enumerate(names)}
    if not all(name in points for name in FITTED_JOINTS):
        return None
    is_reversed = find_reversed(points, track.time_s)
    target[is_reversed], seen[is_reversed] = np.nan, False
    lengths = estimate_segment_lengths(track, stature)
    problem, start = _pose_problem(track, points, lengths, settings)
    clip = _fit(problem, start, track.time_s, stature, settings)
    return TrackFit(clip, seen.T, SegmentLengths(**clip.problem.lengths), int(is_reversed.sum()))


def _pose_problem(
    track: PoseTrack, points: Mapping[str, Array], lengths: SegmentLengths, settings: FitSettings
) -> tuple[ClipProblem, Array]:
    tree = Tree(tuple(points), by_vector=("shoulder_l", "shoulder_r"))
    time_s = track.time_s
    angles = guess_angles(points, time_s, waist_share=settings.waist_share)
    start = np.concatenate([guess_root(points, time_s), angles[list(tree.variables)]]).T
    target = np.stack([points[name].T for name in tree.points])
    mean, prior_weight = make_priors(tree, start)
    weight = _weigh(track, tree.points, np.asarray(np.isfinite(target).all(axis=1)))
    # Smoothing is only worth what quick noise costs; errors that last are no smoother for it.
    rough = roughness_weight(tree, time_s.size, settings.smoothness, settings.root_smoothness)
    rough *= find_quick_share(target, weight)
    pitch = angles[0] + angles[3]
    waist_variance = np.radians(WAIST_FLOOR_DEG) ** 2 + (settings.waist_sigma * pitch) ** 2
    problem = ClipProblem(
        tree=tree,
        target=np.nan_to_num(target),
        weight=weight,
        lengths=lengths.as_dict(),
        roughness=make_roughness(time_s, rough),
        prior_mean=mean,
        prior_weight=prior_weight,
        waist_share=settings.waist_share,
        waist_weight=1.0 / waist_variance,
        huber=settings.huber,
    )
    return problem, start


def roughness_weight(tree: Tree, n_frames: int, smoothness: float, root_smoothness: float) -> Array:
    """Return what roughness costs, shape (T, n); both settings as in `FitSettings`."""
    weight = np.full((n_frames, ROOT + len(tree.variables)), 1.0 / smoothness)
    weight[:, :ROOT] = 1.0 / root_smoothness
    return weight


def _weigh(track: PoseTrack, points: tuple[str, ...], seen: NDArray[np.bool_]) -> Array:
    """Return one over the squared standard error of every point, (P, T); zero where missing."""
    skeleton = get_skeleton(track.skeleton)
    stated = np.asarray(track.sigma)[:, [skeleton.index(name) for name in points]].T
    sigma = np.where(np.isfinite(stated) & (stated > 0), stated, UNKNOWN_SIGMA_M)
    figure = np.array([SPINE_SIGMA_M if n == "spine" else FIGURE_SIGMA_M for n in points])
    return np.asarray(seen / (sigma**2 + figure[:, None] ** 2))


def find_quick_share(target: Array, weight: Array) -> float:
    """Return the share of the stated variance that changes from frame to frame.

    Seen in the third differences of the keypoints, in which movement hardly shows: for white
    noise their variance is 20 times that of the noise. `target` has shape (P, D, T), `weight`
    (P, T).
    """
    change = np.diff(target, n=3, axis=2) * np.sqrt(weight[:, None, 3:])
    known = np.abs(change[np.isfinite(change) & (change != 0.0)])
    if known.size < MIN_CHANGES:
        return 1.0
    quick = 1.4826 * float(np.median(known)) / np.sqrt(20.0)
    return float(np.clip(quick**2, MIN_QUICK_SHARE, 1.0))


def make_priors(tree: Tree, start: Array) -> tuple[Array, Array]:
    """Return mean (T, n) and weight (n,) of the prior of every unknown."""
    mean = np.zeros_like(start)
    sigma = np.full(start.shape[1], WIDE_RAD)
    # Where somebody is and faces is anywhere; far from the first guess is still unlikely.
    mean[:, :ROOT], sigma[:ROOT] = start[:, :ROOT], 10.0
    for i, place in enumerate(tree.variables, start=ROOT):
        name = ANGLE_VARIABLES[place].name
        if name == "psi_bd":
            mean[:, i], sigma[i] = start[:, i], 10.0
        for key, (centre, spread) in PRIOR_DEG.items():
            if name.startswith(key):
                mean[:, i], sigma[i] = np.radians(centre), np.radians(spread)
    return mean, sigma**-2.0


def _fit(
    problem: ClipProblem,
    start: Array,
    time_s: Array,
    stature: Measurement,
    settings: FitSettings,
) -> ClipFit:
    if not settings.is_smooth:
        return fit_frames(problem, start)
    refined = {}
    if settings.refine_lengths and problem.n_frames >= 5:
        refined = {name: prior_sigma_m(name, stature) for name in REFINED_LENGTHS}
    fit = fit_clip(problem, start, refine_lengths=refined)
    is_bad = _find_bad_frames(fit)
    if not is_bad.any() or is_bad.all():
        return fit
    # A wrong start (someone seen back to front) can hold a few frames in a wrong posture: start
    # them from their neighbours instead, and keep what fits better.
    again = np.array(fit.state)
    again[is_bad] = np.nan
    again = np.stack([interpolate_missing(row, time_s) for row in again.T], axis=1)
    other = fit_clip(fit.problem, again, refine_lengths=None)
    return other if other.cost < fit.cost else fit


def _find_bad_frames(fit: ClipFit) -> NDArray[np.bool_]:
    """Mark frames that fit much worse than the others do."""
    n_seen = (fit.problem.weight > 0).sum(axis=0)
    misfit = fit.around.misfit / np.maximum(n_seen, 1)
    if not (n_seen > 0).any():
        return np.zeros(misfit.size, dtype=bool)
    usual = np.median(misfit[n_seen > 0])
    distance = np.linalg.norm(fit.problem.place(fit.state) - fit.problem.target, axis=1)
    mean = np.sum(distance * (fit.problem.weight > 0), axis=0) / np.maximum(n_seen, 1)
    return np.asarray((misfit > 4.0 * max(float(usual), 1.0)) & (mean > BAD_FIT_M))


class LeastSquaresSolver:
    """A jointed figure fitted to the whole clip."""

    info = SolverInfo(
        name="least-squares",
        title="Body model fitted to the whole clip",
        angles=ANGLES,
        description="A jointed figure with constant segment lengths, fitted to all frames "
        "together: uncertain keypoints count less, outliers less still, and movement is smooth. "
        "Also gives the angles of pelvis, lumbar spine, ankles and the turn of limbs, with "
        "standard errors; how the pitch of the trunk is shared between pelvis and lumbar spine is "
        "an assumption.",
    )

    def fit(self, track: PoseTrack, subject: Subject) -> KinematicFit:
        """Compute the angles of every frame.

        Parameters
        ----------
        track
            World metres, Y up; sigma per keypoint, NaN where unknown.
        subject
            The stature guides the segment lengths where the clip doesn't show them well.

        Returns
        -------
        KinematicFit
            Angles are NaN where a keypoint that determines them is missing for longer than a
            moment (or the skeleton has none), or the posture doesn't show them.

        Raises
        ------
        UnitError
            If the track is not in world metres.
        """
        require_world_metres(track)
        found = fit_track(track, subject.stature)
        if found is None:
            return fit_nothing(track)
        angles, unseen = read_angles(track, found.clip, found.seen)
        body = make_body(track, found)
        return KinematicFit(angles, body, tuple(warn_of_fit(track, found, subject, body, unseen)))


def fit_nothing(track: PoseTrack) -> KinematicFit:
    """Return a fit without angles, saying why."""
    angles = JointAngles(track.time_s, np.full((track.n_frames, len(ANGLES)), np.nan), ANGLES)
    warning = (
        f"No frame shows {MIN_POINTS} joints of the person, so there are no joint angles; film "
        "the whole person."
    )
    return KinematicFit(angles, None, (warning,))


def make_body(track: PoseTrack, found: TrackFit, made_by: str = "least-squares") -> BodyFit:
    """Put the figure's points into the track's skeleton, with their distance from the keypoints."""
    skeleton = get_skeleton(track.skeleton)
    problem = found.clip.problem
    points = np.moveaxis(problem.place(found.clip.state), 2, 0)
    is_fitted = found.seen.sum(axis=0) >= MIN_POINTS
    world = np.where(is_fitted[:, None, None], to_world_axes(points), np.nan)
    position = np.full(track.position.shape, np.nan)
    for i, name in enumerate(problem.tree.points):
        position[:, skeleton.index(name)] = world[:, i]
    for middle, pair in (("pelvis", "hip"), ("thorax", "shoulder")):
        if middle in skeleton.keypoints:
            ends = [skeleton.index(f"{side}_{pair}") for side in ("left", "right")]
            position[:, skeleton.index(middle)] = position[:, ends].mean(axis=1)
    fitted = [skeleton.index(name) for name in FITTED_JOINTS if name in skeleton.keypoints]
    distance = np.linalg.norm((position - track.position)[:, fitted], axis=2)
    return BodyFit(
        joints=PoseTrack(
            track.time_s,
            position,
            "m",
            "world",
            track.skeleton,
            provenance={"made_by": made_by},
        ),
        residual_m=_mean_known(distance),
        segment_lengths_m=found.lengths.as_dict(),
    )


def _mean_known(values: Array) -> Array:
    """Return the mean along the second axis of what is known; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=1)
    total = np.where(known, values, 0.0).sum(axis=1)
    mean = np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0)
    return np.asarray(mean)


def warn_of_fit(
    track: PoseTrack, found: TrackFit, subject: Subject, body: BodyFit, unseen: tuple[str, ...]
) -> Iterator[str]:
    """Say in plain words what makes these angles less certain."""
    if not found.clip.has_converged:
        yield (
            "The body model did not settle on one posture in every frame; compare its joint "
            "angles with those of the solver 'geometric'."
        )
    if found.n_reversed:
        yield (
            f"Left and right seem to be exchanged in {found.n_reversed} pictures; they were left "
            "out of the body model."
        )
    typical = SegmentLengths.from_stature(subject.stature.value).as_dict()
    size = float(
        np.median([body.segment_lengths_m[n] / typical[n] for n in ("thigh", "shank", "trunk")])
    )
    if abs(size - 1.0) > SIZE_MISMATCH:
        yield (
            f"The body in the clip measures {100 * size:.0f} % of a person of "
            f"{subject.stature.value:.2f} m; check the stature and the scale."
        )
    known = body.residual_m[np.isfinite(body.residual_m)]
    if known.size and np.median(known) > POOR_FIT_M:
        yield (
            f"The keypoints lie {100 * np.median(known):.0f} cm from the fitted body on average; "
            "they may belong to several persons or be exchanged. Look at the overlay."
        )
    if unseen:
        yield f"Never visible in this clip: {', '.join(unseen)}."


SOLVER = LeastSquaresSolver()
