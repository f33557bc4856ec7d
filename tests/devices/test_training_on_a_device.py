"""Training on a device is training on the host: every stage, to the last bit, with few waits."""

from collections import Counter
from dataclasses import fields
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from safetensors.torch import load_file

from dsar.devices import send
from dsar.training import view_batch
from dsar.types import Gaussians, RenderOutput
from tests.devices.host_waits import Wait, watch
from tests.devices.plain_torch import plain_torch
from tests.devices.small_run import STEPS, default_config, train_small

HALF = 5
"""Updates after which training stops and goes on; half of the stages are over."""


@pytest.fixture(scope="module")
def runs(device, tmp_path_factory):
    """Yield the small run as the host trained it in one go, and as the device did in two."""
    folder = tmp_path_factory.mktemp("runs")
    stages: set[str] = set()
    with plain_torch():
        host = train_small(folder / "host", "cpu", lambda line: stages.add(line.stage))
        there = train_small(folder / "device", device, stop_after=HALF)
        assert load_file(there.checkpoint / "adam.safetensors")["0.step"] < STEPS
        train_small(folder / "device", device, resume=True)
    return host, there, stages


def test_every_stage_and_a_resume_on_the_device_leave_the_hosts_checkpoint(runs):
    host, there, stages = runs
    assert stages == {"template", "registration", "pretraining", "pose", "autoregressive"}
    names = sorted(path.name for path in host.checkpoint.glob("*.safetensors"))
    assert names == sorted(path.name for path in there.checkpoint.glob("*.safetensors"))
    for name in names:
        expected, found = (load_file(run.checkpoint / name) for run in (host, there))
        assert expected.keys() == found.keys()
        assert [key for key in expected if not torch.equal(expected[key], found[key])] == []


def test_settings_and_files_do_not_tell_where_a_run_was_trained(runs):
    host, there, _ = runs
    assert host.config.read_bytes() == there.config.read_bytes()
    assert host.scene.read_bytes() == there.scene.read_bytes()


def flat_images(gaussians, cameras, *, backgrounds, dilation):
    """Stand for a rasteriser that never waits: one colour a set of Gaussians, from all of them."""
    sizes = [(camera.height, camera.width) for views in cameras for camera in views]
    owners = torch.tensor([k for k, views in enumerate(cameras) for _ in views])
    pixels = [height * width for height, width in sizes]
    device = backgrounds.device
    joined = [torch.cat([getattr(each, f.name) for each in gaussians]) for f in fields(Gaussians)]
    means = torch.stack([field.view(len(gaussians), -1).mean(1) for field in joined]).mean(0)
    places = send(torch.arange(len(sizes)).repeat_interleave(torch.tensor(pixels)), device)
    mean = means.index_select(0, send(owners, device)).index_select(0, places)
    alpha = mean.sigmoid()
    color = alpha[:, None] * mean[:, None] + (1 - alpha)[:, None] * backgrounds.index_select(0, places)
    nothing = torch.zeros((), dtype=torch.int64, device=device)
    parts = zip(color.split(pixels), alpha.split(pixels), sizes, strict=True)
    images = iter([RenderOutput(c.unflatten(0, s), a.view(s), a.view(s), nothing) for c, a, s in parts])
    return [[next(images) for _ in views] for views in cameras]


WAITS = {
    # The loss and the squared error, for the report; whether the gradients are finite.
    "training/chunk.py": ("torch.stack([loss.detach()", 1),
    "training/loop.py": ("gradients.buffer.isfinite()", 1),
}
"""What the host waits for in an update: by file the line that does it, and how often."""


MOST_OPERATIONS = {"template": 1000, "pretraining": 900, "autoregressive": 1500}
"""Kernels, or nearly, of an update with the default settings, besides the rasteriser's."""


def test_an_update_keeps_the_host_waiting_twice_and_gives_the_device_few_operations(device, tmp_path):
    """Named are all places where the host waits; others come once a run, or once a stage."""
    waits: dict[int, Counter[Wait]] = {}
    operations: dict[int, int] = {}
    stages: dict[int, str] = {}
    with watch() as log, plain_torch(), patch.object(view_batch, "rasterize_views", flat_images):

        def report(line):
            if line.stage != "registration":
                waits[line.step], operations[line.step] = Counter(log.waits), log.operations.total()
                stages[line.step] = line.stage
            log.waits.clear()
            log.operations.clear()

        train_small(tmp_path, device, report, config=default_config())
    # The first update of a stage prepares it.
    settled = [step for step in waits if stages[step] == stages.get(step - 1)]
    assert {stages[step] for step in settled} == MOST_OPERATIONS.keys()
    for step in settled:
        assert operations[step] <= MOST_OPERATIONS[stages[step]], (stages[step], operations[step])
        assert len(waits[step]) == len(WAITS), waits[step]
        for wait, count in waits[step].items():
            file, line = next((file, line) for file, (line, _) in WAITS.items() if file in wait.place)
            assert line in source_line(wait), wait
            assert count == WAITS[file][1], wait


def source_line(wait: Wait) -> str:
    path, _, number = wait.place.rpartition(":")
    return Path(path).read_text().splitlines()[int(number) - 1]
