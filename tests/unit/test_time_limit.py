"""A limit on time: without effect where a machine is fast enough, and kept where it is not."""

import dataclasses
from types import SimpleNamespace

import pytest

from dsar.config import ScheduleConfig
from dsar.training.schedule import schedule_at
from dsar.training.state import TrainingState
from dsar.training.time_limit import REGISTRATION_SHARE, TimeLimit, part_at

SCHEDULE = ScheduleConfig(steps=1000, minutes=5.0)
COSTS = {"template": 0.07, "registration": 0.1, "pretraining": 0.06, "reduced": 0.2, "whole": 0.25}
"""Seconds of an update, or of a registered frame: 194 for the whole schedule with 300 frames."""
FRAMES = 300


def run(schedule, costs, *, frames=FRAMES, load=lambda seconds: 1.0, used=0.0, network_seconds=0.0):
    """Follow a schedule on a made-up machine; return the state at its end, the seconds, updates by part."""
    limit = TimeLimit(schedule, used, network_seconds)
    state = SimpleNamespace(step=0, progress=0.0, skipped=0.0)
    clock, registered, done = 0.0, 0, dict.fromkeys(costs, 0)
    while state.progress < 1:
        part = part_at(schedule, state.progress)
        if part != "template" and registered < frames:
            part = "registration"
        clock += costs[part] * load(clock) * bool(done["template"])
        limit.note(part, clock)
        done[part] += 1
        if part == "registration":
            registered += 1
            if limit.ends_registration(state.progress, frames - registered):
                registered = frames
            continue
        TrainingState.advance(state, schedule.steps, limit.passes_over(state.progress, frames - registered))
        if not state.skipped:
            assert state.progress == state.step / schedule.steps
    return state, clock, done


@pytest.mark.parametrize("minutes", [None, 4.0, 60.0])
def test_a_machine_that_is_fast_enough_does_every_update_at_its_place_whatever_the_limit(minutes):
    state, _, done = run(dataclasses.replace(SCHEDULE, minutes=minutes), COSTS)
    assert state.step == SCHEDULE.steps
    assert state.skipped == 0
    assert done["registration"] == FRAMES


@pytest.mark.parametrize("slowness", [2.0, 4.0, 10.0])
def test_a_slow_machine_ends_in_time_and_every_part_of_the_schedule_gets_its_share(slowness):
    costs = {part: slowness * cost for part, cost in COSTS.items()}
    state, seconds, done = run(SCHEDULE, costs)
    assert 270 < seconds < 306
    assert state.step < SCHEDULE.steps
    assert state.step + state.skipped == pytest.approx(SCHEDULE.steps, rel=0.02)
    assert costs["registration"] * done["registration"] < 1.05 * REGISTRATION_SHARE * 300
    updates = {part: count for part, count in done.items() if part != "registration"}
    shares = [
        updates[part] / sum(schedule_parts().values()) / count for part, count in schedule_parts().items()
    ]
    assert max(shares) < 3 * min(shares)


def schedule_parts():
    parts = [part_at(SCHEDULE, i / SCHEDULE.steps) for i in range(SCHEDULE.steps)]
    return {part: parts.count(part) for part in dict.fromkeys(parts)}


def test_other_work_on_the_machine_costs_only_as_many_updates_as_it_takes_time():
    state, seconds, _ = run(SCHEDULE, COSTS, load=lambda seconds: 4.0 if 60 < seconds < 200 else 1.0)
    assert seconds < 306
    assert 0 < state.skipped < 450


def test_frames_stay_without_a_map_only_where_the_updates_need_the_time():
    short = dataclasses.replace(SCHEDULE, steps=300, minutes=2.5)
    _, _, done = run(short, COSTS | {"registration": 0.25})
    assert done["registration"] == FRAMES, "75 of 150 seconds, and the updates need 58"
    _, _, done = run(dataclasses.replace(short, steps=900), COSTS | {"registration": 0.25})
    assert done["registration"] < FRAMES


def test_a_network_that_is_dearer_than_the_template_by_far_is_expected_by_its_arithmetic():
    costs = COSTS | {"pretraining": 20.0, "reduced": 20.0, "whole": 20.0}
    _, _, blind = run(dataclasses.replace(SCHEDULE, minutes=60.0), costs)
    state, seconds, seen = run(dataclasses.replace(SCHEDULE, minutes=60.0), costs, network_seconds=15.0)
    assert seen["template"] < 0.5 * blind["template"]
    assert seconds < 3680
    assert state.step + state.skipped == pytest.approx(SCHEDULE.steps, rel=0.02)


def test_what_earlier_processes_took_counts():
    state, seconds, _ = run(SCHEDULE, COSTS, used=180.0)
    assert 100 < seconds < 126
    assert state.skipped > 0


def test_more_updates_than_time_can_hold_fill_the_time():
    _, seconds, done = run(dataclasses.replace(SCHEDULE, steps=1_000_000), COSTS)
    assert 285 < seconds < 306
    assert done["template"] + done["pretraining"] < 0.4 * sum(done.values())


def test_parts_follow_the_stages():
    for progress in (0.0, 0.11, 0.13, 0.31, 0.33, 0.84, 0.86, 0.99):
        now, part = schedule_at(SCHEDULE, progress), part_at(SCHEDULE, progress)
        assert part == (now.stage if now.stage in ("template", "pretraining") else part)
        assert (part == "whole") == (now.stage == "autoregressive" and now.reduction == 1)
