"""Pose by Gaussian processes from two fixed views, after Mehrizi et al. (2018).

Pictures (histograms of oriented gradients) or landmarks go in, 45 markers in the laboratory's axes
come out. A model is trained per subject, on videos with markers.
"""

from engine.pose.twin_gp.features import (
    FEATURES,
    Crop,
    FeatureSet,
    combine_features,
    describe_landmarks,
    describe_picture,
    describe_video,
    fixed_crop,
)
from engine.pose.twin_gp.hog import HogSettings, compute_hog
from engine.pose.twin_gp.model import ModelSource, Prediction, TwinGPModel, train_model
from engine.pose.twin_gp.model_file import load_model
from engine.pose.twin_gp.regressors import REGRESSORS, Hyper, Regressor

__all__ = [
    "FEATURES",
    "REGRESSORS",
    "Crop",
    "FeatureSet",
    "HogSettings",
    "Hyper",
    "ModelSource",
    "Prediction",
    "Regressor",
    "TwinGPModel",
    "combine_features",
    "compute_hog",
    "describe_landmarks",
    "describe_picture",
    "describe_video",
    "fixed_crop",
    "load_model",
    "train_model",
]
