"""Trials are found, filtered, sorted and counted alike on both kinds of database."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from engine.datatypes import FlagLevel
from engine.errors import ConfigError
from engine.storage.library import Library
from engine.storage.overview import LiftCounts
from engine.storage.results import write_result
from tests.builders import make_trial_result
from tests.engine.storage.trials import add, rewrite

HIGH, REVIEW, OK = FlagLevel.HIGH, FlagLevel.REVIEW, FlagLevel.OK
JUNE = datetime(2026, 6, 1, 8, tzinfo=UTC)


@pytest.fixture
def library(any_library: Library) -> Library:
    return any_library


@pytest.fixture
def stocked(library: Library) -> Library:
    """Five trials at two sites, a day apart, from `a` (oldest) to `e`."""
    rows = (
        ("a", "Crate to shelf", "Hall 3", "Packing", "P01", (HIGH, OK), 2.5),
        ("b", "Sack onto pallet", "Hall 3", "Loading", "P02", (REVIEW,), 1.2),
        ("c", "Größe 😀 100%_x", "Hall 4", "Packing", "P01", (OK, OK), 0.6),
        ("d", "Barrel", "Hall 4", "Packing", "P03", (), math.nan),
        ("e", "Door", "", "", "", (HIGH,), math.inf),
    )
    for day, (name, label, site, job, person, levels, li) in enumerate(rows):
        add(
            library,
            name,
            label=label,
            site=site,
            job=job,
            person=person,
            levels=levels,
            created=JUNE + timedelta(days=day),
        )
        if levels:
            document = {"value": None if math.isinf(li) else li, "is_infinite": math.isinf(li)}
            rnle = {**_risk(library, name), **document}
            rewrite(library.folder(name), risk={"rnle": rnle})
    return library


def _risk(library: Library, name: str) -> dict[str, object]:
    from engine.storage.results import read_document

    return dict(read_document(library.folder(name))["risk"]["rnle"])


def ids(library: Library, **filters: object) -> str:
    library.entries()  # what was written in place is found when it is shown
    return "".join(entry.id for entry in library.query(**filters).entries)  # type: ignore[arg-type]


CASES: tuple[tuple[dict[str, Any], str], ...] = (
    ({}, "edcba"),
    ({"search": "crate"}, "a"),
    ({"search": "SHELF crate"}, "a"),
    ({"search": "crate pallet"}, ""),
    ({"search": "grösse 😀"}, "c"),
    ({"search": "100%_"}, "c"),
    ({"search": "_"}, "c"),
    ({"search": "'; DROP TABLE trials; --"}, ""),
    ({"search": "p01"}, "ca"),
    ({"search": "hall packing"}, "dca"),
    ({"site": "Hall 3"}, "ba"),
    ({"site": ""}, "e"),
    ({"site": "Hall 4", "job": "Packing"}, "dc"),
    ({"person": "P01"}, "ca"),
    ({"person": ""}, "e"),
    ({"level": HIGH}, "ea"),
    ({"level": (HIGH, REVIEW)}, "eba"),
    ({"level": (None,)}, "d"),
    ({"level": ()}, ""),
    ({"since": JUNE + timedelta(days=3)}, "ed"),
    ({"until": JUNE + timedelta(days=1)}, "a"),
    ({"limit": 2}, "ed"),
    ({"limit": 2, "offset": 3}, "ba"),
    ({"order": "oldest"}, "abcde"),
    ({"order": "label"}, "dacbe"),
    ({"order": "level"}, "eabcd"),
    ({"order": "index"}, "eabcd"),
)


def test_filters_and_orders(stocked: Library) -> None:
    found = {str(filters): ids(stocked, **filters) for filters, _ in CASES}
    # A server sorts names by its language, SQLite by letters.
    names = found.pop(str({"order": "label"}))
    assert names.index("d") < names.index("a") < names.index("b")
    assert found == {str(filters): expected for filters, expected in CASES if str(filters) in found}


def test_a_page_says_what_the_whole_holds(stocked: Library) -> None:
    stocked.entries()
    page = stocked.query(search="hall", level=HIGH, limit=1)
    assert [entry.id for entry in page.entries] == ["a"]
    assert page.total == 1
    assert page.levels == {HIGH: 1, REVIEW: 1, OK: 1, None: 1}
    assert stocked.query(limit=2).total == 5


def test_choices_leave_out_what_was_not_given(stocked: Library) -> None:
    choices = stocked.choices()
    assert choices.sites == {"Hall 3": 2, "Hall 4": 2}
    assert choices.jobs == {"Loading": 1, "Packing": 3}
    assert choices.people == {"P01": 2, "P02": 1, "P03": 1}


def test_unknown_orders_and_times_without_zone_are_explained(library: Library) -> None:
    with pytest.raises(ConfigError, match="sorted by newest"):
        library.query(order="best")  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="zone"):
        library.query(since=datetime(2026, 6, 1))  # noqa: DTZ001


def test_a_result_that_changed_on_disk_is_a_new_version(library: Library) -> None:
    add(library, "a")
    write_result(make_trial_result(n_frames=2, lis=(3.0,)), library.folder("a"))
    assert library.query(limit=1).entries[0].li == 3.0
    assert [(r.version, r.li) for r in library.record("a").results] == [(1, 1.4), (2, 3.0)]
    rewrite(library.folder("a"), label="New")
    assert library.query(limit=1).entries[0].label == "New"


def test_a_folder_deleted_outside_is_damage_that_can_be_undone(library: Library) -> None:
    add(library, "a")
    aside = library.root / "elsewhere"
    library.folder("a").rename(aside)
    (entry,) = library.entries()
    assert entry.is_damaged
    assert "moved or deleted outside LiftLens" in entry.message
    aside.rename(library.folder("a"))
    assert library.entries()[0].status == "done"
    library.folder("a").rename(aside)
    library.delete("a")
    assert library.entries() == ()


def test_an_older_library_of_plain_folders_is_taken_over(library: Library) -> None:
    for name in ("a", "b"):
        write_result(make_trial_result(n_frames=2), library.folder(name))
    (library.folder("b") / "trial.json").write_text("{")
    again = Library.open(library.root)
    assert {entry.id: entry.status for entry in again.entries()} == {"a": "done", "b": "damaged"}
    assert not again.is_empty


class TestOverview:
    def test_lifts_are_counted_by_their_most_urgent_flag(self, stocked: Library) -> None:
        stocked.entries()
        seen = stocked.overview()
        assert seen.lifts == LiftCounts(n_trials=5, n_lifts=6, n_high=2, n_review=1, n_ok=3)
        assert [(p.site, p.job) for p in seen.jobs] == [
            ("", ""), ("Hall 3", "Loading"), ("Hall 3", "Packing"), ("Hall 4", "Packing"),
        ]  # fmt: skip
        assert [(p.site, p.job, p.lifts.n_high) for p in seen.sites] == [
            ("", None, 1), ("Hall 3", None, 1), ("Hall 4", None, 0),
        ]  # fmt: skip
        packing = seen.jobs[2]
        assert packing.worst_li == 2.5
        assert packing.latest == JUNE
        assert [(m.year, m.month, m.lifts.n_trials) for m in seen.months] == [(2026, 6, 5)]

    def test_it_can_be_narrowed_to_before_and_after(self, stocked: Library) -> None:
        stocked.entries()
        change = JUNE + timedelta(days=1)
        before = stocked.overview(site="Hall 3", until=change)
        after = stocked.overview(site="Hall 3", since=change)
        assert (before.lifts.n_high, after.lifts.n_high) == (1, 0)
        assert stocked.overview(job="nothing").lifts == LiftCounts()

    def test_months_are_those_of_utc(self, library: Library) -> None:
        add(library, created=datetime.fromisoformat("2026-07-01T00:30:00+02:00"))
        add(library, created=datetime.fromisoformat("2026-07-01T00:30:00+00:00"))
        months = library.overview().months
        assert [(m.month, m.lifts.n_trials) for m in months] == [(6, 1), (7, 1)]

    def test_damaged_trials_are_counted_apart(self, library: Library) -> None:
        add(library, "a")
        (library.folder("a") / "tracks.npz").unlink()
        library.entries()
        assert library.overview().lifts == LiftCounts()
        assert library.overview().n_damaged == 1

    def test_much_evidence_weighs_more_than_one_bad_lift(self, library: Library) -> None:
        add(library, job="once", levels=(HIGH,))
        add(library, job="often", levels=(HIGH,) * 19 + (OK,))
        add(library, job="never", levels=(OK,) * 5)
        assert [place.job for place in library.overview().worst_jobs()] == ["often", "once"]

    def test_the_interval_is_wilsons(self) -> None:
        # Newcombe (1998), Statistics in Medicine 17, table I: 81 of 263, and 0 of 20.
        low, high = LiftCounts(n_high=81, n_ok=263 - 81).share_high_interval
        assert (round(low, 4), round(high, 4)) == (0.2553, 0.3662)
        low, high = LiftCounts(n_high=0, n_ok=20).share_high_interval
        assert (low, round(high, 4)) == (0.0, 0.1611)
        assert math.isnan(LiftCounts().share_high)
