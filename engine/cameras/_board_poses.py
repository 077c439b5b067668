"""Poses of the board, and the place of the cameras on which they agree.

A single view of a board allows two poses that look nearly alike, a symmetric board four; only the
right ones put the second camera at the same place again and again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from engine.cameras._adjust import Lens
from engine.cameras._board_views import BoardSpec, BoardView
from engine.datatypes import Array
from engine.errors import CalibrationError

__all__ = ["Pair", "Pose", "agree", "relate_back", "reprojection", "solve_poses", "turn_view"]

LEAST_PAIRS = 3
CORNER_SIGMA_PX = 0.3
WORST_START_PX = 20.0
AGREE_DEG = 4.0
AGREE_SHARE = 0.08
"""How near relative poses lie that agree: an angle, and a share of the distance."""
LEAST_AGREEMENT = 0.6


@dataclass(frozen=True, eq=False)
class Pair:
    """Both cameras' views of one board pose; `sigma_px` includes what it moved meanwhile."""

    first: BoardView
    second: BoardView
    sigma_px: float = CORNER_SIGMA_PX


@dataclass(frozen=True, eq=False)
class Pose:
    rotation: Array
    translation: Array


def solve_poses(view: BoardView, lens: Lens, board: BoardSpec) -> list[Pose]:
    """Return the poses of the board that explain a view, the best first."""
    n_turns = 2 if board.is_symmetric else 1
    poses = []
    for turn in range(n_turns):
        rows = view.rows if turn == 0 else len(board.corners) - 1 - view.rows
        corners = board.corners[rows]
        centre = board.corners.mean(axis=0)
        n_found, rotations, translations, errors = cv2.solvePnPGeneric(
            corners - centre, view.pixels, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_IPPE
        )
        for index in range(int(n_found)):
            rotation = np.asarray(cv2.Rodrigues(rotations[index])[0], dtype=np.float64)
            place = np.asarray(translations[index]).ravel() - rotation @ centre
            if place[2] > 0 and float(np.ravel(errors[index])[0]) < WORST_START_PX:
                poses.append(Pose(rotation, place))
    return poses


def _relate(first: Pose, second: Pose) -> Pose:
    rotation = second.rotation @ first.rotation.T
    return Pose(rotation, second.translation - rotation @ first.translation)


def agree(
    pairs: Sequence[Pair], lenses: Sequence[Lens], board: BoardSpec, names: tuple[str, str]
) -> tuple[Pose, list[Pair], list[Pose]]:
    """Find the place of the second camera on which most pairs agree.

    Returns
    -------
    Pose
        From the first camera's axes to the second's.
    list of Pair
        Those that agree; corners of symmetric boards numbered alike in both views.
    list of Pose
        The board in the first camera's axes, one a pair.

    Raises
    ------
    CalibrationError
        If too few agree.
    """
    candidates = []
    for pair in pairs:
        ones = solve_poses(pair.first, lenses[0], board)
        twos = solve_poses(pair.second, lenses[1], board)
        candidates.append([(_relate(one, two), one) for one in ones for two in twos])
    best, votes = _count_votes(candidates)
    if best is None or len(votes) < max(LEAST_PAIRS, LEAST_AGREEMENT * len(pairs)):
        raise CalibrationError(_explain_disagreement(pairs, lenses, board, names, len(votes)))
    chosen = [pairs[index] for index in votes]
    poses = [candidates[index][rank][1] for index, rank in votes.items()]
    if board.is_symmetric:
        chosen = [
            _turn_to(pair, pose, best, lenses, board)
            for pair, pose in zip(chosen, poses, strict=True)
        ]
    return best, chosen, poses


def _count_votes(
    candidates: Sequence[Sequence[tuple[Pose, Pose]]],
) -> tuple[Pose | None, dict[int, int]]:
    """Return the relative pose that most pairs allow, and each one's rank that does."""
    flat = [
        (index, rank, relative)
        for index, options in enumerate(candidates)
        for rank, (relative, _) in enumerate(options)
    ]
    if not flat:
        return None, {}
    turns = np.stack([pose.rotation for *_, pose in flat])
    places = np.stack([-pose.rotation.T @ pose.translation for *_, pose in flat])
    best, best_score = 0, (-1, 0.0)
    for trial in range(len(flat)):
        least = _least_per_pair(_miss(turns, places, trial), flat, len(candidates))
        agreeing = least[least < 1.0]
        if (len(agreeing), -float(agreeing.sum())) > best_score:
            best, best_score = trial, (len(agreeing), -float(agreeing.sum()))
    misses = _miss(turns, places, best)
    votes: dict[int, int] = {}
    for position in np.argsort(misses, kind="stable"):
        index, rank, _ = flat[position]
        if misses[position] < 1.0:
            votes.setdefault(index, rank)
    return flat[best][2], dict(sorted(votes.items()))


def _least_per_pair(misses: Array, flat: Sequence[tuple[int, int, Pose]], n_pairs: int) -> Array:
    least = np.full(n_pairs, np.inf)
    np.minimum.at(least, [index for index, *_ in flat], misses)
    return least


def _miss(turns: Array, places: Array, trial: int) -> Array:
    """Return how far relative poses are from one of them, shape (N,); below 1 they agree."""
    cosine = (np.einsum("nij,ij->n", turns, turns[trial]) - 1.0) / 2.0
    angle_deg = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    distance = np.linalg.norm(places - places[trial], axis=1)
    length = max(float(np.linalg.norm(places[trial])), 1e-6)
    return np.asarray(np.maximum(angle_deg / AGREE_DEG, distance / (AGREE_SHARE * length)))


def _turn_to(
    pair: Pair, pose: Pose, relative: Pose, lenses: Sequence[Lens], board: BoardSpec
) -> Pair:
    """Turn the numbers of a symmetric board's corners in both views as its pose says."""
    second = Pose(
        relative.rotation @ pose.rotation,
        relative.rotation @ pose.translation + relative.translation,
    )
    turned = [
        turn_view(view, place, lens, board)
        for view, place, lens in zip((pair.first, pair.second), (pose, second), lenses, strict=True)
    ]
    return replace(pair, first=turned[0], second=turned[1])


def turn_view(view: BoardView, pose: Pose, lens: Lens, board: BoardSpec) -> BoardView:
    """Return a view with the corners of a symmetric board numbered as a pose says."""
    if not board.is_symmetric:
        return view
    other = replace(view, rows=len(board.corners) - 1 - view.rows)
    return min((view, other), key=lambda v: reprojection(v, pose, lens, board))


def reprojection(view: BoardView, pose: Pose, lens: Lens, board: BoardSpec) -> float:
    """Return how far a pose puts the corners from where they were seen, mean, px."""
    predicted, _ = cv2.projectPoints(
        board.corners[view.rows],
        cv2.Rodrigues(pose.rotation)[0],
        pose.translation,
        lens.matrix,
        lens.distortion,
    )
    return float(np.linalg.norm(np.asarray(predicted).reshape(-1, 2) - view.pixels, axis=1).mean())


def _explain_disagreement(
    pairs: Sequence[Pair],
    lenses: Sequence[Lens],
    board: BoardSpec,
    names: tuple[str, str],
    n_votes: int,
) -> str:
    """Return the likeliest reason why board poses don't agree about the cameras."""
    said = (
        "The place of the cameras differs from one board pose to the next: "
        f"{n_votes} of {len(pairs)} agree"
    )
    if board.kind == "checkerboard" and _agree_when_mirrored(pairs, lenses, board):
        return (
            f"{said}, but they would if one of {names[0]} and {names[1]} were not mirrored, as a "
            "selfie camera is; film with the main camera, or switch mirroring off."
        )
    return (
        f"{said}. Check that both videos show the same board, that no phone was moved, and the "
        "time between the videos; hold the board still for 2 s at each place."
    )


def _agree_when_mirrored(pairs: Sequence[Pair], lenses: Sequence[Lens], board: BoardSpec) -> bool:
    """Return whether the pairs agree once the second picture is mirrored, or just so the first."""
    width = 2.0 * lenses[1].values[2]
    candidates = []
    for pair in pairs:
        ones = solve_poses(pair.first, lenses[0], board)
        twos = solve_poses(_mirror(pair.second, width, board), lenses[1], board)
        candidates.append([(_relate(one, two), one) for one in ones for two in twos])
    _, votes = _count_votes(candidates)
    return len(votes) >= max(LEAST_PAIRS, LEAST_AGREEMENT * len(pairs))


def _mirror(view: BoardView, width: float, board: BoardSpec) -> BoardView:
    """Return what an unmirrored camera sees of the board: columns in the opposite order."""
    across, down = view.rows % (board.columns - 1), view.rows // (board.columns - 1)
    if board.columns % 2:
        rows = down * (board.columns - 1) + (board.columns - 2 - across)
    else:
        rows = (board.rows - 2 - down) * (board.columns - 1) + across
    return replace(view, rows=rows, pixels=view.pixels * [-1.0, 1.0] + [width, 0.0])


def relate_back(pose: Pose, relative: Pose) -> Pose:
    """Return a pose seen by the second camera in the axes of the first."""
    rotation = relative.rotation.T
    return Pose(rotation @ pose.rotation, rotation @ (pose.translation - relative.translation))
