import json

import pytest
from streamlit.components.v2.bidi_component.main import _make_trigger_id


def html(app):
    """Everything the page wrote as HTML, without its style sheet."""
    written = [e.body for e in app.html if not e.body.startswith("<style>")]
    return " ".join([*written, *cards(app)])


def cards(app):
    """The HTML of every list of cards."""
    return [json.loads(e.proto.json)["html"] for e in app.get("bidi_component")]


def press(app, action, identifier):
    """Press a button on a card, as the browser would tell it."""
    (component,) = app.get("bidi_component")
    states = app._tree.get_widget_states()
    asked = {"event": "asked", "value": {"action": action, "id": identifier}}
    state = states.widgets.add()
    state.id = _make_trigger_id(component.proto.id, "events")
    state.json_trigger_value = json.dumps([asked])
    return app._run(states)


def test_the_app_opens_on_the_list(app):
    app.run()
    assert not app.exception
    assert app.title[0].value == "Trials"


@pytest.mark.parametrize(
    ("trial_id", "sentence"),
    [
        ("20200101-000000-000000-aaaaaa", "There is no trial"),
        ("../../etc", "A trial id has letters"),
        ("damaged", "damaged"),
    ],
)
def test_an_error_of_the_engine_is_shown_as_its_sentence(app, library, trial_id, sentence):
    damaged = library.folder("damaged")
    damaged.mkdir()
    (damaged / "trial.json").write_text("{")
    app.run()
    app.query_params["trial"] = trial_id
    app.switch_page("views/trial.py").run()
    assert not app.exception
    assert sentence in app.error[0].value
    app.button(key="back").click().run()
    assert app.title[0].value == "Trials"


def test_the_trial_page_without_a_trial_says_what_to_do(app):
    app.run().switch_page("views/trial.py").run()
    assert "Open one from the list" in app.info[0].value
    assert not app.exception
