"""The page of validation studies."""

import json

import numpy as np
import pytest

from dashboard import study_cache, study_charts, study_parts
from engine.errors import DataError
from engine.protocol_inputs import write_arrays
from engine.protocol_stored import list_studies, name_method_folder, read_study
from engine.validation.protocol.figures import draw_study
from engine.validation.protocol.report import build_report, render_study
from engine.validation.protocol.statistics import compare_methods, summarise_rows
from tests.dashboard.test_app import html
from tests.engine.validation.protocol.studies import make_method, make_study


@pytest.fixture(scope="module")
def files():
    study = make_study(make_method("hog/nn", off_mm=30.0, spread=0.2), make_method(spread=0.3))
    rows = {m.name: summarise_rows(m) for m in study.methods}
    comparisons = compare_methods(study.methods)
    figures = {"figure5": draw_study(study, rows[study.main.name])["figure5"]}
    report = build_report(study, rows, comparisons, figures, version="9", created="2026-01-02")
    return study, render_study(study, rows, comparisons, report, version="9", created="2026-01-02")


def keep(library, files, name="first"):
    study, contents = files
    folder = library.root / study_cache.STUDIES_FOLDER / name
    for path, content in contents.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_bytes(content)
    (folder / "run.json").write_text("{}")
    (folder / "report.pdf").write_bytes(b"%PDF-1.7")
    for method in study.methods:
        for one in method.trials:
            t = one.trial
            file = f"{t.subject}_{t.label}.npz"
            arrays = {"time_s": t.time_s, "angle_names": np.array(t.angle_names)}
            write_arrays(folder / "reference" / file, {**arrays, "angles_deg": t.reference_deg})
            write_arrays(folder / "predictions" / name_method_folder(method.name) / file,
                         {**arrays, "angles_deg": one.estimated_deg})  # fmt: skip
    return folder


def open_page(app, **query):
    app.run()
    for key, value in query.items():
        app.query_params[key] = value
    app.switch_page("views/validation_study.py").run()
    assert not app.exception
    return app


def words(app):
    parts = (app.markdown, app.caption, app.info, app.error, app.warning, app.subheader)
    return " ".join([html(app), *(e.value for kind in parts for e in kind)])


def test_without_a_study_the_page_gives_the_command(app, library):
    shown = open_page(app)
    assert "no finished study yet" in shown.info[0].value
    command = shown.code[0].value
    assert command.startswith("liftlens protocol DATASET --estimator nn,gp,tgp,tgp-constrained")
    assert str(library.root / "studies" / "study-1") in command


def test_the_command_quotes_what_a_shell_would_read(app, library):
    shown = open_page(app)
    shown.text_input(key="study_dataset").set_value("/data/my lifts; rm -rf x").run()
    assert "'/data/my lifts; rm -rf x'" in shown.code[0].value


@pytest.mark.parametrize("name", ["../../etc", "", ".."])
def test_a_study_can_t_be_named_out_of_its_place(app, library, name):
    shown = open_page(app)
    shown.text_input(key="study_name").set_value(name).run()
    assert not shown.code
    assert "no slash" in shown.warning[0].value


def test_a_finished_study_is_shown_whole(app, library, files):
    keep(library, files)
    shown = open_page(app)
    said = words(shown)
    assert shown.selectbox[0].value == "first"
    assert "hog/gp: markers" in said
    assert "No sign of a leak" in said
    assert "Paper*" in said
    assert "Elbow rotation" in said
    assert len(shown.get("plotly_chart")) == 3
    assert {b.label for b in shown.get("download_button")} >= {"Whole study (zip)", "Report (PDF)"}
    assert shown.query_params["study"] in ("first", ["first"])


def test_the_address_names_the_study(app, library, files):
    keep(library, files)
    keep(library, files, "second")
    assert open_page(app, study="second").selectbox[0].value == "second"


def test_an_unknown_name_in_the_address_shows_the_first(app, library, files):
    keep(library, files)
    assert open_page(app, study="../../etc").selectbox[0].value == "first"


def test_another_method_s_angles_can_be_seen(app, library, files):
    keep(library, files)
    shown = open_page(app)
    shown.selectbox(key="study_angles").select("hog/nn").run()
    assert not shown.exception
    shown.selectbox(key="study_curves").select("hog/nn").run()
    assert not shown.exception


def test_a_leak_is_a_warning_at_the_top(app, library, files):
    folder = keep(library, files)
    path = folder / "study.json"
    document = json.loads(path.read_text())
    document["leaks"]["hog"] |= {"is_raised": True, "sentence": "Leak: remembered."}
    path.write_text(json.dumps(document))
    assert "hog: Leak: remembered." in open_page(app).warning[0].value


def test_an_unfinished_study_is_named(app, library, files):
    folder = keep(library, files)
    (folder / "study.json").unlink()
    said = words(open_page(app))
    assert "Not finished: first" in said
    assert list_studies(folder.parent) == {"first": False}


def test_missing_curves_are_a_sentence_not_a_failure(app, library, files):
    folder = keep(library, files)
    for path in (folder / "reference").iterdir():
        path.unlink()
    assert "lacks reference/S1_S1_FK_01.npz" in words(open_page(app))


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "is damaged"),
        ("[]", "is damaged"),
        ('{"schema_version": 1}', "is damaged"),
        ('{"schema_version": 99, "methods": [1], "tables": {"table1": {"rows": [1]}}}', "newer"),
        ('{"schema_version": 1, "methods": [], "tables": {"table1": {"rows": []}}}', "lacks"),
    ],
    ids=["cut", "list", "keys", "newer", "empty"],
)
def test_a_study_that_can_t_be_read_says_why(app, library, files, content, sentence):
    folder = keep(library, files)
    (folder / "study.json").write_text(content)
    with pytest.raises(DataError, match=sentence):
        read_study(folder)
    assert sentence in open_page(app).error[0].value


def test_the_archive_holds_report_tables_and_figures(library, files, monkeypatch):
    folder = keep(library, files)
    names = set(read_study(folder).files())
    assert {"study.json", "report.html", "report.pdf", "tables/table3.csv"} <= names
    assert not any(name.startswith("predictions") for name in names)


def test_charts_show_the_numbers_of_the_tables(library, files):
    study = read_study(keep(library, files))
    figure = study_charts.plot_persons(study_parts._means(study))
    assert set(figure.data[0].y) == {"hog/nn", "hog/gp"}
    assert max(figure.data[0].x) == pytest.approx(30.0, abs=2.0)
    rows = [r for r in study.table("angles") if r["method"] == "hog/gp"]
    bars = study_charts.plot_angles(rows).data[0]
    assert len(bars.x) == 23
    assert bars.x[0] == pytest.approx(1.0, abs=0.1)
    curves = study.curves("hog/gp", "S1", "S1_FK_01")
    plotted = study_charts.plot_study_curves(curves, "knee_flexion_r")
    column = curves.names.index("knee_flexion_r")
    np.testing.assert_array_equal(plotted.data[1].y, curves.estimated_deg[:, column])


def test_angles_have_the_names_of_the_tables():
    assert study_charts.name_study_angle("forearm_pronation_l") == "Elbow rotation, left"
    assert study_charts.name_study_angle("lumbar_bending") == "Lumbar bending"
