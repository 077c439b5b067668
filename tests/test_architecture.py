"""The rules of `docs/architecture.md` that can be read off the imports."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
from pathlib import Path

import pytest

import engine

ROOT = Path(__file__).parents[1]
SHARED = {
    "engine.config",
    "engine.datatypes",
    "engine.errors",
    "engine.optics",
    "engine.skeletons",
    "engine.timing",
}
STEPS = {
    "video",
    "subject",
    "pose",
    "cameras",
    "correction",
    "kinematics",
    "ergonomics",
    "form",
    "validation",
}
MAY_START_THE_PIPELINE = {
    "engine",
    "engine.cli",
    "engine.estimators",
    "engine.jobs.worker",
    "engine.reassess",
}
BROWSER_LIBRARIES = {"streamlit", "plotly", "altair"}
HEAVY = ("cv2", "av", "onnxruntime", "scipy", "pandas", "streamlit", "plotly", "PIL", "sqlite3")


def name_of(path: Path) -> str:
    """Return the dotted name of a source file."""
    parts = path.relative_to(ROOT).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports_of(source: str, module: str, *, is_package: bool = False) -> set[str]:
    """Return every module that `source` imports, wherever in the file, as dotted names.

    ``from engine import video`` counts as `engine.video` when that is a module of the project.
    """
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = _resolve(node, module, is_package=is_package)
            found |= {_narrow(base, alias.name) for alias in node.names}
    return found


def _resolve(node: ast.ImportFrom, module: str, *, is_package: bool) -> str:
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    kept = parts[: len(parts) - node.level + is_package]
    return ".".join([*kept, *filter(None, [node.module])])


def _narrow(base: str, name: str) -> str:
    inner = ROOT.joinpath(*base.split("."), name)
    return f"{base}.{name}" if inner.is_dir() or inner.with_suffix(".py").is_file() else base


def _step_of(module: str) -> str | None:
    parts = module.split(".")
    return parts[1] if parts[0] == "engine" and len(parts) > 1 and parts[1] in STEPS else None


def broken_rules(module: str, imported: set[str]) -> list[str]:
    """Return what `module` may not import, with the rule."""
    broken = []
    step = _step_of(module)
    for target in sorted(imported):
        top = target.split(".")[0]
        if module.startswith("engine") and top in {"dashboard", *BROWSER_LIBRARIES}:
            broken.append(f"{module} imports {target}: the engine knows no dashboard")
        if top == "tests" or top == "benchmarks":
            broken.append(f"{module} imports {target}: the product knows no tests")
        if target.startswith("engine.pipeline") and module not in MAY_START_THE_PIPELINE:
            broken.append(f"{module} imports {target}: only the command line and jobs start it")
        if target.startswith("engine.training") and not module.startswith("engine.training"):
            broken.append(f"{module} imports {target}: training is not part of a run")
        if step and top == "engine" and target not in SHARED and _step_of(target) != step:
            broken.append(f"{module} imports {target}: steps know only the shared types")
        if module in SHARED and top == "engine" and target not in SHARED:
            broken.append(f"{module} imports {target}: shared types know no step")
    return broken


SOURCES = sorted([*ROOT.glob("engine/**/*.py"), *ROOT.glob("dashboard/**/*.py")])


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_imports_point_one_way(path):
    module = name_of(path)
    imported = imports_of(
        path.read_text(encoding="utf-8"), module, is_package=path.stem == "__init__"
    )
    assert not broken_rules(module, imported)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("engine.video.reader", "import streamlit as st"),
        ("engine.cli", "from dashboard import state"),
        ("engine.subject.tracker", "from engine.video.reader import open_video"),
        ("engine.subject.tracker", "from engine import video"),
        ("engine.subject.tracker", "from ..video import reader"),
        ("engine.subject.tracker", "def later():\n    import engine.pose.base"),
        ("engine.pose.base", "from engine.storage import library"),
        ("engine.storage.library", "from engine.pipeline import assess"),
        ("engine.pipeline", "import engine.training.fit"),
        ("engine.datatypes", "from engine.video import reader"),
        ("dashboard.app", "from tests import builders"),
    ],
)
def test_the_check_sees_what_breaks_a_rule(module, source):
    assert broken_rules(module, imports_of(source, module))


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("engine.pipeline", "from engine.video.reader import open_video\nimport engine.pose.base"),
        ("engine.pose.backends.mediapipe", "from ..base import BackendInfo"),
        ("engine.pose.base", "from engine import errors\nimport numpy"),
        ("engine.jobs.worker", "from engine.pipeline import assess"),
        ("dashboard.app", "import streamlit\nfrom engine.datatypes import Trial"),
    ],
)
def test_the_check_allows_what_keeps_the_rules(module, source):
    assert not broken_rules(module, imports_of(source, module))


@pytest.mark.parametrize("path", sorted(ROOT.glob("dashboard/views/*.py")), ids=name_of)
def test_pages_are_thin(path):
    source = path.read_text(encoding="utf-8")
    tops = {name.split(".")[0] for name in imports_of(source, name_of(path))}
    assert not tops & {"numpy", "pandas", "scipy", "cv2", "av"}
    assert len(source.splitlines()) < 80


def test_charts_and_words_need_no_streamlit():
    for name in ("charts", "labels"):
        source = (ROOT / f"dashboard/{name}.py").read_text(encoding="utf-8")
        assert "streamlit" not in imports_of(source, f"dashboard.{name}")


def test_session_state_is_kept_in_one_file():
    users = [
        path.name
        for path in ROOT.glob("dashboard/**/*.py")
        if any(
            isinstance(node, ast.Attribute) and node.attr == "session_state"
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        )
    ]
    assert users == ["state.py"]


def test_public_names_are_what_the_engine_offers():
    assert list(engine.__all__) == sorted(set(engine.__all__))
    for name in engine.__all__:
        assert getattr(engine, name) is not None


def test_type_checkers_see_the_same_public_names():
    """What is loaded on first use is imported for type checkers only, in a list of its own."""
    tree = ast.parse((ROOT / "engine/__init__.py").read_text(encoding="utf-8"))
    block = next(node for node in tree.body if isinstance(node, ast.If))
    seen = {a.name for node in block.body if isinstance(node, ast.ImportFrom) for a in node.names}
    assert seen == {name for name in engine.__all__ if not name.startswith("__")}


def test_an_unknown_name_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no_such_name"):
        _ = engine.no_such_name


def test_importing_the_engine_loads_nothing_heavy():
    code = "import json, sys, engine; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    loaded = set(json.loads(done.stdout))
    assert "engine" in loaded
    assert not loaded & set(HEAVY)
