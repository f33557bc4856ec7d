"""An avatar on a device is driven, measured and stressed as on the host, and delivered to it."""

import dataclasses
from functools import partial

import numpy as np
import pytest
import torch

from dsar.avatar.rollout import roll_out
from dsar.cli import main
from dsar.cli.drive_command import DrivenAvatar
from dsar.data.captures.formats import open_capture
from dsar.evaluation import heldout, profiling
from dsar.evaluation import stress as battery
from dsar.evaluation.profiling import time_rollout
from dsar.metrics.lpips import Lpips
from dsar.training.checkpoint import load_checkpoint
from tests.brief_battery import CASES, shorten_motions
from tests.devices.host_waits import watch
from tests.devices.plain_torch import plain_torch
from tests.devices.pretended_device import MixedDevicesError, PretendedTensor
from tests.devices.recorded_graphs import cuda_graphs
from tests.devices.small_run import TEST, TRAIN, small_capture, train_small

UNSEEN = "kick"
TIMES = ("fps", "ms", "ms_p95")


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run that the host trained."""
    with plain_torch():
        return train_small(tmp_path_factory.mktemp("runs") / "run", "cpu", stop_after=3)


@pytest.fixture(scope="module")
def avatars(device, run):
    """Yield one trained avatar on the host, and the same on the device."""
    with plain_torch():
        host = load_checkpoint(run)[0]
        torch.manual_seed(0)
        torch.nn.init.normal_(host.network.decoder.head.weight, std=0.05)
        there = load_checkpoint(run, device)[0]
        there.load_state_dict(host.state_dict())
        yield host, there


@pytest.fixture(scope="module")
def capture():
    """The small capture by two cameras, with a part of an unseen motion."""
    whole, small = open_capture("embedded"), small_capture()
    return dataclasses.replace(
        small,
        cameras=small.cameras[:2],
        motions={**small.motions, UNSEEN: whole.motions[UNSEEN].slice(0, 6)},
        splits={**small.splits, "unseen_test": (UNSEEN,)},
        garments={**small.garments, UNSEEN: whole.garments[UNSEEN]},
    )


def test_an_avatar_is_wholly_where_its_checkpoint_was_loaded_to(avatars):
    host, there = avatars
    assert (host.device.type, there.device.type) == ("cpu", "pretended")
    for tensor in (*there.parameters(), *there.buffers()):
        assert isinstance(tensor, PretendedTensor)


def test_a_rollout_on_the_device_is_the_hosts_with_its_graph_and_without(avatars):
    """From the fourth frame on a recorded graph is replayed; going back copies into its memory."""
    host, there = avatars
    motion = open_capture("embedded").motions[TRAIN].slice(0, 12)
    frames = [1001, 1004, 1005, 1006, 1012]
    expected = [gaussians for _, gaussians in roll_out(host, motion, frames=frames)]
    with cuda_graphs() as graphs:
        sequence = roll_out(there, motion, frames=frames)
        for _ in range(2):
            for one, (_, other) in zip(expected, sequence, strict=True):
                assert other.means.device.type == "pretended"
                for name, value in vars(one).items():
                    assert torch.equal(value, getattr(other, name).cpu()), name
    assert [graph.replays for graph in graphs] == [9, 9]


def test_a_step_of_a_rollout_makes_the_host_wait_for_nothing(avatars):
    _, there = avatars
    motion = open_capture("embedded").motions[TRAIN].slice(0, 12)
    with cuda_graphs(), watch() as log:
        waits = [sum(log.waits.values()) for _ in roll_out(there, motion)]
    assert waits[-1] == waits[3], log.waits


def test_deliveries_are_in_main_memory_wherever_the_avatar_is(avatars):
    _, there = avatars
    motion = open_capture("embedded").motions[TRAIN].slice(0, 2)
    driven = DrivenAvatar(there, motion, motion, lambda: None, {}, {})
    with cuda_graphs():
        delivered = [gaussians for _, gaussians in driven.whole]
    assert len(delivered) == 2
    for gaussians in delivered:
        assert all(isinstance(value.numpy(), np.ndarray) for value in vars(gaussians).values())
    binding = driven.whole.binding
    assert not isinstance(binding.body.vertices, PretendedTensor)
    assert not isinstance(binding.T_world_rest, PretendedTensor)


def test_a_command_on_the_device_writes_the_hosts_files(device, run, tmp_path, monkeypatch):
    files = []
    for place in (torch.device("cpu"), device):
        monkeypatch.setattr("dsar.devices.choose_device", lambda _, place=place: place)
        folder = tmp_path / place.type
        with plain_torch(), cuda_graphs():
            main(["export", str(run.folder), "--motion", TEST, "--ply", str(folder), "--progress", "none"])
        files.append({path.name: path.read_bytes() for path in folder.glob("*.ply")})
    assert len(files[0]) == 4
    assert files[0] == files[1]


def test_figures_of_an_avatar_on_the_device_are_the_hosts(avatars, capture, monkeypatch):
    monkeypatch.setattr(heldout, "time_rollout", partial(time_rollout, frames=2))
    monkeypatch.setattr(profiling, "_WARM_UP", 1)
    # As if LPIPS's weights were on this machine.
    torch.manual_seed(0)
    weights = Lpips("alex").state_dict()
    monkeypatch.setattr("dsar.evaluation.image_metrics.find_lpips_weights", lambda _: Existing())
    monkeypatch.setattr("dsar.evaluation.image_metrics.load_lpips", lambda _: lpips_with(weights))
    figures = []
    for avatar in avatars:
        with cuda_graphs():
            content = heldout.evaluate(avatar, capture, stride=1).to_json()
        figures.append({key: value for key, value in content.items() if key not in TIMES})
    assert figures[0] == figures[1]
    assert figures[0]["splits"]["test"]["psnr_garment"] is not None
    assert figures[0]["unseen"]["test"]["motions"][UNSEEN]["mm"] > 0
    assert figures[0]["garment"][TEST] is not None


class Existing:
    def exists(self) -> bool:
        return True


def lpips_with(weights) -> Lpips:
    model = Lpips("alex")
    model.load_state_dict(weights)
    return model


def test_the_battery_finds_the_same_on_the_device(avatars, capture, monkeypatch):
    shorten_motions(monkeypatch)
    verdicts = []
    for avatar in avatars:
        with cuda_graphs():
            verdicts.append(dict(battery.stress(avatar, capture.motions[TEST], CASES)))
    host, there = verdicts
    precisions = [each.pop("precision").details for each in verdicts]
    assert host == there
    # On a device the host's own pictures are compared, too: here they are the same.
    assert precisions[1] == precisions[0] | {"levels_cpu": 0.0}
    assert host.keys() | {"precision"} == battery.CASES.keys()
    assert all(verdict.curve for verdict in host.values())


def test_a_motion_on_the_host_drives_an_avatar_on_the_device_and_its_tensors_do_not_mix(avatars):
    host, there = avatars
    motion = small_capture().motions[TEST]
    signal = there.driving_signal(motion)
    assert {t.device.type for t in (signal.windows, signal.steady, signal.cloth)} == {"pretended"}
    with pytest.raises(MixedDevicesError):
        there.gaussians(host.driving_signal(motion).windows[:1], None)
