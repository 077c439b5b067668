"""What `liftlens calibrate` does."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Literal, cast, get_args

import cv2
import numpy as np

from engine.cameras.board import BoardSpec, calibrate_board
from engine.cameras.board_print import draw_board, paper_board
from engine.cameras.files import (
    adapt_to_pictures,
    format_calibration,
    match_cameras,
    read_calibration,
)
from engine.cameras.known_points import calibrate_known_points, read_points
from engine.datatypes import (
    Calibration,
    CalibrationCheck,
    Camera,
    CheckLevel,
    Frame,
    Measurement,
    ProgressCallback,
    Subject,
    ViewPose,
    ignore_progress,
)
from engine.errors import CalibrationError, ConfigError
from engine.optics import camera_centre
from engine.storage.atomic import explain_os_errors, write_aside
from engine.video.reader import probe_video, read_frames

__all__ = ["CalibrateRequest", "run_calibrate"]

Say = Callable[[str], None]
Observe = Callable[[Sequence[Path]], Sequence[ViewPose]]
"""Estimates the pose in each video and brings them to common times."""
Method = Literal["board", "points", "person"]
STILLS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")
EVERY_S = 0.2
MOST_STILLS = 400


@dataclass(frozen=True)
class CalibrateRequest:
    """The options of the command.

    `videos` are two videos, or two folders of photographs that were taken at the same moments and
    sort in the same order. Exactly one of `check`, `convert`, `print_board` and `method` says what
    to do. Sizes in mm; None where not given.
    """

    videos: tuple[Path, ...] = ()
    method: str | None = None
    out: Path | None = None
    board: str = "charuco"
    columns: int | None = None
    rows: int | None = None
    square_mm: float | None = None
    marker_mm: float | None = None
    dictionary: str | None = None
    floor_at_s: float | None = None
    sync: str = "auto"
    lenses: Path | None = None
    points: Path | None = None
    stature_m: float | None = None
    check: Path | None = None
    convert: Path | None = None
    print_board: Path | None = None
    paper: str = "a3"

    def __post_init__(self) -> None:
        tasks = {
            "--method": self.method,
            "--check": self.check,
            "--convert": self.convert,
            "--print-board": self.print_board,
        }
        given = [name for name, value in tasks.items() if value is not None]
        if len(given) != 1:
            raise ConfigError(
                f"Expected one of {', '.join(tasks)}, got {' and '.join(given) or 'none'}."
            )
        if self.method is not None:
            self._require_method()
        elif len(self.videos) not in (0, 2):
            raise ConfigError(f"Expected two videos or none, got {len(self.videos)}.")
        if self.convert is not None and self.out is None:
            raise ConfigError("Expected --out FILE.toml for the converted calibration.")

    def _require_method(self) -> None:
        if self.method not in get_args(Method):
            raise ConfigError(
                f"--method must be one of {', '.join(get_args(Method))}, got {self.method!r}."
            )
        if len(self.videos) != 2:
            raise ConfigError(f"Calibrating takes two videos, got {len(self.videos)}.")
        if self.videos[0].resolve() == self.videos[1].resolve():
            raise ConfigError(f"{self.videos[0].name} is given twice; give both cameras' videos.")
        if self.out is None:
            raise ConfigError("Expected --out FILE.toml for the calibration.")
        if self.method == "points" and self.points is None:
            raise ConfigError("Expected --points FILE.toml with the clicked points.")
        if self.sync != "auto":
            self.offset_s()

    def offset_s(self) -> float | None:
        """Return the given time between the videos, None to find it."""
        if self.sync == "auto":
            return None
        try:
            value = float(self.sync)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise ConfigError(f"--sync must be auto or a number of seconds, got {self.sync!r}.")
        return value

    def board_spec(self) -> BoardSpec:
        """Return the board that is meant, the printable one where nothing else is said.

        Raises
        ------
        ConfigError
            If there is no such board.
        """
        usual = paper_board(self.paper, self.board)
        if self.board not in ("charuco", "checkerboard"):
            raise ConfigError(f"--board must be charuco or checkerboard, got {self.board!r}.")
        return BoardSpec(
            kind=usual.kind,
            columns=usual.columns if self.columns is None else self.columns,
            rows=usual.rows if self.rows is None else self.rows,
            square_m=usual.square_m if self.square_mm is None else self.square_mm / 1000.0,
            marker_m=None if self.marker_mm is None else self.marker_mm / 1000.0,
            dictionary=usual.dictionary if self.dictionary is None else self.dictionary,
        )


def run_calibrate(
    request: CalibrateRequest,
    *,
    say: Say,
    warn: Say,
    observe: Observe,
    progress: ProgressCallback = ignore_progress,
) -> None:
    """Do what was asked for.

    Parameters
    ----------
    request
        The options.
    say, warn
        Get the result and what is in doubt, line by line.
    observe
        Returns what an estimator sees of the person, at common times; called only where a person
        is needed.
    progress
        Called while pictures are looked at.

    Raises
    ------
    ConfigError
        If options don't go together.
    CalibrationError
        If the cameras can't be calibrated, or their calibration is wrong.
    OutputError
        If the file can't be written.
    """
    if request.print_board is not None:
        _print_board(request, request.print_board, say)
        return
    if request.check is not None or request.convert is not None:
        calibration, checks = _read_for(request, warn)
        if request.check is not None and request.videos:
            checks = [*checks, *_check_world(calibration, request, observe)]
    else:
        calibration, checks = _calibrate(request, observe, progress)
    for line in describe_calibration(calibration):
        say(line)
    for line in _describe_checks(checks):
        say(line)
    wrong = next((check for check in checks if check.level is CheckLevel.RED), None)
    if wrong is not None:
        raise CalibrationError(
            f"This calibration can't be trusted, so nothing was written. {wrong.sentence} "
            f"{wrong.action}".rstrip()
        )
    if request.out is not None:
        write_calibration(calibration, request.out)
        say(f"\nWritten: {request.out}")


def write_calibration(calibration: Calibration, path: Path) -> None:
    """Write a calibration file so that nobody ever sees half of it.

    Raises
    ------
    OutputError
        If it can't be written there.
    """
    if path.suffix.lower() != ".toml":
        raise ConfigError(f"A calibration is written as .toml, got {path.name!r}.")
    with explain_os_errors(path, "The calibration"), write_aside(path) as aside:
        aside.write_text(format_calibration(calibration), encoding="utf-8")


def describe_calibration(calibration: Calibration) -> Iterator[str]:
    """Yield what a calibration says, for people."""
    for camera in calibration.cameras:
        yield f"{camera.name}: {', '.join(_describe_camera(camera, calibration))}"
    for one, two in combinations(calibration.cameras, 2):
        distance = float(np.linalg.norm(camera_centre(one) - camera_centre(two)))
        cosine = float(np.clip(one.rotation[2] @ two.rotation[2], -1.0, 1.0))
        angle = math.degrees(math.acos(cosine))
        yield f"{one.name} and {two.name}: {distance:.2f} m apart, {angle:.0f} degrees between them"
    # From a person, errors of the cameras go together; those of the cameras alone stand apart.
    own = calibration.provenance
    errors = [
        (
            own.get("pose_rotation_sigma_deg", calibration.rotation_sigma_deg),
            "turned by {:.2g} degrees",
        ),
        (
            1000 * own.get("pose_translation_sigma_m", calibration.translation_sigma_m),
            "moved by {:.2g} mm",
        ),
        (calibration.scale_sigma * 100, "all lengths off by {:.2g} %"),
    ]
    known = [text.format(value) for value, text in errors if math.isfinite(value)]
    if known:
        yield f"Standard errors: the cameras may be {', '.join(known)}."
    if not np.isfinite(calibration.up).all():
        yield "Up and floor are not in it; the person will tell them."
    for note in calibration.provenance.get("notes", ()):
        yield f"Note: {note}"


def _describe_camera(camera: Camera, calibration: Calibration) -> Iterator[str]:
    yield f"{camera.size_px[0]} x {camera.size_px[1]} px"
    fov = 2 * math.degrees(math.atan(max(camera.size_px) / (2 * camera.matrix[0, 0])))
    yield f"field of view {fov:.0f} degrees"
    if math.isfinite(calibration.floor_m):
        height = float(camera_centre(camera) @ calibration.up) - calibration.floor_m
        yield f"{height:.2f} m above the floor"


def _describe_checks(checks: Sequence[CalibrationCheck]) -> Iterator[str]:
    for check in checks:
        yield f"[{check.level}] {check.sentence} {check.action}".rstrip()


def _print_board(request: CalibrateRequest, path: Path, say: Say) -> None:
    board = request.board_spec()
    content = draw_board(board, path, paper=request.paper)
    with explain_os_errors(path, "The board"), write_aside(path) as aside:
        aside.write_bytes(content)
    options = (
        f"--board {board.kind} --columns {board.columns} --rows {board.rows} "
        f"--square-mm {board.square_m * 1000:g}"
    )
    if board.kind == "charuco":
        options += f" --marker-mm {board.marker_side_m * 1000:g}"
    say(f"Written: {path}")
    say(
        "Print it at 100 %, glue it flat on something stiff, and measure the whole board: with "
        f"{board.columns} columns it should be {board.columns * board.square_m * 1000:g} mm wide."
    )
    say(f"Then calibrate with {options}; give a square's real side if it came out otherwise.")


def _read_for(request: CalibrateRequest, warn: Say) -> tuple[Calibration, list[CalibrationCheck]]:
    """Read a calibration file and fit it to the videos, if there are any."""
    path = cast(Path, request.check or request.convert)
    calibration = read_calibration(path)
    if not request.videos:
        return calibration, []
    calibration, named = match_cameras(calibration, [video.name for video in request.videos])
    sizes, pictures = [], []
    for video in request.videos:
        first = next(iter(_open_pictures(video)))
        pictures.append(first.image)
        sizes.append((first.image.shape[1], first.image.shape[0]))
    calibration, fitted = adapt_to_pictures(calibration, sizes, pictures)
    wrong = next((check for check in fitted if check.level is CheckLevel.RED), None)
    if wrong and request.convert is not None:
        raise CalibrationError(f"{wrong.sentence} {wrong.action}".rstrip())
    if wrong:
        warn(f"{wrong.sentence} {wrong.action}".rstrip())
    return calibration, [named, *fitted]


def _calibrate(
    request: CalibrateRequest, observe: Observe, progress: ProgressCallback
) -> tuple[Calibration, list[CalibrationCheck]]:
    names = _name_cameras(request.videos)
    if request.method == "board":
        return _from_board(request, names, progress), []
    if request.method == "points":
        known = read_points(cast(Path, request.points))
        sizes = [_picture_size(video) for video in request.videos]
        _require_order(known.videos, request.videos)
        return calibrate_known_points(known, sizes, names), []
    from engine.cameras.self_calibration import calibrate_from_person

    views = observe(request.videos)
    stature = _stature(request)
    calibration = calibrate_from_person(views, stature)
    pairs = zip(calibration.cameras, names, strict=True)
    cameras = tuple(replace(camera, name=name) for camera, name in pairs)
    calibration = replace(calibration, cameras=cameras)
    return calibration, _judge(views, calibration, stature)


def _check_world(
    calibration: Calibration, request: CalibrateRequest, observe: Observe
) -> list[CalibrationCheck]:
    return _judge(observe(request.videos), calibration, _stature(request))


def _judge(
    views: Sequence[ViewPose], calibration: Calibration, stature: Measurement
) -> list[CalibrationCheck]:
    """Return the verdict first, then what it is made of."""
    from engine.cameras.verdict import check_calibration, summarise_checks

    checks = check_calibration(views, calibration, stature)
    return [summarise_checks(checks), *checks]


def _stature(request: CalibrateRequest) -> Measurement:
    return Subject(stature_m=request.stature_m).stature


def _from_board(
    request: CalibrateRequest, names: tuple[str, str], progress: ProgressCallback
) -> Calibration:
    first, second = request.videos
    are_stills = first.is_dir()
    if are_stills != second.is_dir():
        raise ConfigError("Give two videos, or two folders of photographs; not one of each.")
    lenses: tuple[Camera | None, Camera | None] = (None, None)
    if request.lenses is not None:
        known, _ = match_cameras(read_calibration(request.lenses), [v.name for v in request.videos])
        known, _ = adapt_to_pictures(known, [_picture_size(v) for v in request.videos])
        lenses = (known.cameras[0], known.cameras[1])
    return calibrate_board(
        _open_pictures(first),
        _open_pictures(second),
        request.board_spec(),
        names=names,
        lenses=lenses,
        offset_s=0.0 if are_stills else request.offset_s(),
        floor_at_s=request.floor_at_s,
        every_s=EVERY_S,
        are_stills=are_stills,
        progress=progress,
    )


def _open_pictures(path: Path) -> Iterator[Frame]:
    """Return the frames of a video, or the photographs of a folder with their number as time."""
    return _read_stills(path) if path.is_dir() else read_frames(path)


def _read_stills(folder: Path) -> Iterator[Frame]:
    files = sorted(p for p in folder.iterdir() if p.suffix.lower() in STILLS)
    if not 1 <= len(files) <= MOST_STILLS:
        raise CalibrationError(
            f"The folder {folder.name} holds {len(files)} photographs, expected 1 to {MOST_STILLS} "
            f"({', '.join(STILLS)})."
        )
    for index, file in enumerate(files):
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
        if image is None:
            raise CalibrationError(f"The photograph {file.name} can't be read; take it out.")
        rgb = np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)
        yield Frame(index=index, time_s=float(index), image=rgb)


def _picture_size(path: Path) -> tuple[int, int]:
    if not path.is_dir():
        return probe_video(path).size_px
    image = next(_read_stills(path)).image
    return image.shape[1], image.shape[0]


def _name_cameras(videos: Sequence[Path]) -> tuple[str, str]:
    names = [video.stem for video in videos]
    if names[0] == names[1]:
        names = [f"{video.resolve().parent.name}_{video.stem}" for video in videos]
    return names[0], names[1]


def _require_order(stated: Sequence[str], videos: Sequence[Path]) -> None:
    """Refuse clicks that belong to other videos than those given."""
    if len(stated) != len(videos):
        raise CalibrationError(
            f"The points file has {len(stated)} views for {len(videos)} videos; expected one each."
        )
    for name, video in zip(stated, videos, strict=True):
        if name and Path(name).name != video.name:
            raise CalibrationError(
                f"The points file expects {Path(name).name} where {video.name} is given; give the "
                "videos in the order of its [[view]] tables."
            )
