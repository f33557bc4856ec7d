"""What torchrun says of a process, the GPU it takes, and which of several says why all end."""

import pytest
import torch
import torch.distributed as dist

from dsar.cli import main
from dsar.errors import CaptureError, ConfigError
from dsar.training import launch, workers

RANK_5 = {"RANK": 5, "WORLD_SIZE": 8, "LOCAL_RANK": 1, "LOCAL_WORLD_SIZE": 4}
STORE = {"MASTER_ADDR": "somewhere", "MASTER_PORT": 1}


@pytest.fixture
def ranked(monkeypatch):
    """Make this process rank 5 of 8, the second of 4 on a machine of 4 GPUs."""
    for name, value in (RANK_5 | STORE).items():
        monkeypatch.setenv(name, str(value))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 4)
    return monkeypatch


def test_a_process_that_nobody_launched_trains_alone():
    assert launch.launched() is None
    assert launch.is_first()
    assert launch.takes_the_word()
    assert launch.from_first(lambda: 3) == 3


def test_a_rank_takes_the_gpu_of_its_number(ranked):
    assert launch.launched() == launch.Launch(5, 8, 1, 4)
    assert not launch.is_first()
    assert (workers.total_count(2), workers.local_count(8)) == (8, 4)
    assert {launch.own_device(name) for name in ("auto", "cuda")} == {torch.device("cuda:1")}
    assert launch.own_device("cpu") == torch.device("cpu")
    with pytest.raises(ConfigError, match="4 ranks of this machine cannot share one GPU"):
        launch.own_device("cuda:0")
    ranked.setattr(torch.cuda, "device_count", lambda: 3)
    with pytest.raises(ConfigError, match="4 ranks on this machine, which has 3"):
        launch.own_device("auto")


@pytest.mark.parametrize(("name", "value"), [("LOCAL_RANK", None), ("RANK", "first")])
def test_half_a_launch_is_refused(ranked, name, value):
    """Else each would train by itself, all into one folder."""
    if value is None:
        ranked.delenv(name)
    else:
        ranked.setenv(name, value)
    with pytest.raises(ConfigError, match="torchrun"):
        launch.launched()


def test_a_refusal_is_said_by_one_rank(ranked, tmp_path, capfd):
    store = dist.HashStore()
    ranked.setattr(launch, "_store", lambda: store)
    for _ in range(2):
        with pytest.raises(SystemExit) as stop:
            main(["train", "--workers", "2", "--out", str(tmp_path / "run")])
        assert stop.value.code == 2
    error = capfd.readouterr().err
    assert error == "dsar: --workers 2: torchrun started 8; leave --workers out\n"


def refuse(report):
    def first_only():
        assert workers.rank() == 0
        raise CaptureError("image 0007.png is broken")

    with pytest.raises(CaptureError, match=r"0007\.png"):
        launch.from_first(first_only)
    given = dict(workers.collected(bytes([workers.rank()]) * 3))
    assert given == ({1: b"\1\1\1"} if workers.rank() == 0 else {})


def test_what_the_first_rank_refuses_all_raise_and_what_others_have_it_collects():
    workers.run_workers(2, refuse, (), None)
