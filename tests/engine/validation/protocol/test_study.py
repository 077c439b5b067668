"""Figures of a study against values worked out by hand, and what is said of them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from engine.errors import DataError, ShapeError
from engine.validation.protocol.figures import Overlay, choose_example, draw_overlays, draw_study
from engine.validation.protocol.report import (
    REPORT_NAME,
    STUDY_NAME,
    build_report,
    describe_study,
    render_study,
)
from engine.validation.protocol.statistics import (
    MethodTrial,
    Study,
    compare_methods,
    mean_of_tasks,
    summarise_differences,
    summarise_distances,
    summarise_rows,
)
from engine.validation.protocol.tables import (
    MODEL_RANGE_DEG,
    PUBLISHED,
    ROW_TITLES,
    build_study_tables,
    print_table1,
    print_table2,
    print_table3,
)
from tests.engine.validation.protocol.studies import ANGLES, make_method, make_study, make_trial


def table(study, name):
    rows = {m.name: summarise_rows(m) for m in study.methods}
    tables = build_study_tables(study, rows, compare_methods(study.methods))
    found = next(t for t in tables if t.name == name)
    return [dict(zip(found.columns, row, strict=True)) for row in found.rows]


# --------------------------------------------------------------------------- spreads


def test_a_constant_shift_is_measured_exactly():
    found = summarise_distances(make_method(off_mm=12.0).trials)
    assert found.mean_mm == pytest.approx(12.0)
    assert found.sd_mm == pytest.approx(0.0, abs=1e-9)
    assert found.rms_mm == pytest.approx(12.0)
    assert (found.n_trials, found.n_frames) == (8, 320)


def test_both_readings_of_mean_and_sd():
    method = make_method(off_deg=2.0, subjects=("S1",), tasks=("FK",), repetitions=1)
    (one,) = method.trials
    signs = np.where(np.arange(len(one.estimated_deg)) % 2, 1.0, -3.0)
    angles = one.trial.reference_deg + signs[:, None]
    found = summarise_differences([MethodTrial(one.trial, one.estimated_m, angles)])
    n = found.n_samples
    assert found.mean_deg == pytest.approx(-1.0)
    assert found.sd_deg == pytest.approx(2.0 * np.sqrt(n / (n - 1)))
    assert found.mae_deg == pytest.approx(2.0)
    assert found.sd_absolute_deg == pytest.approx(1.0 * np.sqrt(n / (n - 1)))
    assert found.rmse_deg == pytest.approx(np.sqrt(5.0))
    assert found.max_deg == pytest.approx(3.0)


def test_opposite_errors_of_the_sides_do_not_cancel_in_the_spread_but_in_the_pair():
    (one, *_) = make_method(off_deg=0.0).trials
    angles = one.trial.reference_deg.copy()
    angles[:, ANGLES.index("knee_flexion_r")] += 4.0
    angles[:, ANGLES.index("knee_flexion_l")] -= 4.0
    moved = MethodTrial(one.trial, one.estimated_m, angles)
    spread = summarise_differences([moved], ["knee_flexion_r", "knee_flexion_l"])
    assert (spread.mae_deg, spread.mean_deg) == (pytest.approx(4.0), pytest.approx(0.0))
    estimated, reference = moved.pair_rows().curves("knee_flexion")
    np.testing.assert_allclose(estimated, reference, atol=1e-9)


def test_differences_go_the_short_way_round():
    (one, *_) = make_method().trials
    turned = MethodTrial(one.trial, one.estimated_m, one.trial.reference_deg + 359.0)
    assert summarise_differences([turned]).mean_deg == pytest.approx(-1.0)


def test_truth_counts_with_and_without_the_difference_of_definition():
    trial = replace(make_trial(), truth_deg=make_trial().reference_deg - 5.0)
    one = MethodTrial(trial, trial.measured_m, trial.reference_deg)
    assert summarise_differences([one], ["knee_flexion_r"], of="truth").mae_deg == pytest.approx(5)
    free = summarise_differences([one], ["knee_flexion_r"], of="offset_free")
    assert free.mae_deg == pytest.approx(0.0, abs=1e-9)


def test_a_lost_marker_is_left_out_and_a_lost_frame_is_not_zero():
    (one, *_) = make_method(off_mm=10.0).trials
    estimated = one.estimated_m.copy()
    estimated[0] = np.nan
    estimated[1, 0] = np.nan
    moved = MethodTrial(one.trial, estimated, one.estimated_deg)
    assert np.isnan(moved.frame_mm[0])
    assert moved.frame_mm[1] == pytest.approx(10.0)
    assert summarise_distances([moved]).n_frames == one.frame_mm.size - 1


def test_nothing_measured_is_unknown_not_zero():
    (one, *_) = make_method().trials
    blank = MethodTrial(one.trial, one.estimated_m * np.nan, one.estimated_deg * np.nan)
    assert summarise_distances([blank]).n_frames == 0
    assert np.isnan(summarise_differences([blank]).mae_deg)


def test_the_average_is_that_of_the_tasks_not_of_the_frames():
    method = make_method(subjects=("S1",), off_mm=10.0)
    worse = [
        MethodTrial(one.trial, one.trial.measured_m + 0.02, one.estimated_deg)
        for one in method.select(task="KS")
    ][:1]
    trials = (*method.select(task="FK"), *worse)
    assert mean_of_tasks(replace(method, trials=trials), "S1") == pytest.approx(
        (10.0 + 1000 * np.sqrt(3) * 0.02) / 2
    )


def test_shapes_that_do_not_belong_together_are_refused():
    trial = make_trial()
    with pytest.raises(ShapeError, match="estimated_m of S1_FK_01"):
        MethodTrial(trial, trial.measured_m[1:], trial.reference_deg)
    with pytest.raises(ShapeError, match="truth_deg of S1_FK_01"):
        replace(trial, truth_deg=trial.truth_deg[:, 1:])
    with pytest.raises(DataError, match="at least one method"):
        Study("empty", "trial", is_synthetic=False, methods=(), leaks={})


# --------------------------------------------------------------------------- tests


def test_methods_are_compared_on_the_same_trials_by_person():
    near, far = make_method("hog/tgp", spread=0.1), make_method("hog/nn", off_mm=30.0, spread=0.1,
                                                               seed=1)  # fmt: skip
    (found,) = compare_methods([near, far])
    assert (found.first, found.second, found.unit) == ("hog/tgp", "hog/nn", "subject")
    assert found.test.n == 2
    assert found.test.mean == pytest.approx(20.0, abs=0.5)
    assert found.share_better == 0.0
    one_person = [make_method(m.name, subjects=("S1",), off_mm=o, spread=0.1, seed=s)
                  for m, o, s in ((near, 10.0, 0), (far, 30.0, 1))]  # fmt: skip
    (single,) = compare_methods(one_person)
    assert (single.unit, single.test.n) == ("trial", 4)


def test_a_small_constant_offset_is_equivalent_but_differs():
    rows = summarise_rows(make_method(off_deg=1.0, spread=0.1, subjects=("S1", "S2", "S3")))
    knee = next(r for r in rows if r.name == "knee_flexion")
    assert len(rows) == 13
    assert knee.per_unit.p < 0.05
    assert [e.is_equivalent for e in knee.equivalence] == [True, True]
    assert knee.unit == "subject"


def test_frames_are_flagged_as_dependent():
    method = make_method(off_deg=0.0, subjects=("S1",))
    slow = np.sin(np.linspace(0, np.pi, 40))[:, None]
    trials = tuple(
        MethodTrial(one.trial, one.estimated_m, one.trial.reference_deg + 3.0 * slow)
        for one in method.trials
    )
    study = make_study(replace(method, trials=trials))
    knee = next(row for row in table(study, "table3") if row["angle"] == "knee_flexion")
    assert knee["frames_are_independent"] is False
    assert knee["n_effective"] < 0.3 * knee["n_frames"]
    assert knee["t_frames_as_printed_p"] < 1e-6
    printed = print_table3(study, study.main, summarise_rows(study.main))
    assert all(cell.endswith("†") for *_, cell, _holm, _paper in printed.rows)
    assert "invalid" in printed.notes[0]


# --------------------------------------------------------------------------- tables


def test_table_1_has_every_cell_and_the_means():
    rows = table(make_study(make_method(off_mm=7.0)), "table1")
    assert {(r["subject"], r["task"]) for r in rows} == {
        (s, t) for s in ("S1", "S2", "all") for t in ("FK", "KS", "all")
    }
    assert all(r["mean_mm"] == pytest.approx(7.0) for r in rows)


def test_table_3_gives_shares_of_range_and_excursion():
    study = make_study(make_method(off_deg=3.0))
    elbow = next(r for r in table(study, "table3") if r["angle"] == "elbow_flexion")
    assert elbow["percent_of_model_range"] == pytest.approx(100 * 3.0 / 150.0)
    assert elbow["n_sides"] == 2
    trial = study.main.trials[0].trial
    sides = [ANGLES.index(f"elbow_flexion_{s}") for s in "rl"]
    excursion = np.ptp(trial.reference_deg[:, sides], axis=0).mean()
    assert elbow["percent_of_excursion"] == pytest.approx(100 * 3.0 / excursion)
    assert elbow["published_mean_deg"] == 5.08


def test_the_published_figures_are_those_the_digest_recomputes():
    assert np.mean(list(PUBLISHED.task_mm.values())) == pytest.approx(8.65, abs=0.005)
    weights = [1 if row.startswith("lumbar") else 2 for row in PUBLISHED.rows_deg]
    means = [mean for mean, _ in PUBLISHED.rows_deg.values()]
    assert np.average(means, weights=weights) == pytest.approx(2.315, abs=0.001)
    assert sum(weights) == 23
    assert 100 * 5.08 / MODEL_RANGE_DEG["elbow_flexion"] == pytest.approx(3.38, abs=0.01)
    assert set(PUBLISHED.rows_deg) == set(ROW_TITLES) == set(MODEL_RANGE_DEG)


def test_printed_tables_say_whose_figures_the_paper_s_are():
    study = make_study()
    for printed in (print_table1(study, study.main), print_table2(study, study.main)):
        assert any(row[0] == "Paper*" for row in printed.rows)
        assert any(note.startswith("*") for note in printed.notes)
        assert "synthetic data" in printed.title
    assert "synthetic" not in print_table1(make_study(is_synthetic=False), study.main).title


def test_the_main_method_is_not_chosen_by_its_errors():
    methods = [make_method("hog/nn", off_mm=1.0), make_method("hog/tgp-constrained", off_mm=50.0)]
    assert make_study(*methods).main.name == "hog/tgp-constrained"


# --------------------------------------------------------------------------- words and files


def test_what_is_said_names_folds_leak_and_constraint():
    study = make_study(
        make_method("hog/tgp", off_mm=20.0, spread=0.05),
        make_method("hog/tgp-constrained", off_mm=24.0, spread=0.05, seed=1),
    )
    said = describe_study(study, summarise_rows(study.main), compare_methods(study.methods))
    text = " ".join(said)
    assert "hog/tgp-constrained: markers 24." in said[0]
    assert "never saw it" in said[0]
    assert "did not help" in text
    assert "No sign of a leak" in text
    assert "nobody was filmed" in text


@pytest.fixture(scope="module")
def files():
    study = make_study(make_method("hog/nn", off_mm=30.0, spread=0.2), make_method(spread=0.3))
    rows = {m.name: summarise_rows(m) for m in study.methods}
    comparisons = compare_methods(study.methods)
    picture = Overlay(np.zeros((48, 64, 3), np.uint8), np.full((4, 2), 20.0),
                      np.full((4, 2), 22.0), "grab")  # fmt: skip
    figures = draw_study(study, rows[study.main.name], [[picture] * 3] * 2)
    report = build_report(study, rows, comparisons, figures, version="9", created="2026-01-02")
    return render_study(study, rows, comparisons, report, version="9", created="2026-01-02")


def test_every_promised_file_is_there(files):
    promised = [f"tables/table{n}.{kind}" for n in (1, 2, 3) for kind in ("csv", "html")]
    promised += [f"figures/figure{n}.png" for n in (2, 3, 4, 5)]
    assert set(promised) <= set(files)
    for name, content in files.items():
        if name.endswith(".png"):
            assert content.startswith(b"\x89PNG")


def test_study_json_is_strict_json_with_both_methods(files):
    study = json.loads(files[STUDY_NAME], parse_constant=pytest.fail)
    assert [m["method"] for m in study["methods"]] == ["hog/nn", "hog/gp"]
    assert study["main_method"] == "hog/gp"
    assert study["leaks"]["hog"]["is_raised"] is False
    assert len(study["table3"]) == 26
    assert study["tables"]["table1"]["rows"]


def test_the_page_holds_tables_and_figures_and_runs_nothing(files):
    page = files[REPORT_NAME].decode()
    assert page.count("<table>") == 6
    assert page.count("data:image/png") == 7
    assert "<script" not in page
    assert "Published by Mehrizi" in page


def test_names_can_t_break_the_page():
    study = make_study(replace(make_method(), name="<b>/gp"))
    rows = {m.name: summarise_rows(m) for m in study.methods}
    report = build_report(study, rows, (), {}, version="9")
    page = render_study(study, rows, (), report)[REPORT_NAME].decode()
    assert "<b>/gp" not in page
    assert "&lt;b&gt;/gp" in page


def test_the_example_is_neither_best_nor_worst():
    method = make_method(tasks=("FK",), subjects=("S1",), repetitions=3)
    shifts = (0.001, 0.05, 0.01)
    trials = tuple(MethodTrial(one.trial, one.trial.measured_m + s, one.estimated_deg)
                   for one, s in zip(method.trials, shifts, strict=True))  # fmt: skip
    assert choose_example(replace(method, trials=trials)).trial.label == "S1_FK_03"


def test_figures_of_synthetic_data_say_so():
    study = make_study()
    picture = Overlay(np.zeros((48, 64, 3), np.uint8), np.zeros((4, 2)), np.zeros((4, 2)), "grab")
    words = [text.get_text() for text in draw_overlays(study, [[picture]]).texts]
    assert any("synthetic data" in text for text in words)
