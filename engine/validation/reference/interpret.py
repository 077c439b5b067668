"""From what a file says to what it means: unit, axes, names, sides and signs.

Nothing is assumed in silence: every decision becomes a `Finding` with its evidence, and an import
profile overrides it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from engine.datatypes import Array, JointAngles
from engine.errors import DataError, UnitError
from engine.validation.profiles import AngleRule, Axes, ImportProfile, parse_axes
from engine.validation.reference.angle_names import AngleSource, match_angles
from engine.validation.reference.base import (
    AngleUnit,
    Finding,
    LengthUnit,
    Markers,
    Recording,
    Reference,
)
from engine.validation.reference.naming import match_labels, strip_prefixes
from engine.validation.reference.trunk import add_trunk_angles

__all__ = ["interpret"]

METRES: Mapping[LengthUnit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}
BODY_RADIUS_M = (0.12, 1.5)
"""How far four fifths of a person's markers lie from the middle, at most: arm to whole body."""
SAMPLE_FRAMES = 200
START_S = 1.0
MAX_RADIANS = 2 * np.pi
SWAP_COSINE = -0.5
BENT_BACK_DEG = -15.0


class _Named(NamedTuple):
    """Markers with stripped labels and what these mean."""

    labels: tuple[str, ...]
    position: Array
    landmarks: dict[str, str]

    def point(self, *names: str) -> Array | None:
        """Return the mean of landmarks that the file has, shape (T, 3); None if it has none."""
        columns = [self.labels.index(self.landmarks[n]) for n in names if n in self.landmarks]
        return np.asarray(self.position[:, columns].mean(axis=1)) if columns else None


def interpret(recording: Recording, profile: ImportProfile | None = None) -> Reference:
    """Turn a recording into metres, Y up, and our names and signs.

    Parameters
    ----------
    recording
        As read.
    profile
        What is known already; the rest is detected.

    Raises
    ------
    DataError
        If the recording holds neither markers nor a known angle, or a profile names a label or
        column that the file has not.
    UnitError
        If the markers can't be a person in the unit stated.
    """
    rules = profile or ImportProfile()
    findings: list[Finding] = [_find_rate(recording)]
    notes = list(recording.notes)
    settings: dict[str, Any] = {"format": recording.format, "swap_sides": rules.swap_sides}
    markers, landmarks = _interpret_markers(recording, rules, findings, notes, settings)
    angles = _interpret_angles(recording, rules, findings, notes, settings)
    if markers is None and angles is None:
        first = ", ".join(recording.curves[:4]) or "no columns"
        raise DataError(
            f"{recording.name} holds no markers and no angle with a known name (found: {first}); "
            "name the columns of the angles in an import profile."
        )
    return Reference(
        name=recording.name,
        format=recording.format,
        markers=markers,
        angles=angles,
        landmarks=landmarks,
        findings=tuple(findings),
        notes=tuple(note for note in notes if note),
        settings=settings,
    )


def _find_rate(recording: Recording) -> Finding:
    time = recording.time_s
    if time.size < 2:
        return Finding("rate", "one frame", 0.0, "the file holds a single frame")
    rate = 1.0 / float(np.median(np.diff(time)))
    return Finding("rate", f"{rate:.4g} Hz", 1.0, f"{time.size} frames, {time[-1] - time[0]:.2f} s")


# --------------------------------------------------------------------------- markers


def _interpret_markers(
    recording: Recording,
    rules: ImportProfile,
    findings: list[Finding],
    notes: list[str],
    settings: dict[str, Any],
) -> tuple[Markers | None, dict[str, str]]:
    if not recording.labels:
        return None, {}
    labels, kept, note = strip_prefixes(recording.labels)
    notes.append(note)
    position = np.asarray(recording.position[:, list(kept)])
    # A point with two coordinates is no point.
    position = np.where(np.isfinite(position).all(axis=2, keepdims=True), position, np.nan)
    if not np.isfinite(position).any():
        return None, {}
    unit, finding = _find_length_unit(recording, position, rules.length_unit)
    findings.append(finding)
    landmarks = _find_landmarks(recording.name, labels, rules, findings)
    named = _Named(labels, position * METRES[unit], landmarks)
    axes, finding = _find_axes(recording, named, rules.axes)
    findings.append(finding)
    columns, signs = zip(*parse_axes(axes), strict=True)
    turned = named._replace(position=named.position[:, :, list(columns)] * np.array(signs))
    sides = _find_sides(recording.time_s, turned)
    if sides is not None:
        findings.append(sides)
    settings |= {"length_unit": unit, "axes": axes}
    return Markers(recording.time_s, turned.position, labels), landmarks


def _find_length_unit(
    recording: Recording, position: Array, given: LengthUnit | None
) -> tuple[LengthUnit, Finding]:
    """Return the unit: given, stated or by the size of a person, and checked against that."""
    step = max(1, position.shape[0] // SAMPLE_FRAMES)
    sample = position[::step]
    sample = sample[np.isfinite(sample).any(axis=(1, 2))]
    sample = sample if len(sample) else position[np.isfinite(position).any(axis=(1, 2))][:1]
    middle = np.nanmedian(sample, axis=1, keepdims=True)
    distance = np.sqrt(((sample - middle) ** 2).sum(axis=2))
    size = float(np.nanpercentile(distance, 80))
    low, high = BODY_RADIUS_M
    fitting = [unit for unit, metres in METRES.items() if low <= size * metres <= high]
    unit = given or recording.length_unit
    if unit is None:
        if not fitting:
            raise UnitError(
                f"{recording.name} states no unit, and its markers spread over {size:.3g}, which "
                "is no person in m, cm or mm; set length_unit in an import profile."
            )
        return fitting[0], Finding("unit", fitting[0], 0.85, "the size of a person")
    stated = "set by the profile" if given else "stated by the file"
    if unit not in fitting and len(recording.labels) > 2:
        advice = f"they look like {fitting[0]}" if fitting else "check the unit"
        raise UnitError(
            f"{recording.name}: the unit {unit} is {stated}, but the markers then spread over "
            f"{size * METRES[unit]:.3g} m, which is no person; {advice}. Set length_unit in an "
            "import profile."
        )
    return unit, Finding("unit", unit, 1.0, stated)


def _find_landmarks(
    name: str, labels: tuple[str, ...], rules: ImportProfile, findings: list[Finding]
) -> dict[str, str]:
    match = match_labels(labels)
    landmarks = dict(match.landmarks) if match else {}
    missing = [label for label in rules.labels if label not in labels]
    if missing:
        raise DataError(
            f"The import profile names the label {missing[0]!r}, which {name} has not; it has "
            f"{', '.join(labels[:6])} and so on."
        )
    if rules.labels:
        named = set(rules.labels)
        landmarks = {k: v for k, v in landmarks.items() if v not in named}
        landmarks |= {landmark: label for label, landmark in rules.labels.items()}
        findings.append(Finding("labels", "profile", 1.0, f"{len(named)} labels by the profile"))
    elif match:
        why = f"{len(landmarks)} of {len(labels)} labels known"
        findings.append(Finding("labels", match.title, match.score, why))
    else:
        why = f"no known set of labels fits {', '.join(labels[:4])} ..."
        findings.append(Finding("labels", "unknown", 0.0, why))
    return _exchange(landmarks) if rules.swap_sides else landmarks


def _exchange(names: Mapping[str, str]) -> dict[str, str]:
    return {_other_side(name): label for name, label in names.items()}


def _other_side(name: str) -> str:
    if name.startswith("left_"):
        return f"right_{name[5:]}"
    return f"left_{name[6:]}" if name.startswith("right_") else name


def _both(name: str) -> tuple[str, str]:
    return f"left_{name}", f"right_{name}"


_UPPER = ("acromion", "shoulder", "front_shoulder", "ear")
_PELVIS = ("asis", "hip", "psis")
_LOWER = ("lateral_ankle", "ankle", "heel")


def _first(named: _Named, words: tuple[str, ...]) -> Array | None:
    """Return the first of these landmarks that was ever seen, both sides averaged."""
    points = (named.point(*_both(word)) for word in words)
    return next((p for p in points if p is not None and _is_seen(p)), None)


def _is_seen(points: Array) -> bool:
    return bool(np.isfinite(points).all(axis=-1).any())


def _median(rows: Array) -> Array:
    """Return the median of the rows (T, D) that are complete; NaN if none is."""
    known = rows[np.isfinite(rows).all(axis=1)]
    return np.asarray(np.median(known, axis=0)) if len(known) else np.full(rows.shape[1], np.nan)


def _find_axes(recording: Recording, named: _Named, given: Axes | None) -> tuple[Axes, Finding]:
    if given is not None:
        return given, Finding("axes", ", ".join(given), 1.0, "set by the profile")
    up, score, why = _find_up(named)
    front = _find_front(recording.time_s, named, up)
    right = np.cross(front, up)
    axes = (_axis_name(front), _axis_name(up), _axis_name(right))
    return axes, Finding("axes", ", ".join(axes), score, f"up is {_axis_name(up)}: {why}")


def _axis_name(direction: Array) -> str:
    column = int(np.argmax(np.abs(direction)))
    return ("-" if direction[column] < 0 else "") + "xyz"[column]


def _snap(direction: Array) -> Array:
    """Return the axis nearest to a direction."""
    column = int(np.argmax(np.abs(direction)))
    return np.asarray(np.eye(3)[column] * (1.0 if direction[column] >= 0 else -1.0))


def _find_up(named: _Named) -> tuple[Array, float, str]:
    """Return the upward axis, how sure it is, and why."""
    top, pelvis, feet = (_first(named, words) for words in (_UPPER, _PELVIS, _LOWER))
    if top is None:
        spine = (named.point(name) for name in ("c7", "notch", "vertex"))
        top = next((p for p in spine if p is not None and _is_seen(p)), None)
    above = top if pelvis is None else pelvis
    if feet is not None and above is not None:
        lines, words = above - feet, "body above the feet"
    elif pelvis is not None and top is not None:
        lines, words = top - pelvis, "shoulders above the pelvis"
    else:
        return _find_tall_axis(named.position)
    line = _median(lines)
    if not np.isfinite(line).all() or not line.any():
        return _find_tall_axis(named.position)
    share = float(np.abs(line).max() / np.linalg.norm(line))
    # Straight up is certain; at 45 degrees two axes are as good as each other.
    score = float(np.clip((share - 0.70) / 0.25, 0.0, 1.0))
    return _snap(line), score, words


def _find_tall_axis(position: Array) -> tuple[Array, float, str]:
    """Take the axis along which the markers spread most; the floor is at 0, so up is positive."""
    seen = position[np.isfinite(position).any(axis=(1, 2))]
    spread = np.median(np.nanmax(seen, axis=1) - np.nanmin(seen, axis=1), axis=0)
    column = int(np.argmax(spread))
    middle = float(np.nanmedian(seen[:, :, column]))
    second = float(np.sort(spread)[-2])
    score = 0.7 * float(np.clip((spread[column] / max(second, 1e-9) - 1.0) / 1.5, 0.0, 1.0))
    direction = np.eye(3)[column] * (1.0 if middle >= 0 else -1.0)
    return direction, score, "the axis along which the markers spread most"


def _find_front(time_s: Array, named: _Named, up: Array) -> Array:
    """Return the horizontal axis nearest to where the body faces at the start."""
    across = _across(named)
    start = time_s <= time_s[0] + START_S
    if across is not None and np.isfinite(across[start]).all(axis=1).any():
        # Front = up x right, as X = Y x Z.
        front = np.cross(up, _median(across[start]))
        if np.linalg.norm(front) > 0:
            return _snap(front)
    # Keep the cyclic order, so that a file with Y up is left alone.
    return np.roll(np.abs(up), -1) if abs(up[1]) < 0.5 else np.array([1.0, 0.0, 0.0])


def _across(named: _Named) -> Array | None:
    """Return the line from left to right, of the hips where they are marked, else shoulders."""
    for word in (*_PELVIS, *_UPPER, "lateral_ankle", "ankle"):
        left, right = (named.point(f"{side}_{word}") for side in ("left", "right"))
        if left is not None and right is not None and _is_seen(right - left):
            return np.asarray(right - left)
    return None


_TOES = ("toe", "big_toe", "first_metatarsal", "fifth_metatarsal")
_FRONT_PAIRS = (
    (("asis",), ("psis",), "the front points of the pelvis", "the back ones"),
    (_TOES, ("heel",), "the toes", "the heels"),
    (_TOES, ("lateral_ankle", "ankle"), "the toes", "the ankles"),
)


def _find_sides(time_s: Array, named: _Named) -> Finding | None:
    """Compare where the body faces by left and right with where toes and pelvis point."""
    across = _across(named)
    if across is None:
        return None
    by_sides = np.cross([0.0, 1.0, 0.0], across)
    for fronts, backs, this, that in _FRONT_PAIRS:
        front = _first(named, fronts)
        back = _first(named, backs)
        if front is None or back is None:
            continue
        line = (front - back) * np.array([1.0, 0.0, 1.0])
        with np.errstate(invalid="ignore", divide="ignore"):
            cosines = (line * by_sides).sum(axis=1) / np.linalg.norm(line, axis=1)
            cosines /= np.linalg.norm(by_sides, axis=1)
        cosine = float(_median(cosines[:, None])[0])
        if not np.isfinite(cosine):
            continue
        if cosine < SWAP_COSINE:
            why = f"{this} would be behind {that}: sides exchanged or an axis mirrored"
            return Finding("sides", "swapped", 0.0, why)
        score = min(1.0, max(cosine, 0.0) / 0.8)
        return Finding("sides", "as labelled", score, f"{this} are before {that}")
    return None


# --------------------------------------------------------------------------- angles


def _interpret_angles(
    recording: Recording,
    rules: ImportProfile,
    findings: list[Finding],
    notes: list[str],
    settings: dict[str, Any],
) -> JointAngles | None:
    system, sources = match_angles(recording.curves)
    sources = _apply_rules(recording, sources, rules.angles)
    if not sources:
        return None
    columns = [recording.curves.index(source.column) for source in sources]
    value, sigma = recording.value[:, columns], np.asarray(recording.sigma)[:, columns]
    unit, finding = _find_angle_unit(recording, value, rules.angle_unit)
    findings.append(finding)
    if unit == "rad":
        value, sigma = np.degrees(value), np.degrees(sigma)
    signs = np.array([source.sign for source in sources])
    names = tuple(source.ours for source in sources)
    value = value * signs
    flipped = [] if rules.angles else _find_flipped_knees(names, value)
    value[:, flipped] *= -1.0
    if flipped:
        why = "knees bend only one way, so this model counts flexion as negative"
        findings.append(Finding("knee sign", "flexion negative in the file", 0.95, why))
    why = f"{len(sources)} of {len(recording.curves)} columns known"
    shown = "profile" if rules.angles else system
    findings.append(Finding("angle names", shown, 1.0 if rules.angles else 0.9, why))
    _report_unused(recording, sources, notes)
    settings |= {
        "angle_unit": unit,
        "angles": {
            s.ours: AngleRule(s.column, -s.sign if i in flipped else s.sign)
            for i, s in enumerate(sources)
        },
    }
    if rules.swap_sides:
        names = tuple(_other_suffix(name) for name in names)
    angles = JointAngles(recording.time_s, value, names, sigma)
    return add_trunk_angles(angles, notes)


def _apply_rules(
    recording: Recording, sources: tuple[AngleSource, ...], rules: Mapping[str, AngleRule]
) -> tuple[AngleSource, ...]:
    missing = [rule.column for rule in rules.values() if rule.column not in recording.curves]
    if missing:
        raise DataError(
            f"The import profile names the column {missing[0]!r}, which {recording.name} has not; "
            f"it has {', '.join(recording.curves[:6]) or 'no angles'}."
        )
    own = {s.ours: s for s in sources}
    own |= {angle: AngleSource(angle, rule.column, rule.sign) for angle, rule in rules.items()}
    return tuple(own.values())


def _other_suffix(name: str) -> str:
    if name.endswith("_l"):
        return f"{name[:-2]}_r"
    return f"{name[:-2]}_l" if name.endswith("_r") else name


def _find_angle_unit(
    recording: Recording, value: Array, given: AngleUnit | None
) -> tuple[AngleUnit, Finding]:
    largest = float(np.nanmax(np.abs(value))) if np.isfinite(value).any() else np.nan
    by_size: AngleUnit = "rad" if largest <= MAX_RADIANS else "deg"
    unit = given or recording.angle_unit
    if unit is None:
        # A person who hardly moves has small angles in degrees, too.
        score = 0.9 if by_size == "deg" else 0.6
        return by_size, Finding("angle unit", by_size, score, f"largest value {largest:.3g}")
    stated = "set by the profile" if given else "stated by the file"
    if unit != by_size and not given:
        why = f"{stated}, but the largest value is {largest:.3g}, which looks like {by_size}"
        return unit, Finding("angle unit", unit, 0.3, why)
    return unit, Finding("angle unit", unit, 1.0, stated)


def _find_flipped_knees(names: tuple[str, ...], value: Array) -> list[int]:
    knees = [i for i, name in enumerate(names) if name.startswith("knee_flexion")]
    found = []
    for i in knees:
        curve = value[np.isfinite(value[:, i]), i]
        low, high = np.percentile(curve, [1, 99]) if curve.size else (0.0, 0.0)
        if low < BENT_BACK_DEG and abs(low) > abs(high):
            found.append(i)
    return found


def _report_unused(
    recording: Recording, sources: tuple[AngleSource, ...], notes: list[str]
) -> None:
    used = {source.column for source in sources}
    unused = [name for name in recording.curves if name not in used]
    if unused:
        more = " and others" if len(unused) > 5 else ""
        notes.append(f"Columns without a counterpart: {', '.join(unused[:5])}{more}.")
