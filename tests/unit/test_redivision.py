"""Rollouts and registered maps of some workers, divided among others."""

import pytest
import torch

from dsar.training.redivision import merge_registration, take_rollouts
from dsar.training.registered_maps import RegisteredMaps
from dsar.training.rollouts import RolloutBatch, RolloutCursor

CLIPS = {"walk": range(50), "spin": range(2, 40)}


def written(first: int, count: int) -> dict[str, torch.Tensor]:
    """What a worker writes of rollouts, each of which has its number everywhere."""
    batch = RolloutBatch(CLIPS, count)
    for index in range(count):
        number, name = first + index, "spin" if (first + index) % 3 else "walk"
        batch.cursors[index] = RolloutCursor(name, number + 2, number, number % 2 == 1)
    numbers = torch.arange(first, first + count)
    cursors = {f"cursors.{name}": rows for name, rows in batch.state_dict().items()}
    return {"fresh": numbers % 2 == 0, "record.0.posed": numbers[:, None].expand(-1, 5).float(), **cursors}


@pytest.mark.parametrize("before", [1, 2, 4, 12])
@pytest.mark.parametrize("after", [1, 2, 3, 6, 12])
def test_every_rollout_goes_on_whatever_the_number_of_workers(before, after):
    old, new = 12 // before, 12 // after
    parts = [lambda first=first: written(first, old) for first in range(0, 12, old)]
    for first in range(0, 12, new):
        taken = take_rollouts(parts, range(first, first + new))
        batch = RolloutBatch(CLIPS, new)
        batch.load_state_dict(
            {k.removeprefix("cursors."): v for k, v in taken.items() if k.startswith("cursors.")}
        )
        expected = written(first, new)
        again = batch.state_dict()
        assert again.keys() == {k.removeprefix("cursors.") for k in expected if k.startswith("cursors.")}
        for name, value in expected.items():
            here = again[name.removeprefix("cursors.")] if name.startswith("cursors.") else taken[name]
            assert torch.equal(here, value), name


def test_more_rollouts_than_there_are_cannot_be_taken():
    with pytest.raises(ValueError, match="4 rollouts are there, 6"):
        take_rollouts([lambda: written(0, 4)], range(2, 6))


def maps(monkeypatch, rank: int, count: int) -> RegisteredMaps:
    monkeypatch.setattr("dsar.training.workers.rank", lambda: rank)
    monkeypatch.setattr("dsar.training.workers.world_size", lambda: count)
    return RegisteredMaps(CLIPS, 1, {name: frozenset() for name in CLIPS})


def fit(fitted: RegisteredMaps, frames: int) -> None:
    for name, frame in fitted.own[fitted.count : fitted.count + frames]:
        fitted.offsets[name][frame] = frame + 1
        fitted.fitted[name] += 1
    fitted.count += frames


@pytest.mark.parametrize("after", [1, 2, 3])
def test_frames_are_registered_once_whoever_began(monkeypatch, after):
    begun = [maps(monkeypatch, rank, 2) for rank in range(2)]
    for part in begun:
        fit(part, 10)
    merged = merge_registration([part.state_dict() for part in begun])
    ended = []
    for rank in range(after):
        part = maps(monkeypatch, rank, after)
        part.load_state_dict(merged)
        assert not part.complete
        fit(part, part.longest)
        assert part.complete
        ended.append(part)
    for name, clip in CLIPS.items():
        summed = sum(part.offsets[name] for part in ended)
        assert summed[clip.start :, 0, 0].tolist() == [frame + 1 for frame in clip]
        assert sum(int(part.fitted[name]) for part in ended) == len(clip)


def test_maps_that_time_was_too_short_for_stay_so(monkeypatch):
    part = maps(monkeypatch, 0, 1)
    fit(part, 10)
    part.all_gather()
    again = maps(monkeypatch, 0, 3)
    again.load_state_dict(merge_registration([part.state_dict()] * 2))
    assert again.complete
    assert again.unregistered == part.unregistered == len(CLIPS["walk"]) + len(CLIPS["spin"]) - 10


@pytest.mark.parametrize(("count", "complete"), [(49, False), (50, True)])
def test_older_files_say_how_far_the_busiest_worker_was(monkeypatch, count, complete):
    older = [maps(monkeypatch, rank, 2).state_dict() for rank in range(2)]
    for part in older:
        del part["complete"]
        part["count"] = torch.tensor(count)
    assert bool(merge_registration(older)["complete"]) is complete
