"""Trained models as files: NumPy's .npz with a version, never pickle."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from engine.errors import ConfigError, DataError, OutputError
from engine.pose.twin_gp.features import Crop
from engine.pose.twin_gp.lengths import LengthPenalty
from engine.pose.twin_gp.model import ModelSource, TwinGPModel
from engine.pose.twin_gp.projection import BlockProjection
from engine.pose.twin_gp.regressors import REGRESSORS, Hyper, TrainingSet

__all__ = ["load_model", "write_model"]

FORMAT: Final = "liftlens-twin-gp"
VERSION: Final = 1

Arrays = Mapping[str, NDArray[Any]]


def write_model(model: TwinGPModel, path: Path) -> Path:
    """Write a model; the file appears whole or not at all.

    Everything is in metres. Nothing in it shows a picture, but the training poses are in it: treat
    it as you treat the recordings.

    Raises
    ------
    OutputError
        If it can't be written.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.part.npz")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(part, **_pack(model))  # type: ignore[arg-type]
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise OutputError(
            f"The model can't be written to {path} ({error.strerror}); choose another place."
        ) from error
    return path


def _pack(model: TwinGPModel) -> dict[str, NDArray[Any]]:
    meta = {
        "format": FORMAT,
        "version": VERSION,
        "unit": "m",
        "regressor": model.regressor.name,
        "hyper": asdict(model.hyper),
        "source": asdict(model.source),
        "marker_names": model.marker_names,
        "eta_at": model.eta_at,
        "inner_error_m": model.inner_error_m,
        "blocks": [p.scale for p in model.projections],
        "penalty": model.penalty
        and {"fixed_weight": model.penalty.fixed_weight, "shape": model.penalty.shape},
    }
    arrays: dict[str, NDArray[Any]] = {
        "meta": np.array(json.dumps(meta)),
        "features": model.training.features,
        "pose": model.training.pose.astype(np.float32),
        "mean_pose": model.mean_pose,
        "sigma_at": model.sigma_at,
    }
    for number, projection in enumerate(model.projections):
        arrays[f"block{number}_mean"] = projection.mean
        if projection.components is not None:
            arrays[f"block{number}_components"] = projection.components
    if model.penalty is not None:
        arrays["segments"] = model.penalty.segments
        arrays["lengths_m"] = model.penalty.length_m
        arrays["length_sigma_m"] = model.penalty.sigma_m
    return arrays


def load_model(path: Path) -> TwinGPModel:
    """Read a model that `write_model` wrote.

    Raises
    ------
    ConfigError
        If there is no such file.
    DataError
        If it is no model, damaged, or of a newer version.
    """
    path = Path(path)
    if not path.is_file():
        raise ConfigError(
            f"There is no model file {path}; check its path, or train one with "
            "`python -m engine.training.twin_gp`."
        )
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        meta = json.loads(str(arrays["meta"]))
        _check_format(meta, path)
        return _unpack(meta, arrays)
    except (OSError, ValueError, KeyError, TypeError, EOFError, zipfile.BadZipFile) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(
            f"Expected a trained model in {path.name}, but it can't be read as one ({error}); "
            "train it again with `python -m engine.training.twin_gp`."
        ) from error


def _check_format(meta: Mapping[str, Any], path: Path) -> None:
    if meta.get("format") != FORMAT:
        raise DataError(f"{path.name} is not a twin Gaussian process model; choose another file.")
    if meta["version"] > VERSION:
        raise DataError(
            f"{path.name} is a model of version {meta['version']}, this LiftLens reads up to "
            f"version {VERSION}; update LiftLens, or train the model again."
        )


def _unpack(meta: Mapping[str, Any], arrays: Arrays) -> TwinGPModel:
    regressor = REGRESSORS[meta["regressor"]]
    hyper = Hyper(**{**meta["hyper"], "gamma_r": tuple(meta["hyper"]["gamma_r"])})
    training = TrainingSet(
        arrays["features"], arrays["pose"].astype(np.float64), regressor.kind, hyper
    )
    penalty = None
    if meta["penalty"]:
        penalty = LengthPenalty(
            arrays["segments"], arrays["lengths_m"], arrays["length_sigma_m"], **meta["penalty"]
        )
    return TwinGPModel(
        regressor=regressor,
        training=training,
        projections=tuple(
            BlockProjection(
                arrays[f"block{number}_mean"], arrays.get(f"block{number}_components"), scale
            )
            for number, scale in enumerate(meta["blocks"])
        ),
        mean_pose=arrays["mean_pose"],
        marker_names=tuple(meta["marker_names"]),
        sigma_at=arrays["sigma_at"],
        eta_at=meta["eta_at"],
        penalty=penalty,
        source=_unpack_source(meta["source"]),
        inner_error_m=meta["inner_error_m"],
    )


def _unpack_source(stored: Mapping[str, Any]) -> ModelSource:
    crops = tuple(
        Crop(**{**crop, "picture_px": tuple(crop["picture_px"])}) for crop in stored["crops"]
    )
    sizes = tuple((int(w), int(h)) for w, h in stored["picture_px"])
    return ModelSource(
        **{**stored, "crops": crops, "picture_px": sizes, "views": tuple(stored["views"])}
    )
