"""The page that tries changes, compares before and after, and puts jobs together."""

import dataclasses

import pytest

from dashboard import improve_charts, improve_parts
from engine.ergonomics.base import list_methods
from engine.ergonomics.before_after import compare_before_after
from engine.ergonomics.improvements import rank_changes
from engine.ergonomics.what_if import Change, what_if
from engine.improve import measure_result
from engine.storage.results import read_result, write_result
from tests.dashboard.test_app import html
from tests.engine.ergonomics.bending import build_bending
from tests.engine.test_improve import make_bending_result

WORK = {"load_kg": 14.0, "frequency_per_min": 2.0, "duration_h": 4.0, "destination_control": True}


@pytest.fixture
def trial_id(library):
    write_result(make_bending_result(label="Crate", **WORK), library.folder("one"))
    return "one"


def open_page(app, trial_id=None):
    app.run()
    if trial_id:
        app.query_params["trial"] = trial_id
    app.switch_page("views/improve.py").run()
    assert not app.exception
    return app


def words(app):
    kinds = (app.markdown, app.caption, app.info, app.error, app.warning, app.subheader)
    return " ".join([html(app), *(e.value for kind in kinds for e in kind)])


def part(app, name):
    chooser = next(g for g in app.button_group if "What if" in g.options)
    chooser.set_value(name)
    app.run()
    assert not app.exception
    return app


def slider(app, label):
    return next(s for s in app.slider if s.label.startswith(label))


def number(app, label):
    return next(n for n in app.number_input if n.label.startswith(label))


def index_of(app):
    """Return what the first tile shows."""
    return words(app).split('class="ll-number">')[1].split("<")[0]


# --------------------------------------------------------------------------- what if


def test_without_trials_the_page_says_what_to_do(app):
    shown = open_page(app)
    assert "There is no trial yet" in shown.info[0].value


def test_inputs_start_as_filmed(app, trial_id):
    shown = open_page(app, trial_id)
    lift = build_bending().lifts[0]
    assert slider(shown, "Reach (H)").value == round(lift.origin.H_cm.value)
    assert number(shown, "Load").value == 14.0
    assert "As filmed. Move a slider" in words(shown)
    assert "→" not in index_of(shown)


def test_a_moved_slider_changes_the_result_as_the_engine_does(app, trial_id, library):
    shown = open_page(app, trial_id)
    before = index_of(shown)
    slider(shown, "Height (V)").set_value(76.0)
    shown.run()
    assert not shown.exception
    exposure = build_bending(recovery_h=1.0, **WORK)
    expected = what_if(exposure, Change(origin_V_cm=76.0), methods=("rnle",))["rnle"]
    assert index_of(shown) == f"{before} → {expected.value:.1f}"
    assert "lower" in words(shown)
    assert "▼" in words(shown)
    assert "was not filmed" in words(shown)


def test_a_change_for_the_worse_says_worse(app, trial_id):
    shown = open_page(app, trial_id)
    number(shown, "Load").set_value(28.0)
    shown.run()
    assert "▲" in words(shown)
    assert ": worse" in words(shown)


def test_a_proposal_is_tried_with_one_click_and_taken_back(app, trial_id):
    shown = open_page(app, trial_id)
    filmed = index_of(shown)
    exposure = build_bending(recovery_h=1.0, **WORK)
    best = rank_changes(exposure).singles[0]
    next(b for b in shown.button if b.label == "Try").click()
    shown.run()
    assert not shown.exception
    assert index_of(shown) == f"{filmed} → {best.lifting_index.after:.1f}"
    next(b for b in shown.button if b.label == "Back to as filmed").click()
    shown.run()
    assert index_of(shown) == filmed


def test_what_is_locked_is_neither_proposed_nor_movable(app, trial_id):
    shown = open_page(app, trial_id)
    assert "Split the load" in words(shown)
    locks = next(g for g in shown.button_group if "Load" in g.options)
    locks.set_value(["Load", "Height at the start"])
    shown.run()
    assert not shown.exception
    assert "Split the load" not in words(shown)
    assert slider(shown, "Height (V)").disabled
    assert number(shown, "Load").disabled


def test_posture_scores_join_when_asked_for(app, trial_id):
    shown = open_page(app, trial_id)
    assert '<td data-label="Method">REBA' not in words(shown)
    shown.toggle[0].set_value(True)
    shown.run()
    assert not shown.exception
    assert '<td data-label="Method">REBA' in words(shown)


def test_an_unknown_load_is_said_and_can_be_supposed(app, library):
    write_result(make_bending_result(load_kg=None), library.folder("one"))
    shown = open_page(app, "one")
    assert "load not given" in words(shown)
    assert "changes are ranked by the recommended weight" in words(shown)
    number(shown, "Load").set_value(9.0)
    shown.run()
    assert not shown.exception
    assert ">Can&#x27;t be used: the load is not given" in words(shown)  # as filmed, still


def test_a_trial_without_a_lift_says_so(app, library):
    empty = dataclasses.replace(make_bending_result(), lifts=(), risk={})
    write_result(empty, library.folder("one"))
    assert "No lift was found" in words(open_page(app, "one"))


def test_every_lock_has_a_name():
    assert set(improve_parts.LOCK_NAMES) == set(improve_parts.LOCKS)
    assert set(improve_parts.LOCK_OF) >= {s.field for s in improve_parts.SLIDERS}


# --------------------------------------------------------------------------- before and after


@pytest.fixture
def two_sets(library):
    for k in range(3):
        for name, load in (("before", 14.0), ("after", 6.0)):
            made = make_bending_result(label=f"{name} {k}", load_kg=load + 0.1 * k)
            write_result(made, library.folder(f"{name}-{k}"))


def choose(app, label, names):
    chooser = next(m for m in app.multiselect if m.label == label)
    chooser.set_value([option for option in chooser.options if option.split(" ·")[0] in names])
    app.run()
    assert not app.exception


def test_two_sets_are_compared_with_a_verdict(app, two_sets):
    shown = part(open_page(app), "Before and after")
    assert "Choose the trials of either side" in words(shown)
    choose(shown, "Before the change", {f"before {k}" for k in range(3)})
    after = next(m for m in shown.multiselect if m.label == "After the change")
    assert not any(option.startswith("before") for option in after.options)
    choose(shown, "After the change", {f"after {k}" for k in range(3)})
    said = words(shown)
    assert "The change worked" in said
    assert "3 trials before, 3 trials after" in said
    assert "The load differs" in said
    assert "Minimal" not in said
    assert "Least change" in said


def test_one_trial_each_is_called_what_it_is(app, two_sets):
    shown = part(open_page(app), "Before and after")
    choose(shown, "Before the change", {"before 0"})
    choose(shown, "After the change", {"after 0"})
    assert "measuring error only" in words(shown)


def test_one_trial_is_not_enough_for_a_comparison(app, trial_id):
    shown = part(open_page(app), "Before and after")
    assert "need at least two trials" in words(shown)


# --------------------------------------------------------------------------- a job


def test_a_job_is_put_together_and_judged(app, two_sets):
    shown = part(open_page(app), "A whole job")
    assert "Choose the trials that show the tasks" in words(shown)
    choose(shown, "Tasks of the job", {"before 0", "after 0"})
    said = words(shown)
    assert "omposite lifting index" in said
    assert "What each task adds" in said
    rates = [n for n in shown.number_input if n.label.endswith("lifts per minute")]
    assert len(rates) == 2
    rates[0].set_value(0.0)
    shown.run()
    assert "never done" in words(shown)


def test_a_rotation_asks_for_the_hours_of_each_task(app, two_sets):
    shown = part(open_page(app), "A whole job")
    choose(shown, "Tasks of the job", {"before 0", "after 0"})
    shown.radio[0].set_value("One after the other")
    shown.run()
    hours = [n for n in shown.number_input if n.label == "for how many hours"]
    assert len(hours) == 2
    hours[0].set_value(8.0)
    shown.run()
    assert "take 9 h together" in words(shown)


def test_a_job_without_trials_says_what_to_do(app):
    assert "A job is put together from trials" in words(part(open_page(app), "A whole job"))


# --------------------------------------------------------------------------- figures

INFOS = {method.info.name: method.info for method in list_methods()}


def test_limits_are_drawn_as_shares_and_far_values_stay_inside():
    exposure = build_bending(recovery_h=1.0, **WORK)
    filmed = what_if(exposure, Change(), frames=False)
    changed = what_if(exposure, Change(load_kg=70.0), frames=False)
    figure = improve_charts.plot_limits(filmed, changed, INFOS, {"rnle": "NIOSH", "l5s1": "Back"})
    marks = {trace.name: trace for trace in figure.data if trace.name}
    assert marks["As filmed"].x[1] == pytest.approx(filmed["l5s1"].value / 3400.0)
    assert max(marks["As changed"].x) <= improve_charts.MOST
    assert marks["As changed"].marker.symbol[0] == "triangle-right"
    assert improve_charts.plot_limits({}, {}, INFOS, {"rnle": "NIOSH"}) is None


def test_trials_are_drawn_with_their_errors(tmp_path):
    sets = []
    for name, load in (("before", 14.0), ("after", 6.0)):
        made = make_bending_result(label=name, load_kg=load)
        sets.append([measure_result(read_result(write_result(made, tmp_path / name)))])
    found = compare_before_after(*sets)
    change = found.changes[0]
    figure = improve_charts.plot_trials(change, *sets, dark=True)
    assert figure.data[0].y[0] == pytest.approx(sets[0][0].values["li"].value)
    assert figure.data[0].error_y.array[0] > 0
    assert list(figure.data[2].y) == [change.before, change.after]
