import csv
import io
import json
import math
import subprocess
import sys
from html.parser import HTMLParser

import jsonschema
import numpy as np
import pytest

from engine.validation.outcome import SCHEMA_PATH, build_agreement_document, render_outcome
from engine.validation.pooled import pool_trials
from engine.validation.tables import Table, build_tables, format_csv
from tests.engine.validation.test_compare import angle
from tests.engine.validation.test_pooled import FAST, compare

SCHEMA = json.loads(SCHEMA_PATH.read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def agreement():
    trials = [
        compare(1.0 + i, subject=f"P{i}", label="<b>lift</b> $x$", task=("a", "b")[i % 2])
        for i in range(2)
    ]
    return pool_trials(trials, **FAST)


@pytest.fixture(scope="module")
def files(agreement):
    return render_outcome(agreement, version="1.2.3")


def rows_of(content):
    return list(csv.DictReader(io.StringIO(content.decode())))


def test_the_schema_is_valid_and_the_document_keeps_it(agreement, files):
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    document = json.loads(files["agreement.json"])
    jsonschema.validate(document, SCHEMA)
    assert document["liftlens_version"] == "1.2.3"
    assert set(document["tasks"]) == {"a", "b"}
    trunk = document["trials"][0]["angles"][0]
    assert trunk["measured"]["bias_deg"] == pytest.approx(1.0, abs=0.1)
    assert document["angles"][0]["pooled"]["n_samples"] == agreement.angles[0].pooled.n_samples


def test_the_schema_refuses_a_missing_or_unknown_key(files):
    for change in ({"extra": 1}, {"trials": None}):
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate({**json.loads(files["agreement.json"]), **change}, SCHEMA)


def test_missing_numbers_are_null():
    document = build_agreement_document(pool_trials([compare()], **FAST))
    assert document["trials"][0]["spatial_alignment"] is None
    assert document["trials"][0]["body_size_ratio"] is None
    text = json.dumps(document, allow_nan=False)
    assert "NaN" not in text
    jsonschema.validate(document, SCHEMA)


def test_tables_hold_the_same_figures(agreement, files):
    first = rows_of(files["tables/trials.csv"])[0]
    truth = angle(agreement.trials[0], first["angle"]).measured
    assert float(first["rmse_deg"]) == pytest.approx(truth.rmse_deg, rel=1e-5)
    assert float(first["lag_s"]) == pytest.approx(agreement.trials[0].alignment.lag_s, rel=1e-5)
    angles = rows_of(files["tables/angles.csv"])
    assert [r["task"] for r in angles] == ["all"] * 3 + ["a"] * 3 + ["b"] * 3
    assert float(angles[0]["bias_deg"]) == pytest.approx(
        agreement.angles[0].pooled.bias_deg, rel=1e-5
    )
    curves = rows_of(files["tables/curves.csv"])
    assert len(curves) == sum(np.isfinite(t.difference_deg).sum() for t in agreement.trials)


def test_every_row_has_every_column(agreement):
    for table in build_tables(agreement):
        assert all(len(row) == len(table.columns) for row in table.rows), table.name
        assert len(set(table.columns)) == len(table.columns)


def test_cells_are_safe_for_spreadsheets_and_missing_ones_empty():
    table = Table("t", ("a", "b", "c", "d"), (("=1+1", math.nan, -0.25, True),))
    assert format_csv(table).decode() == "a,b,c,d\n'=1+1,,-0.25,true\n"


def test_there_is_a_figure_of_every_kind(files):
    pictures = {name for name in files if name.endswith(".png")}
    assert pictures == {
        f"figures/{n}.png"
        for n in ("errors", "sides", "boxes", "bland_altman", "curves_01", "curves_02")
    }
    assert all(files[name].startswith(b"\x89PNG") for name in pictures)


class Page(HTMLParser):
    """Notes what a page loads and which elements it has."""

    def __init__(self, text):
        super().__init__()
        self.sources, self.tags = [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]


def test_the_summary_stands_alone_and_shows_labels_as_text(files):
    text = files["summary.html"].decode()
    page = Page(text)
    assert page.sources
    assert all(source.startswith("data:image/png;base64,") for source in page.sources)
    assert "script" not in page.tags
    assert "b" not in page.tags
    assert "&lt;b&gt;lift&lt;/b&gt;" in text
    assert "nan" not in text.replace("data:image", "").split("base64")[0].lower()


def test_figures_leave_the_state_of_matplotlib_alone():
    code = (
        "import sys, engine.validation.figures;"
        "assert 'matplotlib.pyplot' not in sys.modules;"
        "import engine.validation.outcome"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
