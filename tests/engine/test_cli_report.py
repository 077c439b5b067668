"""`liftlens report`: what it writes, and what it refuses."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest
from pypdf import PdfReader

from engine.cli_report import ReportRequest, check_report_target, run_report, write_report
from engine.errors import ConfigError, DataError, OutputError
from engine.report import ReportOptions
from engine.storage.results import write_result
from tests.builders import make_trial_result


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    root = tmp_path_factory.mktemp("results")
    return [write_result(make_trial_result(lis=(li,)), root / str(li)) for li in (0.8, 2.2)]


def run(*results, out, **options):
    said = []
    run_report(ReportRequest(tuple(results), out, **options), say=said.append)
    return said


def title_of(path):
    return PdfReader(path).metadata.title


def test_one_result_gives_the_page_of_the_trial(folders, tmp_path):
    out = tmp_path / "one.pdf"
    assert run(folders[0], out=out) == [f"Written: {out} (1 trial)"]
    assert title_of(out) == "Lifting assessment: Crate to shelf"
    assert list(tmp_path.iterdir()) == [out]


def test_several_results_give_a_summary(folders, tmp_path):
    out = tmp_path / "two.PDF"
    assert run(*folders, out=out)[0].endswith("(2 trials)")
    assert title_of(out) == "Summary of lifting assessments: Packing"


def test_before_makes_a_comparison(folders, tmp_path):
    out = tmp_path / "two.pdf"
    run(folders[0], out=out, before=(folders[1],))
    text = " ".join(PdfReader(out).pages[0].extract_text().split())
    assert "Before and after" in text
    assert "Lifting index 2.2 0.8 −1.4" in text


def test_an_earlier_report_is_replaced_and_anything_else_kept(folders, tmp_path):
    out = tmp_path / "r.pdf"
    run(folders[0], out=out)
    first = out.read_bytes()
    run(folders[1], out=out)
    assert out.read_bytes() != first
    out.write_text("my notes")
    with pytest.raises(ConfigError, match="is no PDF, so it is not overwritten"):
        run(folders[0], out=out)
    assert out.read_text() == "my notes"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("report.docx", "expected a name like report.pdf, got report.docx"),
        ("missing/report.pdf", "there is no folder"),
        ("folder.pdf", "is a folder"),
    ],
)
def test_places_where_no_report_can_be_are_refused(folders, tmp_path, name, message):
    (tmp_path / "folder.pdf").mkdir()
    with pytest.raises(ConfigError, match=message) as caught:
        run(folders[0], out=tmp_path / name)
    assert caught.value.exit_code == 2


def test_wrong_options_fail_before_any_result_is_read(tmp_path):
    for options in (ReportOptions(paper="a5"), ReportOptions(language="xx")):
        with pytest.raises(ConfigError, match="must be one of"):
            ReportRequest((tmp_path / "nowhere",), tmp_path / "r.pdf", options=options)


def test_a_trial_counts_once(folders, tmp_path):
    with pytest.raises(ConfigError, match="is given twice"):
        ReportRequest((folders[0], folders[0] / "../0.8"), tmp_path / "r.pdf")
    with pytest.raises(ConfigError, match="is given twice"):
        ReportRequest((folders[0],), tmp_path / "r.pdf", before=(folders[0],))
    with pytest.raises(ConfigError, match="at least one"):
        ReportRequest((), tmp_path / "r.pdf")


def test_a_damaged_result_is_named_and_nothing_written(folders, tmp_path):
    damaged = tmp_path / "damaged"
    shutil.copytree(folders[0], damaged)
    (damaged / "trial.json").write_text('{"schema_version": 1}')
    out = tmp_path / "r.pdf"
    with pytest.raises(DataError, match="damaged") as caught:
        run(folders[1], damaged, out=out)
    assert caught.value.exit_code == 3
    assert not out.exists()


def test_a_folder_without_result_is_unusable_input(tmp_path):
    with pytest.raises(DataError, match="is no LiftLens result"):
        run(tmp_path, out=tmp_path / "r.pdf")


def test_a_full_disk_leaves_nothing_behind(tmp_path, monkeypatch):
    def fail(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    with pytest.raises(OutputError, match=r"The report can't be written.*disk is full"):
        write_report(b"%PDF-1.7", tmp_path / "r.pdf")
    assert not list(tmp_path.iterdir())


def test_an_empty_file_may_be_replaced(tmp_path):
    out = tmp_path / "r.pdf"
    out.touch()
    assert check_report_target(out) == out


def test_the_page_of_a_trial_does_without_what_takes_longer_to_load_than_to_draw(folders, tmp_path):
    request = f"ReportRequest((Path({str(folders[0])!r}),), Path({str(tmp_path / 'a.pdf')!r}))"
    code = (
        "import sys; from pathlib import Path; "
        "from engine.cli_report import ReportRequest, run_report; "
        f"run_report({request}, say=print); "
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'scipy', 'pandas', 'matplotlib', "
        "'sqlalchemy', 'streamlit', 'onnxruntime'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"
