import pytest


def html(app):
    """Everything the page wrote as HTML, without its style sheet."""
    return " ".join(e.body for e in app.html if not e.body.startswith("<style>"))


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
