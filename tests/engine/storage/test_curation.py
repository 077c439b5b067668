"""What people add to trials stays, and two people at one trial lose nothing."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import date

import pytest

from engine.datatypes import FlagLevel
from engine.errors import ConfigError
from engine.storage.curation import EditConflict
from engine.storage.library import Library
from engine.storage.results import write_result
from tests.builders import make_flag, make_trial, make_trial_result
from tests.engine.storage.trials import add


@pytest.fixture
def library(any_library: Library) -> Library:
    add(any_library, "a")
    return any_library


def test_names_and_tags_can_be_corrected(library: Library) -> None:
    version = library.record("a").version
    after = library.edit(
        "a", version=version, label="  Kiste\n📦 ", site="Hall 5", tags=("Night", "crate", "Night")
    )
    (entry,) = library.query(search="kiste hall 5 night").entries
    assert (entry.label, entry.site, entry.job) == ("Kiste 📦", "Hall 5", "Packing")
    assert entry.tags == ("Night", "crate")
    assert entry.version == after == version + 1
    assert library.query(tags=["crate", "Night"]).total == 1
    assert library.query(tags=["crate", "Day"]).total == 0
    # The result says what it said when it was made.
    assert '"label": "Crate to shelf"' in (library.folder("a") / "trial.json").read_text()
    library.edit("a", version=after, tags=())
    assert library.choices().tags == {}
    assert library.choices().sites == {"Hall 5": 1}


def test_a_new_result_keeps_what_people_corrected(library: Library) -> None:
    library.edit("a", version=1, label="Mine")
    trial = make_trial(label="Theirs", job="Sorting")
    write_result(make_trial_result(n_frames=2, trial=trial), library.folder("a"))
    (entry,) = library.entries()
    assert (entry.label, entry.job) == ("Mine", "Sorting")


def test_the_second_of_two_people_is_told_and_loses_nothing(library: Library) -> None:
    start = library.record("a").version
    library.edit("a", version=start, label="First")
    with pytest.raises(EditConflict, match="Somebody else changed this trial") as caught:
        library.edit("a", version=start, label="Second", tags=("mine",))
    there = caught.value.current
    assert there.names.label == "First"
    assert library.record("a").tags == ()
    library.edit("a", version=there.version, label="Second", tags=("mine",))
    assert library.entries()[0].label == "Second"


def test_of_many_at_once_one_wins(library: Library) -> None:
    def change(number: int) -> bool:
        try:
            library.edit("a", version=1, label=f"N{number}")
        except EditConflict:
            return False
        return True

    with ThreadPoolExecutor(4) as pool:
        won = list(pool.map(change, range(8)))
    assert won.count(True) == 1
    assert library.entries()[0].label == f"N{won.index(True)}"


def test_notes_stand_side_by_side(library: Library) -> None:
    with ThreadPoolExecutor(4) as pool:
        notes = list(pool.map(lambda n: library.add_note("a", f"note {n}", author="AB"), range(6)))
    timed = library.add_note("a", "here\0", at_s=1.25)
    assert (timed.text, timed.at_s) == ("here", 1.25)
    assert library.entries()[0].n_notes == 7
    library.delete_note("a", notes[0].id)
    kept = library.record("a").notes
    assert len(kept) == 6
    assert kept[0].created.tzinfo is not None
    with pytest.raises(ConfigError, match="some words"):
        library.add_note("a", " \n")


def test_who_said_what_to_a_flag(library: Library) -> None:
    flag = make_flag(FlagLevel.HIGH)
    other = make_flag(FlagLevel.HIGH, what="Trunk bends far", method="reba")
    with pytest.raises(ConfigError, match="needs a reason"):
        library.review("a", flag, "rejected", version=1)
    version = library.review("a", flag, "accepted", version=1, reviewer="Dr B")
    version = library.review(
        "a", flag, "rejected", version=version, reason="The load is 2 kg", reviewer="AB"
    )
    record = library.record("a")
    said = record.verdict(flag)
    assert said is not None
    assert (said.verdict, said.reason, said.reviewer) == ("rejected", "The load is 2 kg", "AB")
    assert [r.verdict for r in record.reviews] == ["accepted", "rejected"]
    assert record.verdict(other) is None
    with pytest.raises(EditConflict):
        library.review("a", other, "accepted", version=version - 1)
    library.review("a", flag, "open", version=version)
    assert library.record("a").verdict(flag) is None


def test_a_word_about_an_earlier_result_does_not_count_for_a_new_one(library: Library) -> None:
    flag = make_flag(FlagLevel.HIGH)
    library.review("a", flag, "accepted", version=1)
    write_result(make_trial_result(n_frames=2, lis=(3.0,)), library.folder("a"))
    record = library.record("a")
    assert record.verdict(flag) is None
    assert len(record.reviews) == 1


def test_people_and_their_agreements(library: Library) -> None:
    add(library, person="P02")
    library.set_agreement("P02", consent_on=date(2026, 1, 5), keep_until=date(2026, 7, 5))
    first, second = library.people()
    assert (first.pseudonym, first.n_trials, first.keep_until) == ("P01", 1, None)
    assert second.consent_on == date(2026, 1, 5)
    assert library.overdue(date(2026, 7, 5)) == ()
    assert library.overdue(date(2026, 7, 6)) == (second,)
    with pytest.raises(ConfigError, match="pseudonym"):
        library.set_agreement(" ")


def test_a_performance_can_be_a_reference(library: Library) -> None:
    add(library, "b")
    library.set_reference("Good squat", "a", lift_index=0, notes="slow")
    library.set_reference("Good squat", "b")
    (reference,) = library.references()
    assert (reference.trial_id, reference.lift_index) == ("b", None)
    library.delete("b")
    assert library.references() == ()


def test_what_is_not_there_is_one_sentence(library: Library) -> None:
    flag = make_flag()
    for call in (
        lambda: library.record("b"),
        lambda: library.edit("b", version=1, label="x"),
        lambda: library.add_note("b", "x"),
        lambda: library.review("b", flag, "accepted", version=1),
        lambda: library.set_reference("x", "b"),
    ):
        with pytest.raises(ConfigError, match="There is no trial 'b'"):
            call()
