"""How estimators are found, and what each must offer."""

from __future__ import annotations

import subprocess
import sys

import pytest

from engine.config import PoseConfig
from engine.errors import BackendUnavailable, ConfigError
from engine.pose import base
from engine.pose.base import BackendInfo, create_backend, list_backends
from engine.skeletons import SKELETONS


def test_the_shipped_estimators_are_listed():
    assert {"mediapipe", "stored"} <= {info.name for info in list_backends()}


@pytest.mark.parametrize("info", list_backends(), ids=lambda info: info.name)
def test_every_estimator_describes_itself(info):
    assert info.title
    assert info.licence
    assert info.description
    assert info.skeleton in SKELETONS
    assert info.install_hint.startswith("pip install")


def test_default_estimator_is_made():
    assert create_backend(PoseConfig(variant="full", threads=1)).info.name == "mediapipe"


def test_unknown_estimator():
    with pytest.raises(ConfigError, match=r"'openpose'; known: .*mediapipe"):
        create_backend(PoseConfig(backend="openpose"))


def test_missing_part_is_named_with_the_command(monkeypatch):
    info = BackendInfo("mediapipe", "", "mediapipe_33", "", "", requires=("no_such_module",))
    monkeypatch.setattr(base, "list_backends", lambda: (info,))
    with pytest.raises(BackendUnavailable, match=r"no_such_module.*pip install liftlens"):
        create_backend(PoseConfig())


def test_listing_does_not_load_the_runtime():
    code = (
        "import sys; from engine.pose.base import list_backends; list_backends(); "
        "sys.exit('onnxruntime' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_model_file_is_refused_by_an_estimator_that_reads_none():
    with pytest.raises(ConfigError, match=r"'mediapipe' takes no model file.*stored"):
        create_backend(PoseConfig(model="subject.npz"))
