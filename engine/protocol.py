"""The validation protocol of the two-view lifting method, step by step; the one place that knows.

Markers and pictures are read, frames are cut into folds, an estimator is trained on each and judged
on what it did not see, and inverse kinematics turns its markers into angles. What is finished is
kept in the output folder: the same command goes on where it was stopped.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from engine.datatypes import Array, ProgressCallback, ignore_progress
from engine.errors import ConfigError, DataError
from engine.kinematics.markers import fit_markers
from engine.pose.twin_gp import FEATURES, REGRESSORS, ModelSource, TwinGPModel, train_model
from engine.protocol_features import Embedding, Observe, embed_person, embed_together
from engine.protocol_inputs import Cache, PersonData, name_angles, read_person, write_arrays
from engine.protocol_outputs import draw_pictures, write_reference, write_study
from engine.protocol_stored import PREDICTIONS_FOLDER, RUN_NAME, name_method_folder
from engine.storage.atomic import explain_os_errors, write_aside
from engine.validation.protocol.dataset import Dataset, Views, read_dataset
from engine.validation.protocol.figures import choose_example
from engine.validation.protocol.folds import (
    GUARD_S,
    N_FOLDS,
    Fold,
    FoldKind,
    TrialFrames,
    make_folds,
)
from engine.validation.protocol.leak import LeakCheck, Neighbours, check_leak, find_neighbours
from engine.validation.protocol.statistics import MethodResult, MethodTrial, Study

__all__ = ["ProtocolRequest", "run_protocol"]

logger = logging.getLogger(__name__)

RUN_VERSION = 1
"""Raised whenever what a fold's file holds changes."""


@dataclass(frozen=True)
class ProtocolRequest:
    """What to run; see `engine.cli_protocol` for the options.

    `cache` is where features are kept between runs, by default in the output folder.
    """

    dataset: Path
    out: Path
    estimators: tuple[str, ...] = ("tgp-constrained",)
    features: tuple[str, ...] = ("hog",)
    folds: FoldKind = "trial"
    n_folds: int = N_FOLDS
    guard_s: float = GUARD_S
    persons: tuple[str, ...] = ()
    views: Views = "2"
    train_repetitions: int | None = None
    ik: Literal["builtin", "opensim"] = "builtin"
    seed: int = 0
    cache: Path | None = None
    skip_unusable: bool = False

    def __post_init__(self) -> None:
        _require_known("--estimator", self.estimators, tuple(REGRESSORS))
        _require_known("--features", self.features, tuple(FEATURES))
        if self.ik not in ("builtin", "opensim"):
            raise ConfigError(f"--ik must be builtin or opensim, got {self.ik!r}.")
        if self.train_repetitions is not None and self.folds != "trial":
            raise ConfigError("--train-repetitions is for trial-wise folds only.")

    @property
    def identity(self) -> dict[str, Any]:
        """What the finished folds in an output folder depend on."""
        return {
            "version": RUN_VERSION,
            "dataset": str(self.dataset.expanduser().resolve()),
            "folds": self.folds,
            "n_folds": self.n_folds,
            "guard_s": self.guard_s,
            # Elsewhere every person is trained alone, so that persons may be added to a run.
            "persons": list(self.persons) if self.folds == "subject" else [],
            "views": self.views,
            "train_repetitions": self.train_repetitions,
            "ik": self.ik,
            "seed": self.seed,
            "skip_unusable": self.skip_unusable,
        }


def _require_known(option: str, names: Sequence[str], known: Sequence[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        got = repr(unknown[0]) if unknown else "nothing"
        raise ConfigError(
            f"{option} must be among {', '.join(known)}, or all; got {got}. Separate several by "
            "commas."
        )


def run_protocol(
    request: ProtocolRequest,
    *,
    observe: Observe,
    progress: ProgressCallback = ignore_progress,
) -> Path:
    """Run the whole protocol and write its folder.

    Parameters
    ----------
    request
        What to run.
    observe
        Finds landmarks in a video, for features that use them.
    progress
        Told of every step; may raise `Cancelled`, finished folds are then kept.

    Returns
    -------
    Path
        The output folder with study.json, tables, figures, report.html and report.pdf.

    Raises
    ------
    EngineError
        With one sentence that says what was expected, what came and what to do.
    """
    out = _prepare(request)
    cache = Cache((request.cache or out / "cache").expanduser())
    dataset = read_dataset(
        request.dataset,
        persons=request.persons,
        views=request.views,
        skip_unusable=request.skip_unusable,
    )
    with threadpool_limits(limits=1, user_api="blas"):
        persons = list(_read_persons(dataset, cache, request, progress))
        units = _make_units(persons, request)
        run = _Run(request, out, cache, observe, progress)
        methods = [
            method
            for features in request.features
            for method in _run_features(run, units, features)
        ]
        write_reference(persons, out)
        study = _gather(dataset, persons, run, methods)
        overlays = draw_pictures(choose_example(study.main), persons, progress)
        write_study(study, overlays, out, progress)
    return out


# --------------------------------------------------------------------------- before


def _prepare(request: ProtocolRequest) -> Path:
    """Make the output folder, or take up the run in it if it is the same."""
    out = request.out.expanduser().resolve()
    if out.is_file():
        raise ConfigError(f"--out needs a folder, but {out} is a file.")
    mark = out / RUN_NAME
    if out.is_dir() and any(out.iterdir()) and not mark.is_file():
        raise ConfigError(
            f"--out needs a new or empty folder, or one with an earlier run, but {out} holds other "
            "files; choose another folder."
        )
    if mark.is_file():
        _require_same(mark, request)
    with explain_os_errors(out, "The study"):
        out.mkdir(parents=True, exist_ok=True)
        with write_aside(mark) as aside:
            aside.write_text(json.dumps(request.identity, indent=1), encoding="utf-8")
    return out


def _require_same(mark: Path, request: ProtocolRequest) -> None:
    try:
        earlier = json.loads(mark.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ConfigError(
            f"{mark} is damaged ({error}); delete the folder, or choose another with --out."
        ) from error
    other = [key for key, value in request.identity.items() if earlier.get(key) != value]
    if other:
        raise ConfigError(
            f"{mark.parent} holds a run with another {other[0].replace('_', ' ')} "
            f"({earlier.get(other[0])!r}, now {request.identity[other[0]]!r}); choose another "
            "folder with --out."
        )


def _read_persons(
    dataset: Dataset, cache: Cache, request: ProtocolRequest, progress: ProgressCallback
) -> Iterator[PersonData]:
    for subject in dataset.subjects:
        yield read_person(
            subject,
            cache,
            ik=request.ik,
            skip_unusable=request.skip_unusable,
            progress=progress,
        )


@dataclass(frozen=True, eq=False)
class _Unit:
    """Persons that are trained and judged together, and how their frames are cut."""

    persons: tuple[PersonData, ...]
    folds: tuple[Fold, ...]

    @property
    def frames(self) -> tuple[TrialFrames, ...]:
        return tuple(frames for person in self.persons for frames in person.frames)

    @property
    def marker_m(self) -> Array:
        return np.concatenate([person.marker_m for person in self.persons])

    @property
    def name(self) -> str:
        return self.persons[0].label if len(self.persons) == 1 else "all"


def _make_units(persons: Sequence[PersonData], request: ProtocolRequest) -> list[_Unit]:
    """Cut every person's frames, or all persons' together; wrong numbers are found here."""
    if request.folds == "subject":
        frames = [frames for person in persons for frames in person.frames]
        sets = {person.trials[0].marker_names for person in persons}
        if len(sets) > 1:
            raise DataError(
                "The persons have different marker sets, so they can't be trained together; use "
                "--folds trial."
            )
        return [_Unit(tuple(persons), make_folds(frames, "subject"))]
    return [
        _Unit(
            (person,),
            make_folds(
                person.frames,
                request.folds,
                n_folds=request.n_folds,
                guard_s=request.guard_s,
                train_repetitions=request.train_repetitions,
                seed=request.seed,
            ),
        )
        for person in persons
    ]


# --------------------------------------------------------------------------- estimators


@dataclass(frozen=True, eq=False)
class _Run:
    """What every step needs."""

    request: ProtocolRequest
    out: Path
    cache: Cache
    observe: Observe
    progress: ProgressCallback
    leaks: dict[str, LeakCheck] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class _FoldOutcome:
    """Markers (n, M, 3) of a fold's test frames, their standard errors, and how they came to be."""

    markers_m: Array
    sigma_m: Array
    fit_s: float
    predict_s: float
    settings: Mapping[str, Any]


def _run_features(run: _Run, units: Sequence[_Unit], features: str) -> list[MethodResult]:
    """Run all estimators on one kind of features."""
    names = [name for name in run.request.estimators if _is_possible(run, name)]
    done: dict[str, list[MethodTrial]] = {name: [] for name in names}
    folds: dict[str, list[tuple[str, _FoldOutcome]]] = {name: [] for name in names}
    neighbours: list[Neighbours] = []
    for unit in units:
        embedding = _embed(run, unit, features)
        for fold in unit.folds:
            run.progress(f"{fold.name}: nearest neighbours", 0, 0)
            neighbours.append(
                find_neighbours(_without_gaps(embedding), unit.marker_m, unit.frames, fold)
            )
        for name in names:
            outcomes = [_run_fold(run, unit, embedding, features, name, k)
                        for k in range(len(unit.folds))]  # fmt: skip
            folds[name] += [(f.name, o) for f, o in zip(unit.folds, outcomes, strict=True)]
            done[name] += _fit_angles(run, unit, f"{features}/{name}", outcomes)
    trials = [t.measured_m for unit in units for person in unit.persons for t in person.trials]
    run.leaks[features] = check_leak(neighbours, trials)
    return [_collect(f"{features}/{name}", done[name], folds[name]) for name in names]


def _is_possible(run: _Run, name: str) -> bool:
    """Whether an estimator can be judged with these folds; a note says why not."""
    if not REGRESSORS[name].smooths or run.request.folds in ("trial", "subject"):
        return True
    note = f"{name} filters over time, which needs whole recordings: left out of these folds."
    if note not in run.notes:
        run.notes.append(note)
    return False


def _embed(run: _Run, unit: _Unit, features: str) -> Embedding:
    if len(unit.persons) == 1:
        return embed_person(
            unit.persons[0], features, run.cache, observe=run.observe, progress=run.progress
        )
    return embed_together(
        unit.persons, features, run.cache, observe=run.observe, progress=run.progress
    )


def _without_gaps(embedding: Embedding) -> NDArray[np.float32]:
    """Return features for comparing: frames without landmarks are far from all others."""
    return np.nan_to_num(embedding.values, nan=1e3)


def _run_fold(
    run: _Run, unit: _Unit, embedding: Embedding, features: str, name: str, k: int
) -> _FoldOutcome:
    """Train and estimate, unless an earlier run has done so."""
    fold = unit.folds[k]
    folder = run.out / PREDICTIONS_FOLDER / name_method_folder(f"{features}/{name}") / "folds"
    path = folder / f"{unit.name}_{k + 1}.npz"
    run.progress(f"{fold.name}: {features}/{name}", k, len(unit.folds))
    if path.is_file():
        return _read_outcome(path)
    outcome = _train_and_estimate(run, unit, embedding, features, name, fold)
    arrays = {
        "markers_m": outcome.markers_m.astype(np.float32),
        "sigma_m": outcome.sigma_m.astype(np.float32),
        "times_s": np.array([outcome.fit_s, outcome.predict_s]),
        "settings": np.array(json.dumps(outcome.settings)),
    }
    write_arrays(path, arrays)
    return _read_outcome(path)


def _read_outcome(path: Path) -> _FoldOutcome:
    with np.load(path, allow_pickle=False) as data:
        fit_s, predict_s = map(float, data["times_s"])
        return _FoldOutcome(
            data["markers_m"].astype(np.float64),
            data["sigma_m"].astype(np.float64),
            fit_s,
            predict_s,
            json.loads(str(data["settings"])),
        )


def _train_and_estimate(
    run: _Run, unit: _Unit, embedding: Embedding, features: str, name: str, fold: Fold
) -> _FoldOutcome:
    first = unit.persons[0]
    trial_of = np.repeat(np.arange(len(unit.frames)), [f.n_frames for f in unit.frames])
    start = time.perf_counter()
    model = train_model(
        embedding.values[fold.train],
        unit.marker_m[fold.train],
        trial_of[fold.train],
        marker_names=first.trials[0].marker_names,
        regressor=name,
        blocks=embedding.blocks,
        source=ModelSource(features=features, subject=unit.name, rate_hz=first.rate_hz),
        seed=run.request.seed,
    )
    trained = time.perf_counter()
    asked = np.flatnonzero(fold.test)
    shape = (asked.size, len(model.marker_names))
    markers, sigma = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    # One recording at a time: some estimators filter over it.
    for number in np.unique(trial_of[asked]):
        rows = np.flatnonzero(trial_of[asked] == number)
        found = model.predict(embedding.values[asked[rows]])
        markers[rows], sigma[rows] = found.markers_m, found.sigma_m
    return _FoldOutcome(
        markers,
        sigma,
        trained - start,
        time.perf_counter() - trained,
        _describe_model(model, int(fold.train.sum()), asked.size),
    )


def _describe_model(model: TwinGPModel, n_train: int, n_test: int) -> dict[str, Any]:
    hyper = model.hyper
    return {
        "n_train": n_train,
        "n_test": n_test,
        "inner_error_mm": round(1000.0 * model.inner_error_m, 3),
        "gamma_r": list(hyper.gamma_r),
        "lambda_r": hyper.lambda_r,
        "gamma_x": hyper.gamma_x,
        "lambda_x": hyper.lambda_x,
        "neighbours": hyper.neighbours,
        "cutoff_hz": hyper.cutoff_hz,
    }


# --------------------------------------------------------------------------- angles


def _fit_angles(
    run: _Run, unit: _Unit, method: str, outcomes: Sequence[_FoldOutcome]
) -> list[MethodTrial]:
    """Put a unit's folds together, trial by trial, and work out the angles of its markers."""
    n_markers = unit.marker_m.shape[1]
    n = unit.folds[0].test.size
    markers, sigma = np.full((n, n_markers, 3), np.nan), np.full((n, n_markers), np.nan)
    for fold, outcome in zip(unit.folds, outcomes, strict=True):
        markers[fold.test], sigma[fold.test] = outcome.markers_m, outcome.sigma_m
    done: list[MethodTrial] = []
    start = 0
    total = sum(len(person.trials) for person in unit.persons)
    for person in unit.persons:
        for trial in person.trials:
            run.progress(f"{person.label}: angles of {method}", len(done), total)
            part = slice(start, start + trial.time_s.size)
            start += trial.time_s.size
            path = (
                run.out
                / PREDICTIONS_FOLDER
                / name_method_folder(method)
                / f"{trial.subject}_{trial.label}"
            )
            curves = _angles_of(run, person, markers[part], sigma[part], trial.time_s,
                                path.with_name(f"{path.name}.npz"))  # fmt: skip
            done.append(MethodTrial(trial, markers[part], curves))
    return done


def _angles_of(
    run: _Run, person: PersonData, markers: Array, sigma: Array, time_s: Array, path: Path
) -> Array:
    """Return the angles of estimated markers (T, A), degrees, worked out now or earlier."""
    if path.is_file():
        with np.load(path, allow_pickle=False) as data:
            if np.array_equal(data["markers_m"], markers.astype(np.float32), equal_nan=True):
                return np.asarray(data["angles_deg"], dtype=np.float64)
    names = person.trials[0].marker_names
    fit = fit_markers(time_s, markers, names, ik=run.request.ik, model=person.model)
    angle_names, curves = name_angles(fit)
    arrays = {
        "time_s": time_s,
        "marker_names": np.array(names),
        "markers_m": markers.astype(np.float32),
        "sigma_m": sigma.astype(np.float32),
        "angle_names": np.array(angle_names),
        "angles_deg": curves,
    }
    write_arrays(path, arrays)
    return curves


# --------------------------------------------------------------------------- after


def _collect(
    name: str, trials: Sequence[MethodTrial], folds: Sequence[tuple[str, _FoldOutcome]]
) -> MethodResult:
    frames = sum(outcome.markers_m.shape[0] for _, outcome in folds)
    return MethodResult(
        name=name,
        trials=tuple(trials),
        fit_s=float(np.mean([outcome.fit_s for _, outcome in folds])),
        predict_ms=1000.0 * sum(outcome.predict_s for _, outcome in folds) / max(frames, 1),
        settings={fold: outcome.settings for fold, outcome in folds},
    )


def _gather(
    dataset: Dataset, persons: Sequence[PersonData], run: _Run, methods: Sequence[MethodResult]
) -> Study:
    request = run.request
    notes = [f"Left out: {problem}" for problem in dataset.problems]
    notes += [note for person in persons for note in person.notes]
    settings = {
        **{k: v for k, v in request.identity.items() if k not in ("dataset", "persons", "version")},
        "persons": ", ".join(person.label for person in persons),
        "features": ", ".join(request.features),
        "estimators": ", ".join(request.estimators),
        "frames_left_out_of_training": sum(
            int((~frames.is_usable).sum()) for person in persons for frames in person.frames
        ),
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    study = Study(
        title=dataset.title,
        kind=request.folds,
        is_synthetic=dataset.is_synthetic,
        methods=tuple(methods),
        leaks=run.leaks,
        settings=settings,
        notes=tuple(dict.fromkeys([*([dataset.note] if dataset.note else []), *notes, *run.notes])),
    )
    return replace(study)
