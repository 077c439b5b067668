import dataclasses
import io
import math
import zipfile

import pytest

from dashboard import cache, manage_cache
from engine.report import ReportOptions
from engine.storage.results import write_result
from tests.builders import make_body_fit, make_risk, make_scene, make_trial_result
from tests.dashboard.results import add_trial, make_shown_result
from tests.dashboard.test_app import html


def open_trial(app, trial_id):
    app.run()
    app.query_params["trial"] = trial_id
    app.switch_page("views/trial.py").run()
    assert not app.exception
    return app


def store(library, result):
    write_result(result, library.folder("one"))
    return "one"


def test_the_most_urgent_flag_comes_first_with_what_would_change_it(app, trial_id):
    shown = html(open_trial(app, trial_id))
    verdict = shown[shown.index("ll-verdict") :]
    assert verdict.index("Lift 2 is far above") < verdict.index("The grip was assumed")
    assert "Bring the load 20 cm closer" in verdict
    assert "Lift 2 · 4.0 s to 5.1 s" in verdict
    assert verdict.index("High risk") < verdict.index("Needs review") < verdict.index("No concern")


def test_the_index_is_shown_with_its_range(app, trial_id):
    shown = html(open_trial(app, trial_id))
    assert '<div class="ll-number">2.3</div>' in shown
    assert "95 % range 1.9" in shown


def test_lifts_are_shown_with_errors_and_units(app, trial_id):
    shown = html(open_trial(app, trial_id))
    assert "58 ± 4 cm → 35 ± 4 cm" in shown
    assert "32 ± 8° → 0 ± 8°" in shown
    assert "4.0–5.1 s" in shown


def test_both_ends_show_their_multipliers_and_what_costs_most(app, trial_id):
    shown = html(open_trial(app, trial_id))
    for part in ("Start of the lift", "End of the lift", "decides the result", "costs most"):
        assert part in shown
    assert "× 0.43" in shown  # 25 / 58
    assert "5.3 kg" in shown
    costly = shown[shown.index("ll-costs") :]
    assert costly.index("Reach (H)") < costly.index("costs most") < costly.index("Height (V)")


def test_another_lift_can_be_chosen(app, trial_id):
    open_trial(app, trial_id)
    chooser = next(g for g in app.button_group if g.options[:2] == ["Lift 1", "Lift 2"])
    chooser.set_value("Lift 1")
    app.run()
    assert "× 0.56" in html(app)  # 25 / 45


def test_worked_steps_and_sources_are_there(app, trial_id):
    shown = html(open_trial(app, trial_id))
    assert "RWL = 23 × " in shown
    assert "entered by you" in shown
    assert "assumed" in shown
    assert "measured in the video" in shown
    assert "Reach at the start (H)" in shown
    assert "58.0 ± 4.0 cm" in shown


def test_every_joint_can_be_plotted(app, trial_id):
    open_trial(app, trial_id)
    joints = next(g for g in app.button_group if "Knees" in g.options)
    for joint in joints.options:
        joints.set_value(joint)
        app.run()
        assert not app.exception
        assert len(app.get("plotly_chart")) == 1


def test_the_curves_before_correction_can_be_shown(app, trial_id):
    open_trial(app, trial_id)
    (switch,) = [t for t in app.toggle if "before correction" in t.label]
    switch.set_value(True)
    app.run()
    assert not app.exception
    assert "Before correction" in app.get("plotly_chart")[0].proto.spec


def test_the_fit_of_the_body_model_is_shown(app, library):
    fitted = dataclasses.replace(
        make_shown_result(), body=make_body_fit(n_frames=180, missing=range(18))
    )
    shown = html(open_trial(app, store(library, fitted)))
    assert "2.0 cm (median)" in shown
    assert "in 90% of the pictures" in shown


def test_a_body_model_that_fitted_nowhere_says_so(app, library):
    fitted = dataclasses.replace(
        make_shown_result(), body=make_body_fit(n_frames=180, missing=range(180))
    )
    assert "nowhere fitted" in html(open_trial(app, store(library, fitted)))


def test_hip_angles_of_another_meaning_are_not_compared(app, library):
    plain = make_shown_result()
    fitted = dataclasses.replace(plain, body=make_body_fit(n_frames=180))
    for stored, is_there in ((plain, True), (fitted, False)):
        write_result(stored, library.folder(f"with_{is_there}"))
        names = cache.uncorrected_angles(f"with_{is_there}").names
        assert ("hip_flexion_l" in names) == is_there
        assert "knee_flexion_l" in names


def test_gaps_are_named(app, trial_id):
    open_trial(app, trial_id)
    assert any("Not seen for 10% of the time" in caption.value for caption in app.caption)


def test_coverage_errors_and_warnings_are_shown(app, trial_id):
    shown = html(open_trial(app, trial_id))
    for part in ("95% seen", "3% filled in", "2% not seen", "± 2.0 %", "the right (90°"):
        assert part in shown
    assert "The grip was not given; fair is assumed." in shown


def test_the_result_can_be_downloaded(app, library, trial_id):
    open_trial(app, trial_id)
    assert [b.label for b in app.get("download_button")] == [
        "Whole result (zip)",
        "One page (PDF)",
        "Joint angles with their errors (.csv)",
        "Joints for OpenSim and others (.trc)",
        "Joint angles for OpenSim (.mot)",
        "Joints and angles for motion analysis (.c3d)",
        "Moving figure for animation (.bvh)",
        "Everything as numbers (.json)",
    ]
    folder = library.folder(trial_id)
    assert manage_cache.trial_report(trial_id, ReportOptions()).startswith(b"%PDF-")
    for suffix, start in {"trc": b"PathFileType", "bvh": b"HIERARCHY", "csv": b"time_s"}.items():
        assert cache.export_bytes(folder, suffix).startswith(start)
    packed = zipfile.ZipFile(io.BytesIO(cache.zip_result(library.folder(trial_id))))
    names = {name.removeprefix(f"{trial_id}/") for name in packed.namelist()}
    assert {"trial.json", "tracks.npz", "angles.csv", "angles.mot", "keypoints.trc"} <= names
    assert "overlay.mp4" in names
    assert packed.testzip() is None


def test_without_a_load_the_limit_is_shown_and_no_index(app, library, tmp_path):
    shown = html(open_trial(app, add_trial(library, tmp_path, load_kg=None)))
    assert "Recommended limit" in shown
    assert "Load not given" in shown
    assert "ll-number" not in shown


def test_an_infinite_index_and_interval_are_shown_as_such(app, library):
    shown = html(open_trial(app, store(library, make_trial_result(lis=(math.inf,)))))
    assert '<div class="ll-number">∞</div>' in shown
    assert "nan" not in shown.lower()


def test_a_trial_without_lifts_flags_angles_or_video_still_opens(app, library):
    empty = dataclasses.replace(
        make_shown_result(),
        lifts=(),
        flags=(),
        risk={"rnle": make_risk(math.nan, reasons=("no lift was found in the video",))},
        warnings=(),
        scene=make_scene(scale_sigma=math.nan, view_azimuth_deg=math.nan),
    )
    open_trial(app, store(library, empty))
    assert any("No lift was found" in info.value for info in app.info)
    assert "No flag was raised" in html(app)
    assert "must not be used" in app.warning[0].value
    assert "No lift was found in the video." in html(app)
    assert any("without its annotated video" in info.value for info in app.info)


def test_a_trial_without_the_lifting_equation_still_opens(app, library):
    result = dataclasses.replace(make_shown_result(), risk={})
    open_trial(app, store(library, result))
    assert any("not part of this assessment" in info.value for info in app.info)


@pytest.mark.parametrize("name", ["tracks.npz", "trial.json"])
def test_a_damaged_file_is_said_in_one_sentence(app, library, trial_id, name):
    (library.folder(trial_id) / name).write_bytes(b"not this")
    app.run()
    app.query_params["trial"] = trial_id
    app.switch_page("views/trial.py").run()
    assert not app.exception
    assert "damaged" in app.error[0].value or "can't be read" in app.error[0].value


def press(app, label):
    next(button for button in app.button if button.label == label).click()
    app.run()


def fill(app, label, text):
    next(f for f in [*app.text_input, *app.text_area] if f.label == label).input(text)


def test_a_flag_is_answered(app, library, trial_id):
    open_trial(app, trial_id)
    fill(app, "Your name or initials", "AB")
    press(app, "Save the answer")
    assert not app.exception
    (said,) = library.record(trial_id).reviews
    assert (said.verdict, said.reviewer) == ("accepted", "AB")
    assert "Lift 2 is far above" in said.flag, "the most urgent flag is chosen first"
    assert any("Accepted by AB" in caption.value for caption in app.caption)


def test_a_rejection_needs_a_reason(app, library, trial_id):
    open_trial(app, trial_id)
    next(g for g in app.button_group if "I reject it" in g.options).set_value("I reject it")
    press(app, "Save the answer")
    assert "needs a reason" in html(app)
    assert not library.record(trial_id).reviews
    fill(app, "Why (needed to reject)", "It was pushed.")
    press(app, "Save the answer")
    (said,) = library.record(trial_id).reviews
    assert (said.verdict, said.reason) == ("rejected", "It was pushed.")


def test_an_answer_to_what_somebody_else_changed_is_not_kept(app, library, trial_id):
    open_trial(app, trial_id)
    library.edit(trial_id, version=library.record(trial_id).version, tags=["seen"])
    press(app, "Save the answer")
    assert "Somebody else changed this trial" in html(app)
    assert not library.record(trial_id).reviews
    press(app, "Save the answer")
    assert len(library.record(trial_id).reviews) == 1


def test_notes_come_and_go(app, library, trial_id):
    open_trial(app, trial_id)
    fill(app, "Note on the whole video", "The floor was wet.")
    press(app, "Add the note")
    (note,) = library.record(trial_id).notes
    assert (note.text, note.at_s) == ("The floor was wet.", None)
    assert any(text.value == "The floor was wet." for text in app.text)
    next(b for b in app.button if "delete-" in (b.key or "")).click()
    app.run()
    assert not library.record(trial_id).notes
    press(app, "Add the note")
    assert "A note needs some words." in html(app)
