from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from engine.errors import ConfigError
from engine.validation.profiles import (
    AngleRule,
    ImportProfile,
    format_profile,
    parse_axes,
    parse_profile,
    read_profile,
)
from engine.validation.reference.angle_names import OUR_ANGLES
from engine.validation.reference.naming import LANDMARKS

TEXT = st.text(st.characters(exclude_categories=("Cs",)), min_size=1, max_size=20)
PROFILES = st.builds(
    ImportProfile,
    name=TEXT,
    format=st.sampled_from([None, "trc", "c3d", "mot", "vicon-csv", "csv"]),
    length_unit=st.sampled_from([None, "m", "cm", "mm"]),
    angle_unit=st.sampled_from([None, "deg", "rad"]),
    axes=st.sampled_from([None, ("x", "y", "z"), ("x", "z", "-y"), ("-z", "y", "x")]),
    swap_sides=st.booleans(),
    labels=st.dictionaries(TEXT, st.sampled_from(sorted(LANDMARKS)), max_size=3),
    angles=st.dictionaries(
        st.sampled_from(OUR_ANGLES),
        st.builds(AngleRule, column=TEXT, sign=st.sampled_from([-1, 1])),
        max_size=3,
    ),
)


@given(PROFILES)
def test_a_profile_survives_writing_and_reading(profile):
    assert parse_profile(format_profile(profile)) == profile


def test_a_profile_is_read_from_a_file(tmp_path):
    path = tmp_path / "lab.toml"
    path.write_text('length_unit = "mm"\naxes = ["x", "z", "-y"]\n[angles]\ntrunk_flexion = "T"\n')
    profile = read_profile(path)
    assert profile.axes == ("x", "z", "-y")
    assert profile.angles == {"trunk_flexion": AngleRule("T", 1)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unit = 'mm'", "unknown key 'unit'"),
        ("length_unit = 'inch'", "length_unit must be one of m, cm, mm"),
        ("axes = ['x', 'z']", "three entries"),
        ("axes = ['x', 'z', 'w']", "got 'w'"),
        ("axes = ['x', 'x', 'z']", "once each"),
        ("axes = ['x', 'z', 'y']", "would mirror left and right"),
        ("labels = 3", "must be a table"),
        ("[labels]\nA = 'left_nose'", "'left_nose', which is no landmark"),
        ("[angles]\nbanana = 'A'", "no angle 'banana'"),
        ("[angles]\ntrunk_flexion = {column = 'A', sign = 2}", "must be 1 or -1"),
        ("[angles]\ntrunk_flexion = 3", "needs { column"),
        ("swap_sides = 'yes'", "true or false"),
        ("a = = b", "no valid TOML"),
    ],
)
def test_a_wrong_profile_is_one_plain_sentence(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_profile(text)


def test_a_missing_profile_is_one_plain_sentence(tmp_path):
    with pytest.raises(ConfigError, match="can't be read"):
        read_profile(tmp_path / "none.toml")


def test_axes_are_columns_and_signs():
    assert parse_axes(("x", "z", "-y")) == ((0, 1), (2, 1), (1, -1))
