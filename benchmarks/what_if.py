"""How well what-if foretells a changed lift, and how fast it answers, on the synthetic lifts.

Run from the project folder::

    nice -n 10 .venv/bin/python benchmarks/what_if.py

Every person lifted from three places to three others. One lift is asked what it would be like at
the places of another lift of the same person, and the answer is held against that other lift as
it was really done. Both from the true joints (what posing alone costs) and from one camera (what a
user gets). Answers are kept per person in a cache folder; give ``--fresh`` to start over. The
settings of the posing were chosen on the training persons only; P07 and P08 were never looked at.
"""

from __future__ import annotations

import argparse
import itertools
import json
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from monocular_lifts import TEST_PERSONS, find_videos, load_pose, read_truth
from risk import TASK, read_subject, true_exposure
from threadpoolctl import threadpool_limits

from engine import Config, Trial, View
from engine.datatypes import Lift
from engine.ergonomics.assess import assess_risk
from engine.ergonomics.base import Exposure
from engine.ergonomics.improvements import rank_changes
from engine.ergonomics.methods.l5s1 import METHOD as L5S1
from engine.ergonomics.methods.reba import METHOD as REBA
from engine.ergonomics.what_if import Change, apply_change, what_if
from engine.pipeline import assess_pose

MOVES = (("FK", "KS"), ("FS", "KS"), ("FS", "FK"), ("FK", "FS"), ("KS", "FS"))
"""From which kind of lift to which: floor or knuckle height, to knuckle or shoulder height."""
NAMES = {"FK": "floor-knuckle", "FS": "floor-shoulder", "KS": "knuckle-shoulder"}
REPETITIONS = ("01", "02")
CAMERA = "cam90"


def measured_exposure(video: Path, poses: Path) -> Exposure | None:
    """Return what one camera measured; None where it did not find exactly one lift."""
    subject = read_subject(video.parent.parent)
    trial = Trial(views=(View(video),), subject=subject, task=TASK)
    result = assess_pose(trial, load_pose(video, poses, Config()), Config())
    if len(result.lifts) != 1:
        return None
    time_s = result.corrected.time_s
    return Exposure(
        result.corrected,
        result.angles,
        result.lifts,
        subject,
        TASK,
        float(time_s[-1] - time_s[0]),
    )


def move_to(lift: Lift) -> Change:
    """Return the change that puts the hands where another lift has them."""
    return Change(
        origin_H_cm=lift.origin.H_cm.value,
        origin_V_cm=max(0.0, lift.origin.V_cm.value),
        destination_H_cm=lift.destination.H_cm.value,
        destination_V_cm=max(0.0, lift.destination.V_cm.value),
    )


def compare(
    source: str, before: Exposure, after: Exposure, names: tuple[str, str]
) -> dict[str, float | str]:
    """Ask one lift to be another, and hold the answer against it."""
    real = L5S1.assess(after)
    found = apply_change(before, move_to(after.lifts[0]))
    asked, filmed = L5S1.assess(found.exposure), L5S1.assess(before)
    low, high = asked.interval
    row: dict[str, float | str] = {
        "source": source,
        "move": f"{NAMES[names[0]]} to {NAMES[names[1]]}",
        "real": real.value,
        "filmed": filmed.value,
        "asked": asked.value,
        "held": float(low <= real.value <= high),
        "reba real": REBA.assess(after).value,
        "reba filmed": REBA.assess(before).value,
        "reba asked": REBA.assess(found.exposure).value,
        "unreached_cm": 100 * found.unreached_m,
    }
    for end in ("origin", "destination"):
        lifts = (after.lifts[0], before.lifts[0])
        wanted, got = (
            bend_at(exposure, getattr(lift, end).time_s)
            for exposure, lift in zip((after, found.exposure), lifts, strict=True)
        )
        row[f"bend {end}"] = got - wanted
    return row


def bend_at(exposure: Exposure, time_s: float) -> float:
    """Return the trunk's inclination at a moment, degrees."""
    frame = int(np.argmin(np.abs(exposure.angles.time_s - time_s)))
    return float(exposure.angles["trunk_inclination"][frame])


def measure_person(data: Path, poses: Path, person: str) -> Iterator[dict[str, float | str]]:
    """Compare all pairs of a person's lifts, true and measured, and time the answers."""
    subject = read_subject(data / person)
    true, seen = {}, {}
    for video in find_videos(data, [person]):
        kind, repetition = video.parent.name.split("_")[1:]
        if video.stem == CAMERA and repetition in REPETITIONS:
            key = kind, repetition
            true[key] = true_exposure(video.parent, read_truth(video.parent), subject)
            seen[key] = measured_exposure(video, poses)
    persons = "test" if person in TEST_PERSONS else "training"
    for one, two in MOVES:
        for first, second in itertools.product(REPETITIONS, repeat=2):
            after = true[two, second]
            for source, before in (
                ("true joints", true[one, first]),
                ("one camera", seen[one, first]),
            ):
                if before is not None:
                    row = compare(source, before, after, (one, two))
                    yield {"person": person, "persons": persons, **row}
    sample = next(exposure for exposure in seen.values() if exposure is not None)
    yield {
        "person": person,
        "persons": persons,
        "source": "times",
        **time_answers(lengthen(sample)),
    }


def lengthen(exposure: Exposure, seconds: float = 10.0) -> Exposure:
    """Return an exposure of a given length: its last posture is held."""
    track, angles = exposure.track, exposure.angles
    step = float(np.median(np.diff(track.time_s)))
    more = max(0, round((seconds - exposure.observed_s) / step))
    time_s = np.append(track.time_s, track.time_s[-1] + step * np.arange(1, more + 1))

    def hold(values: np.ndarray) -> np.ndarray:
        return np.concatenate([values, np.repeat(values[-1:], more, axis=0)])

    fields = ("position", "confidence", "sigma", "status")
    held = {name: hold(np.asarray(getattr(track, name))) for name in fields}
    curves = {
        name: hold(np.asarray(getattr(angles, name)))
        for name in ("value_deg", "sigma_deg", "status")
    }
    return replace(
        exposure,
        track=replace(track, time_s=time_s, **held),
        angles=replace(angles, time_s=time_s, **curves),
        observed_s=float(time_s[-1] - time_s[0]),
    )


def time_answers(exposure: Exposure) -> dict[str, float]:
    """Return processor times of the answers, s; new questions each time, nothing kept."""
    heights = iter(np.linspace(40.0, 90.0, 60))

    def ask(frames: bool) -> Callable[[], object]:
        return lambda: what_if(exposure, Change(origin_V_cm=next(heights)), frames=frames)

    loads = iter(np.linspace(5.0, 20.0, 60))
    return {
        "a change of place, methods that judge lifts": _time(ask(frames=False)),
        "a change of load, methods that judge lifts": _time(
            lambda: what_if(exposure, Change(load_kg=next(loads)), frames=False)
        ),
        "a change of place, every method": _time(ask(frames=True)),
        "every method as filmed": _time(lambda: assess_risk(exposure)),
        "ranking of all changes and pairs": _time(lambda: rank_changes(exposure)),
    }


def _time(function: Callable[[], object], n: int = 5) -> float:
    spent = []
    for _ in range(n):
        start = time.process_time()
        function()
        spent.append(time.process_time() - start)
    return float(np.median(spent))


# --------------------------------------------------------------------------- tables


def describe(part: pd.DataFrame) -> dict[str, str]:
    """Return the figures of one group."""

    def error(values: pd.Series, digits: int = 0) -> str:
        return f"{values.abs().mean():.{digits}f} ({values.mean():+.{digits}f})"

    real = part["real"]
    change, foretold = real - part["filmed"], part["asked"] - part["filmed"]
    same_way = (np.sign(change) == np.sign(foretold))[change.abs() > 200.0]
    return {
        "pairs": str(len(part)),
        "peak compression, MAE (bias), N": error(part["asked"] - real),
        "  if the lift stayed as filmed": error(part["filmed"] - real),
        "  real value in its 95 % interval": f"{part['held'].mean():.2f}",
        "  right way, changes above 200 N": f"{same_way.mean():.2f}",
        "trunk at lift-off, MAE (bias), deg": error(part["bend origin"], 1),
        "trunk at set-down, MAE (bias), deg": error(part["bend destination"], 1),
        "REBA, MAE (bias)": error(part["reba asked"] - part["reba real"], 1),
        "  REBA if the lift stayed as filmed": error(part["reba filmed"] - part["reba real"], 1),
    }


def summarise(rows: pd.DataFrame) -> str:
    """Return the tables."""
    pairs = rows[rows["source"] != "times"]
    groups = {
        f"{persons}, {source}": describe(part)
        for (persons, source), part in pairs.groupby(["persons", "source"])
    }
    moves = pairs.assign(
        error=pairs["asked"] - pairs["real"], still=pairs["filmed"] - pairs["real"]
    )
    table = moves.groupby(["persons", "source", "move"])[["error", "still"]].agg(
        lambda values: f"{values.abs().mean():.0f} ({values.mean():+.0f})"
    )
    times = rows[rows["source"] == "times"].dropna(axis=1).select_dtypes("number")
    spent = "\n".join(f"  {name:48} {1000 * v:6.0f} ms" for name, v in times.median().items())
    return (
        f"{pd.DataFrame(groups).to_string()}\n\n"
        "Peak compression by kind of change, MAE (bias), N: foretold, and if it stayed as filmed\n"
        f"{table.to_string()}\n\n"
        f"Processor time for 10 s of video, median over persons:\n{spent}"
    )


def main() -> None:
    """Run the comparison and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data/synthetic_lifts"))
    parser.add_argument("--poses", type=Path, default=Path(".benchmark_cache/monocular_lifts"))
    parser.add_argument("--cache", type=Path, default=Path(".benchmark_cache/what_if"))
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/what_if"))
    parser.add_argument("--persons", nargs="*", help="for example P01 P07; all if left out")
    parser.add_argument("--fresh", action="store_true", help="forget cached answers")
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    rows: list[dict[str, float | str]] = []
    for person in options.persons or sorted(p.name for p in options.data.glob("P*")):
        file = options.cache / f"{person}.json"
        if options.fresh or not file.exists():
            with threadpool_limits(limits=1, user_api="blas"):
                found = list(measure_person(options.data, options.poses, person))
            part = file.with_suffix(".part")
            part.write_text(json.dumps(found))
            part.rename(file)
            print(person, flush=True)
        rows += json.loads(file.read_text())
    only = f" --persons {' '.join(options.persons)}" if options.persons else ""
    head = (
        "What-if against what was really done: a lift asked to be another of the same person.\n"
        f"Command: python benchmarks/what_if.py{only}. {platform.machine()}, "
        f"Python {platform.python_version()}; nothing in it is random.\n"
        "Synthetic lifts of 10 kg. MAE: mean absolute error; in brackets the mean signed error.\n"
    )
    text = f"{head}\n{summarise(pd.DataFrame(rows))}\n"
    print(text)
    options.out.with_suffix(".txt").write_text(text)
    pairs = pd.DataFrame(row for row in rows if row["source"] != "times").dropna(axis=1)
    pairs.to_csv(options.out.with_suffix(".csv"), index=False, float_format="%.4g")


if __name__ == "__main__":
    main()
