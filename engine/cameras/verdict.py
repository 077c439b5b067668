"""Whether a calibration fits the world: the person who was filmed is the witness.

A small reprojection error proves little: a mirrored, scaled or tilted world reprojects just as
well. So every calibration, whatever it comes from, is held against what is known of a person: the
feet stand on the floor, a standing body points up, the stature is known, both legs are of one
length and keep it, left and right lie where each view alone sees them.

The limits were chosen on clips of training persons, with right calibrations and with calibrations
made wrong in known ways; benchmarks/self_calibration.py counts how often wrong ones are found and
right ones are not believed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from engine.cameras._bundle import HEEL_M, TOE_M
from engine.cameras._witness import Witness, bear_witness, find_shift
from engine.datatypes import Array, Calibration, CalibrationCheck, CheckLevel, Measurement, ViewPose
from engine.errors import CalibrationError
from engine.optics import camera_centre

__all__ = ["check_calibration", "summarise_checks"]

FOOT_M = 0.5 * (HEEL_M + TOE_M)


@dataclass(frozen=True)
class Limits:
    """From where on a check is amber, and from where on red."""

    amber: float
    red: float

    def judge(self, value: float) -> CheckLevel:
        """Return the level of a value; amber where it is missing."""
        if not math.isfinite(value):
            return CheckLevel.RED if math.isinf(value) else CheckLevel.AMBER
        if value > self.red:
            return CheckLevel.RED
        return CheckLevel.AMBER if value > self.amber else CheckLevel.GREEN


MISS_PERCENT = Limits(1.3, 3.0)
STATURE_PERCENT = Limits(3.0, 7.0)
NO_UPRIGHT_PERCENT = 5.0
"""Added where the stature is judged by the legs alone."""
FLOOR_M = Limits(0.025, 0.08)
GRAVITY_DEG = Limits(5.0, 12.0)
SIDES_PERCENT = Limits(10.0, 20.0)
SPREAD_PERCENT = Limits(8.0, 16.0)
RAY_ANGLE_DEG = ((40.0, 130.0), (30.0, 150.0))
"""Where the angle between the cameras is good, and outside which depth can't be trusted."""
FIELD_OF_VIEW_DEG = ((30.0, 100.0), (12.0, 140.0))
MIRRORED = Limits(-0.5, 0.0)
BEHIND_SHARE = Limits(0.01, 0.05)
CAMERA_HEIGHT_M = (0.05, 6.0)
SHIFT_GAIN = Limits(0.05, 0.30)
TILT_SIGMA_DEG = Limits(5.0, 20.0)

OTHER_WAY = "Calibrate again, or let the cameras be found from the moving person."
BETTER_FILM = "Film a larger movement, whole in both pictures, or calibrate with a board."


def check_calibration(
    views: Sequence[ViewPose], calibration: Calibration, stature: Measurement
) -> tuple[CalibrationCheck, ...]:
    """Hold a calibration against the person whom its cameras filmed.

    Parameters
    ----------
    views
        Two, synchronised: with the same times.
    calibration
        From any source; gravity and floor are checked where it tells them.
    stature
        Metres, with standard error.

    Returns
    -------
    tuple
        One check a question, in the order of what to ask first. If the cameras belong to
        pictures of another size, only that: nothing else would mean anything.

    Raises
    ------
    CalibrationError
        If there are not two views and two cameras, or the views' times differ, or the
        estimator has not the joints that are needed.
    """
    if len(views) != 2 or len(calibration.cameras) != 2:
        raise CalibrationError(
            f"Expected two views and two cameras, got {len(views)} and {len(calibration.cameras)}."
        )
    sizes = tuple(_check_sizes(views, calibration))
    if sizes:
        return sizes
    witness = bear_witness(views, calibration)
    if not witness.seen.any(axis=1).sum() >= 5:
        return (_never_seen(),)
    checks = (
        *_check_cameras(calibration),
        _check_front(witness),
        _check_mirror(witness),
        _check_miss(witness),
        _check_ray_angle(witness),
        _check_stature(witness, calibration, stature),
        *_check_ground(calibration, witness),
        _check_sides(witness),
        _check_spread(witness),
        *_check_time(views, calibration),
    )
    if calibration.source == "person":
        return tuple(replace(c, action=c.action.replace(OTHER_WAY, BETTER_FILM)) for c in checks)
    return checks


def summarise_checks(checks: Sequence[CalibrationCheck]) -> CalibrationCheck:
    """Return one check for all: the worst level, with the sentence of the first that has it.

    Parameters
    ----------
    checks
        At least one.

    Raises
    ------
    CalibrationError
        If there is none.
    """
    if not checks:
        raise CalibrationError("There is no check to summarise; check the calibration first.")
    order = (CheckLevel.RED, CheckLevel.AMBER, CheckLevel.GREEN)
    worst = min(checks, key=lambda check: order.index(check.level))
    if worst.level is CheckLevel.GREEN:
        return CalibrationCheck(
            key="summary",
            level=CheckLevel.GREEN,
            sentence="The calibration fits the person, the floor and gravity.",
        )
    others = sum(check.level is worst.level for check in checks) - 1
    tail = f" ({others} more {'check is' if others == 1 else 'checks are'} like that.)"
    return replace(worst, key="summary", sentence=worst.sentence + (tail if others else ""))


def _never_seen() -> CalibrationCheck:
    return CalibrationCheck(
        key="person",
        level=CheckLevel.RED,
        sentence="Both cameras together see the person clearly in fewer than 5 of the frames "
        "looked at, so nothing can be checked.",
        action="Film so that both cameras see the whole person at the same time.",
    )


def _check_sizes(views: Sequence[ViewPose], calibration: Calibration) -> Iterator[CalibrationCheck]:
    for view, camera in zip(views, calibration.cameras, strict=True):
        if view.info.size_px == camera.size_px:
            continue
        shown, known = ("{} x {}".format(*size) for size in (view.info.size_px, camera.size_px))
        yield CalibrationCheck(
            key="picture_size",
            level=CheckLevel.RED,
            sentence=f"The video {view.info.file_name} has {shown} px, but camera "
            f"{camera.name!r} was calibrated for {known} px.",
            action="Use the calibration of this resolution, or film as when calibrating.",
        )


def _check_cameras(calibration: Calibration) -> Iterator[CalibrationCheck]:
    """Check what each camera says of itself: its field of view, and where it stands."""
    for camera in calibration.cameras:
        side = max(camera.size_px)
        field = math.degrees(2.0 * math.atan(0.5 * side / abs(camera.matrix[0, 0])))
        level = _judge_range(field, *FIELD_OF_VIEW_DEG)
        yield CalibrationCheck(
            key="field_of_view",
            level=level,
            sentence=f"Camera {camera.name!r} sees {field:.0f} degrees along the longer side"
            + ("." if level is CheckLevel.GREEN else "; phones see 55 to 80."),
            action="" if level is CheckLevel.GREEN else "Check the focal length and its unit (px).",
            value=field,
            unit="deg",
        )
    up, floor = np.asarray(calibration.up), calibration.floor_m
    if not np.isfinite(up).all() or not math.isfinite(floor):
        return
    for camera in calibration.cameras:
        height = float(camera_centre(camera) @ up) - floor
        is_fine = CAMERA_HEIGHT_M[0] < height < CAMERA_HEIGHT_M[1]
        yield CalibrationCheck(
            key="camera_height",
            level=CheckLevel.GREEN if is_fine else CheckLevel.RED,
            sentence=f"Camera {camera.name!r} is {_height(height)} the floor.",
            action=""
            if is_fine
            else "Check which axis of the calibration points up, and its unit of length.",
            value=height,
            unit="m",
        )


def _height(height: float) -> str:
    return f"{abs(height):.2f} m {'above' if height >= 0 else 'below'}"


def _judge_range(
    value: float, good: tuple[float, float], usable: tuple[float, float]
) -> CheckLevel:
    if good[0] <= value <= good[1]:
        return CheckLevel.GREEN
    return CheckLevel.AMBER if usable[0] <= value <= usable[1] else CheckLevel.RED


def _check_front(witness: Witness) -> CalibrationCheck:
    behind = 1.0 - witness.in_front_share()
    level = BEHIND_SHARE.judge(behind)
    if level is CheckLevel.GREEN:
        sentence, action = "The person is in front of both cameras.", ""
    else:
        sentence = f"{100 * behind:.0f} % of the joints would lie behind a camera."
        action = "Check that each video has its own camera, and the axes of the file. "
        action += OTHER_WAY
    return CalibrationCheck("in_front", level, sentence, action, 100.0 * behind, "%")


def _check_miss(witness: Witness) -> CalibrationCheck:
    px, share = witness.miss()
    level = MISS_PERCENT.judge(100.0 * share)
    size = f"{px:.1f} px, {100 * share:.1f} % of the person's height"
    if not math.isfinite(share):
        sentence, action = (
            "The lines of sight do not meet in front of the cameras.",
            OTHER_WAY,
        )
    elif level is CheckLevel.GREEN:
        sentence, action = f"The lines of sight meet: joints are off by {size}.", ""
    else:
        sentence = f"The lines of sight miss each other: joints are off by {size}."
        action = "A camera was moved or its lens changed after calibrating, or the videos are not "
        action += f"synchronised. {OTHER_WAY}"
    return CalibrationCheck("reprojection", level, sentence, action, 100.0 * share, "%")


def _check_mirror(witness: Witness) -> CalibrationCheck:
    agreement = witness.depth_agreement()
    level = MIRRORED.judge(-agreement)
    if not math.isfinite(agreement):
        level, sentence = (
            CheckLevel.GREEN,
            "The estimator gives no depth to tell a mirrored world by.",
        )
        return CalibrationCheck("mirror", level, sentence)
    if level is CheckLevel.GREEN:
        sentence, action = "Left and right lie where each view alone sees them.", ""
    else:
        sentence = "The world is mirrored in depth: what is near comes out far."
        action = "The videos or the cameras are probably exchanged: exchange them. "
        action += f"Otherwise: {OTHER_WAY}"
        if level is CheckLevel.AMBER:
            sentence = "Depths agree poorly with what each view alone shows."
    return CalibrationCheck("mirror", level, sentence, action, agreement, "")


def _check_ray_angle(witness: Witness) -> CalibrationCheck:
    angle = witness.ray_angle_deg()
    level = _judge_range(angle, *RAY_ANGLE_DEG)
    sentence = f"Seen from the person the cameras are {angle:.0f} degrees apart"
    sentence += " (70 to 110 is best)." if level is CheckLevel.GREEN else "; depth is poor then."
    action = "" if level is CheckLevel.GREEN else "Put them 70 to 110 degrees apart next time."
    return CalibrationCheck("ray_angle", level, sentence, action, angle, "deg")


def _check_stature(
    witness: Witness, calibration: Calibration, stature: Measurement
) -> CalibrationCheck:
    found, is_upright = witness.stature_m()
    off = 100.0 * (found / stature.value - 1.0)
    # An assumed stature can't prove a calibration wrong.
    slack = 1.96 * 100.0 * np.nan_to_num(stature.sigma) / stature.value
    slack = max(0.0, slack - STATURE_PERCENT.amber) + (0.0 if is_upright else NO_UPRIGHT_PERCENT)
    level = Limits(STATURE_PERCENT.amber + slack, STATURE_PERCENT.red + slack).judge(abs(off))
    how = "standing upright" if is_upright else "judged by the legs"
    sentence = f"The person comes out {found:.2f} m tall ({how}), {stature.value:.2f} m expected."
    action = ""
    if not math.isfinite(found):
        sentence = "The person's height can't be told: head, legs and feet are not seen enough."
        action = "Film a second of upright standing."
    elif level is not CheckLevel.GREEN:
        action = f"Lengths are off by {abs(off):.0f} %: check the stature, the size of the board's "
        action += f"squares or of the known points, and the focal length. {OTHER_WAY}"
    return CalibrationCheck("stature", level, sentence, action, off, "%")


def _check_ground(calibration: Calibration, witness: Witness) -> Iterator[CalibrationCheck]:
    """Check gravity and floor, where the calibration tells them."""
    up = np.asarray(calibration.up)
    if not np.isfinite(up).all():
        yield CalibrationCheck(
            "gravity",
            CheckLevel.GREEN,
            "The calibration does not say where up is; it is taken from the standing person.",
        )
        return
    yield _check_gravity(up, calibration, witness)
    if math.isfinite(calibration.floor_m):
        yield _check_floor(up, calibration.floor_m, witness)


def _check_gravity(up: Array, calibration: Calibration, witness: Witness) -> CalibrationCheck:
    axis = witness.upright_axis()
    if not np.isfinite(axis).all():
        sigma = float(np.nan_to_num(calibration.tilt_sigma_deg))
        level = TILT_SIGMA_DEG.judge(sigma)
        sentence = "The person never stands upright, so that up can't be checked"
        sentence += f" (known to {sigma:.0f} degrees)." if sigma else "."
        action = "" if level is CheckLevel.GREEN else "Film a second of upright standing."
        return CalibrationCheck("gravity", level, sentence, action, sigma, "deg")
    off = math.degrees(math.acos(float(np.clip(axis @ up, -1.0, 1.0))))
    level = GRAVITY_DEG.judge(off)
    if level is CheckLevel.GREEN:
        sentence, action = f"The standing person points up, within {off:.0f} degrees.", ""
    elif off > 60.0:
        sentence = f"Up is wrong: the standing person lies at {off:.0f} degrees to it."
        action = "Check which axis of the calibration points up."
    else:
        sentence = f"The standing person leans {off:.0f} degrees against the calibration's up."
        action = "Check that the camera or the board's floor picture was not moved. "
        action += OTHER_WAY
    return CalibrationCheck("gravity", level, sentence, action, off, "deg")


def _check_floor(up: Array, floor_m: float, witness: Witness) -> CalibrationCheck:
    above = witness.foot_height_m(up) - FOOT_M - floor_m
    if not math.isfinite(above):
        return CalibrationCheck(
            "floor",
            CheckLevel.AMBER,
            "The floor can't be checked: no foot is seen standing on it by both cameras.",
            "Film so that both cameras see the feet.",
        )
    level = FLOOR_M.judge(abs(above))
    if level is CheckLevel.GREEN:
        sentence, action = f"The feet stand on the floor, within {100 * abs(above):.0f} cm.", ""
    else:
        where = "below" if above > 0 else "above"
        sentence = f"The floor lies {100 * abs(above):.0f} cm {where} the person's feet: "
        sentence += "the calibration has another floor."
        action = "Say where the floor is (the thickness of a platform, the board's place), or "
        action += "calibrate on the floor on which the person stands."
    return CalibrationCheck("floor", level, sentence, action, 100.0 * above, "cm")


def _check_sides(witness: Witness) -> CalibrationCheck:
    share = 100.0 * witness.side_difference()
    level = SIDES_PERCENT.judge(share)
    sentence = f"Left and right leg differ by {share:.0f} % in length."
    action = ""
    if not math.isfinite(share):
        sentence, action = "The legs are not seen enough to compare them.", "Film the whole person."
    elif level is not CheckLevel.GREEN:
        action = f"One side is pulled in depth. {OTHER_WAY}"
    return CalibrationCheck("sides", level, sentence, action, share, "%")


def _check_spread(witness: Witness) -> CalibrationCheck:
    share = 100.0 * witness.length_spread()
    level = SPREAD_PERCENT.judge(share)
    sentence = f"Thighs and shanks keep their length within {share:.0f} %."
    action = ""
    if not math.isfinite(share):
        sentence, action = "The legs are not seen enough to measure them.", "Film the whole person."
    elif level is not CheckLevel.GREEN:
        sentence = f"Thighs and shanks change their length by {share:.0f} % as the person moves."
        action = f"Check that the videos are synchronised. {OTHER_WAY}"
    return CalibrationCheck("lengths", level, sentence, action, share, "%")


def _check_time(views: Sequence[ViewPose], calibration: Calibration) -> Iterator[CalibrationCheck]:
    shift, gain = find_shift(views, calibration.cameras)
    level = SHIFT_GAIN.judge(gain) if shift else CheckLevel.GREEN
    if level is CheckLevel.GREEN:
        sentence, action = "The videos fit best at the same time.", ""
    else:
        frames = f"{abs(shift)} frame{'s' if abs(shift) > 1 else ''}"
        sentence = f"The second video runs {frames} {'late' if shift > 0 else 'early'} against "
        sentence += "the first: the synchronisation is wrong."
        action = "Synchronise again (by sound, or give the offset in seconds)."
    yield CalibrationCheck("time", level, sentence, action, float(shift), "frames")
