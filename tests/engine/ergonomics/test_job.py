"""Several filmed tasks as one job: what adds up, what does not, and what is refused."""

import dataclasses
import math

import pytest

from engine.datatypes import FlagLevel, Subject
from engine.ergonomics.fatigue import compute_damage, compute_risk_percent
from engine.ergonomics.job import JobPart, assess_job
from engine.ergonomics.lifting_equation import Duration
from engine.ergonomics.lifting_job import LiftingTask, compute_cli
from engine.ergonomics.methods.lifft import METHOD as LIFFT
from engine.ergonomics.methods.rnle import METHOD as RNLE
from engine.errors import ConfigError
from tests.engine.ergonomics.bending import build_bending


def build_part(name="Crate", frequency=2.0, duration_h=None, **kwargs):
    return JobPart(name, build_bending(**kwargs), frequency, duration_h)


def test_one_task_is_its_own_lifting_index():
    part = build_part()
    job = assess_job([part], duration_h=1.0, recovery_h=1.0)
    task = dataclasses.replace(
        part.exposure.task, frequency_per_min=2.0, duration_h=1.0, recovery_h=1.0
    )
    alone = RNLE.assess(dataclasses.replace(part.exposure, task=task))
    assert job.risk["rnle_job"].value == pytest.approx(alone.value)
    assert job.risk["rnle_job"].interval == pytest.approx(alone.interval)
    assert job.duration is Duration.SHORT


def test_the_same_lift_filmed_twice_is_one_lift_done_more_often():
    twice = assess_job([build_part("A", 2.0), build_part("B", 1.0)], duration_h=4.0)
    once = assess_job([build_part("A", 3.0)], duration_h=4.0)
    for name in ("rnle_job", "lifft", "l5s1"):
        assert twice.risk[name].value == pytest.approx(once.risk[name].value), name
    assert [part.share for part in twice.parts] == pytest.approx([2 / 3, 1 / 3])


def test_the_index_is_that_of_the_manuals_procedure():
    parts = [build_part("Light", 4.0, load_kg=6.0), build_part("Heavy", 1.0, load_kg=15.0)]
    job = assess_job(parts, duration_h=2.0)
    tasks = []
    for part in parts:
        lift = next(p for p in job.parts if p.name == part.name).rnle.per_lift[0]
        firwl = lift.details["rwl_kg"] / lift.details["origin"]["FM"]
        load = part.exposure.task.load_kg
        height = lift.details["origin"]["V_cm"]
        tasks.append(LiftingTask(part.name, firwl, height, part.frequency_per_min, load, load))
    expected = compute_cli(tasks, Duration.MODERATE)
    assert job.risk["rnle_job"].value == pytest.approx(expected.value)
    said = job.risk["rnle_job"].steps
    assert said[1].startswith("Heavy, lift 1: 1 per minute")
    assert said[-1] == f"CLI = {expected.value:.2f}"


def test_a_further_task_never_lowers_the_job():
    one = assess_job([build_part("A", 2.0)], duration_h=4.0)
    two = assess_job([build_part("A", 2.0), build_part("B", 1.0, load_kg=3.0)], duration_h=4.0)
    for name in ("rnle_job", "lifft"):
        assert two.risk[name].value >= one.risk[name].value


def test_damages_of_a_day_add_up():
    parts = [build_part("A", 2.0), build_part("B", 1.0, load_kg=18.0)]
    job = assess_job(parts, duration_h=4.0)
    total = 0.0
    for part in parts:
        task = dataclasses.replace(
            part.exposure.task, frequency_per_min=part.frequency_per_min, duration_h=4.0
        )
        alone = LIFFT.assess(dataclasses.replace(part.exposure, task=task))
        total += alone.details["damage_per_day"]
    assert job.risk["lifft"].details["damage_per_day"] == pytest.approx(total)
    assert job.risk["lifft"].value == pytest.approx(compute_risk_percent(total, "lifft"))
    low, high = job.risk["lifft"].interval
    assert low < job.risk["lifft"].value < high


@pytest.mark.parametrize("damage", [1e-6, 0.003, 0.5])
def test_damage_follows_from_its_probability(damage):
    percent = compute_risk_percent(damage, "lifft")
    assert compute_damage(percent, "lifft") == pytest.approx(damage)
    assert compute_damage(0.0, "lifft") == 0.0
    assert math.isinf(compute_damage(100.0, "lifft"))
    assert math.isnan(compute_damage(math.nan, "lifft"))


def test_moments_add_up_over_the_lifts_of_a_day():
    one = assess_job([build_part("A", 2.0)], duration_h=2.0).parts[0]
    per_lift = one.back.per_lift[0].details["cumulative_moment_lift_nm_s"]
    assert one.moment_nm_s == pytest.approx(240 * per_lift)
    job = assess_job([build_part("A", 2.0), build_part("B", 3.0)], duration_h=2.0)
    assert job.risk["l5s1"].details["moment_dose_nm_s"] == pytest.approx(600 * per_lift)


def test_a_rotation_weighs_each_task_by_its_time():
    parts = [build_part("A", 2.0, 1.0), build_part("B", 2.0, 3.0)]
    job = assess_job(parts)
    assert [part.lifts_per_day for part in job.parts] == pytest.approx([120, 360])
    assert job.duration is Duration.LONG
    assert any("rotation" in reason for reason in job.reasons)


def test_the_sequential_index_lies_between_the_worst_tasks_own_and_the_shifts():
    parts = [build_part("A", 2.0, 1.0, load_kg=16.0), build_part("B", 2.0, 3.0)]
    found = assess_job(parts, experimental=True)
    own = assess_job([build_part("A", 2.0, 1.0, load_kg=16.0)]).risk["rnle_job"].value
    shift = found.parts[0].rnle.value
    assert own <= found.risk["rnle_sli"].value <= shift + 1e-9
    assert found.risk["rnle_vli"].value > 0
    assert "experimental" in found.risk["rnle_sli"].reasons[0]
    assert "rnle_sli" not in assess_job(parts).risk


def test_different_people_are_said_and_their_backs_not_added():
    other = Subject(label="B", stature_m=1.6, mass_kg=60.0, sex="female")
    parts = [build_part("A", 2.0), build_part("B", 2.0, subject=other)]
    job = assess_job(parts, duration_h=2.0)
    assert "different people" in job.reasons[0]
    assert job.risk["rnle_job"].is_applicable
    assert math.isnan(job.risk["l5s1"].details["moment_dose_nm_s"])
    assert "not added up" in job.risk["l5s1"].details["doubts"][-1]


# --------------------------------------------------------------------------- bad input


def test_a_task_that_is_never_done_adds_nothing_and_is_said():
    job = assess_job([build_part("A", 2.0), build_part("B", 0.0)], duration_h=2.0)
    alone = assess_job([build_part("A", 2.0)], duration_h=2.0)
    for name in ("rnle_job", "lifft", "l5s1"):
        assert job.risk[name].value == pytest.approx(alone.risk[name].value)
    assert any("B: never done" in reason for reason in job.reasons)


def test_nothing_done_at_all_is_refused_by_the_index():
    job = assess_job([build_part("A", 0.0)], duration_h=2.0)
    assert not job.risk["rnle_job"].is_applicable
    assert "no task is ever done" in job.risk["rnle_job"].reasons[0]


def test_an_unknown_load_is_named_and_the_back_still_judged():
    job = assess_job([build_part("A", 2.0), build_part("Sack", 1.0, load_kg=None)], duration_h=2.0)
    for name in ("rnle_job", "lifft"):
        assert not job.risk[name].is_applicable
        assert "Sack" in job.risk[name].reasons[0]
    assert job.risk["l5s1"].is_applicable
    assert any(flag.level is FlagLevel.REVIEW for flag in job.flags)


def test_a_task_the_equation_refuses_is_named():
    job = assess_job([build_part("A", 2.0), build_part("Low", 1.0, conditions=("kneeling",))],
                     duration_h=2.0)  # fmt: skip
    assert "Low: the person kneels" in job.risk["rnle_job"].reasons[0]


@pytest.mark.parametrize(
    ("parts", "hours", "says"),
    [
        ([], 2.0, "at least one task"),
        ([("A", 2.0, None)], None, "How long the work lasts"),
        ([("A", 2.0, None)], 9.0, "at most 8 h"),
        ([("A", 2.0, 5.0), ("B", 2.0, 4.0)], None, "take 9 h together"),
        ([("A", 2.0, 5.0), ("B", 2.0, None)], None, "B has no time of its own"),
        ([("A", 2.0, None)], 0.0, "How long"),
    ],
)
def test_impossible_jobs_are_refused_in_one_sentence(parts, hours, says):
    with pytest.raises(ConfigError, match=says):
        assess_job([build_part(*part) for part in parts], duration_h=hours)


@pytest.mark.parametrize(("frequency", "hours"), [(-1.0, None), (math.nan, None), (2.0, 0.0)])
def test_impossible_parts_are_refused(frequency, hours):
    with pytest.raises(ConfigError, match="Crate"):
        build_part(frequency=frequency, duration_h=hours)


def test_a_heavy_job_raises_a_flag():
    job = assess_job([build_part("A", 6.0, load_kg=25.0)], duration_h=8.0)
    assert job.flags[0].level is FlagLevel.HIGH
    assert "omposite lifting index" in job.flags[0].what
