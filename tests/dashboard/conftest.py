import pytest
from streamlit.testing.v1 import AppTest

from engine.storage.library import HOME_VARIABLE, Library
from tests.dashboard.results import APP, add_trial


@pytest.fixture
def library(tmp_path, monkeypatch):
    monkeypatch.setenv(HOME_VARIABLE, str(tmp_path / "home"))
    return Library.open()


@pytest.fixture
def trial_id(library, tmp_path):
    return add_trial(library, tmp_path)


@pytest.fixture
def app(library):
    """The whole app on an own library; run it to open the list of trials."""
    return AppTest.from_file(str(APP), default_timeout=30)
