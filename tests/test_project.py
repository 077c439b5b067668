"""What the files around the code promise."""

from __future__ import annotations

import hashlib
import re
import subprocess
import tomllib
from pathlib import Path

import numpy as np
import pytest

import engine
from engine.cli_demo import read_samples

ROOT = Path(__file__).parents[1]
MAX_SAMPLE_MB = 12.0
MODELS = sorted(ROOT.glob("engine/**/*.onnx"))
DOCUMENTS = sorted(
    [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), ROOT / "sample_data" / "README.md"]
)
SYNTHETIC = ("floor_to_knuckle", "floor_to_shoulder")

# Written in parts, so that this file itself holds none of them.
FOREIGN = re.compile(
    "|".join(
        [
            r"/" + r"(?:work|root|home/\w+|Users/\w+)/",
            r"(?:pypi|pythonhosted|npmjs|huggingface|artifactory|nexus)" + r"\.(?:org|com|co|io)\b",
            r"--(?:extra-)?index" + r"-url|--find" + r"-links",
        ]
    )
)
# The option that keeps addresses out of the lock file carries their name.
ALLOWED = re.compile(r"--no-emit-\S+")


def read(*parts: str) -> str:
    return ROOT.joinpath(*parts).read_text(encoding="utf-8")


def tracked_text_files() -> list[Path]:
    """List what is in version control; outside of it, every file that would be."""
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if done.returncode == 0 and done.stdout:
        paths = [ROOT / name for name in done.stdout.decode().split("\0") if name]
    else:
        tops = (*ROOT.glob("*.*"), *ROOT.glob("*/**/*"))
        paths = [p for p in tops if not any(part == ".venv" for part in p.parts)]
    return [p for p in paths if p.is_file() and is_text(p)]


def is_text(path: Path) -> bool:
    try:
        return "\0" not in path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        return False


class TestCleanliness:
    def test_no_file_names_a_machine_or_a_registry(self):
        found = [
            f"{path.relative_to(ROOT)}:{number}: {match.group()}"
            for path in tracked_text_files()
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1)
            if (match := FOREIGN.search(ALLOWED.sub("", line)))
        ]
        assert not found

    @pytest.mark.parametrize(
        "text",
        [
            "see /" + "work/main/engine",
            "/" + "home/anna/lift.mp4",
            "https://pypi" + ".org/simple",
            "--extra-index" + "-url x",
        ],
    )
    def test_the_search_finds_them(self, text):
        assert FOREIGN.search(text)

    def test_lock_pins_every_direct_dependency_exactly(self):
        lines = [line for line in read("requirements.lock").splitlines() if line]
        pins = dict(line.split(";")[0].strip().split("==") for line in lines)
        project = tomllib.loads(read("pyproject.toml"))["project"]
        direct = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
        names = {re.split(r"[<>=!~\[; ]", need)[0].lower().replace("_", "-") for need in direct}
        assert names <= set(pins)


class TestVersion:
    def test_is_the_same_everywhere(self):
        declared = tomllib.loads(read("pyproject.toml"))["project"]["version"]
        cited = re.search(r"^version: (\S+)$", read("CITATION.cff"), re.MULTILINE)
        assert cited is not None
        assert declared == engine.__version__ == cited.group(1)


class TestLicences:
    def test_licence_is_whole(self):
        text = read("LICENSE")
        assert "Apache License" in text
        assert "Version 2.0, January 2004" in text
        assert "END OF TERMS AND CONDITIONS" in text

    def test_real_clip_keeps_its_licence(self):
        assert "BSD 3-Clause" in read("sample_data", "real_walkway", "LICENSE.pose2sim.txt")

    def test_there_are_models(self):
        assert len(MODELS) >= 4

    @pytest.mark.parametrize("model", MODELS, ids=lambda path: path.stem)
    def test_every_model_has_a_card_with_its_hash_and_licence(self, model):
        card = "\n".join(p.read_text(encoding="utf-8") for p in model.parent.glob("*.md"))
        assert model.name in card
        assert hashlib.sha256(model.read_bytes()).hexdigest()[:16] in card
        assert "Apache" in card
        assert any(model.is_relative_to(ROOT / part) for part in self.noticed_folders())

    @staticmethod
    def noticed_folders() -> list[str]:
        """Return the folders of models that NOTICE accounts for."""
        return re.findall(r"\(([\w/]+)/[\w*]+\.onnx\)", read("NOTICE"))


class TestSampleData:
    def test_is_small(self):
        files = [p for p in (ROOT / "sample_data").rglob("*") if p.is_file()]
        assert 0 < sum(p.stat().st_size for p in files) < MAX_SAMPLE_MB * 1e6

    def test_list_is_what_the_demo_reads(self):
        samples = read_samples()
        assert [s.key for s in samples] == [*SYNTHETIC, "real_walkway", "two_cameras"]
        assert all(s.licence for s in samples)

    @pytest.mark.parametrize("name", SYNTHETIC)
    def test_truth_is_what_the_readme_says(self, name, sample_folder):
        with np.load(sample_folder / name / "truth.npz", allow_pickle=False) as truth:
            n = len(truth["time"])
            assert np.allclose(np.diff(truth["time"]), 0.01)
            assert np.allclose(np.diff(truth["video_time"]), 1 / 30)
            shapes = {key: truth[key].shape for key in ("markers", "joints", "angles", "box")}
            assert shapes == {
                "markers": (n, 45, 3), "joints": (n, 30, 3), "angles": (n, 27), "box": (n, 3),
            }  # fmt: skip
            held = truth["held"]
            box = truth["box"]
        assert held.any()
        assert box[0, 1] == pytest.approx(0.0, abs=0.01)  # on the floor
        assert box[-1, 1] > 0.5  # on the shelf


class TestDocuments:
    def test_readme_starts_with_the_two_commands(self):
        top = read("README.md").splitlines()[:12]
        assert any(line.strip().startswith("make demo") for line in top)
        assert any(line.strip().startswith("make test") for line in top)

    @pytest.mark.parametrize("document", DOCUMENTS, ids=lambda p: str(p.relative_to(ROOT)))
    def test_every_link_leads_somewhere(self, document):
        text = re.sub(r"`[^`]*`", "", document.read_text(encoding="utf-8"))
        links = re.findall(r"\]\(([^)\s]+)\)", text)
        local = [link.split("#")[0] for link in links if not link.startswith(("http", "#"))]
        missing = [link for link in local if not (document.parent / link).exists()]
        assert not missing

    def test_readme_names_every_exit_code(self):
        codes = {int(code) for code in re.findall(r"^\| (\d+) \|", read("README.md"), re.MULTILINE)}
        kinds = [
            kind
            for kind in vars(engine.errors).values()
            if isinstance(kind, type) and issubclass(kind, engine.errors.EngineError)
        ]
        assert {kind.exit_code for kind in kinds} <= codes


class TestDashboardSettings:
    FILES = (ROOT / ".streamlit" / "config.toml", ROOT / "dashboard" / ".streamlit" / "config.toml")

    def test_both_places_say_the_same(self):
        here, there = (tomllib.loads(path.read_text(encoding="utf-8")) for path in self.FILES)
        assert here == there

    def test_nothing_is_sent_and_long_videos_fit(self):
        settings = tomllib.loads(self.FILES[0].read_text(encoding="utf-8"))
        assert settings["browser"]["gatherUsageStats"] is False
        assert settings["server"]["maxUploadSize"] >= 1000
        assert "://" not in self.FILES[0].read_text(encoding="utf-8")  # fonts come with Streamlit

    @pytest.mark.parametrize("theme", ["light", "dark"])
    @pytest.mark.parametrize("ground", ["backgroundColor", "secondaryBackgroundColor"])
    @pytest.mark.parametrize("ink", ["textColor", "linkColor", "primaryColor"])
    def test_text_has_enough_contrast(self, theme, ground, ink):
        colours = tomllib.loads(self.FILES[0].read_text(encoding="utf-8"))["theme"][theme]
        assert compute_contrast(colours[ink], colours[ground]) >= 4.5  # WCAG 2.2, level AA

    def test_contrast_of_black_on_white(self):
        assert compute_contrast("#000000", "#ffffff") == pytest.approx(21.0)


def compute_contrast(one: str, other: str) -> float:
    """Return the contrast ratio of WCAG 2.2."""
    low, high = sorted((compute_luminance(one), compute_luminance(other)))
    return (high + 0.05) / (low + 0.05)


def compute_luminance(colour: str) -> float:
    parts = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])
