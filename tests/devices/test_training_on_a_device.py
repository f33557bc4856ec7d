"""Training on a device is training on the host: every stage, to the last bit, with few waits."""

from collections import Counter
from pathlib import Path
from unittest.mock import patch

import pytest
import torch
from safetensors.torch import load_file

from dsar.training import chunk
from dsar.types import RenderOutput
from tests.devices.host_waits import Wait, watch
from tests.devices.plain_torch import plain_torch
from tests.devices.small_run import STEPS, train_small

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


def flat_image(gaussians, camera, *, background, dilation):
    """Stand for a rasteriser that never waits: one colour, from all of the Gaussians."""
    values = (
        gaussians.means,
        gaussians.rotations,
        gaussians.scales,
        gaussians.opacities,
        gaussians.harmonics,
    )
    mean = torch.stack([value.mean() for value in values]).mean()
    alpha = mean.sigmoid().expand(camera.height, camera.width)
    color = alpha[..., None] * mean + (1 - alpha[..., None]) * background
    return RenderOutput(color, alpha, alpha, torch.zeros((), dtype=torch.int64, device=mean.device))


WAITS = {
    # The loss and the squared error, for the report; whether the gradients are finite.
    "training/chunk.py": ("torch.stack([loss.detach()", 1),
    "training/loop.py": ("gradients.buffer.isfinite()", 1),
}
"""What the host waits for in an update: by file the line that does it, and how often."""


def test_the_host_waits_twice_an_update_besides_the_rasteriser(device, tmp_path):
    """Named are all places in an update; others come once a run, or once a stage."""
    by_update: dict[int, Counter[Wait]] = {}
    stages: dict[int, str] = {}
    with watch() as log, plain_torch(), patch.object(chunk, "rasterize", flat_image):
        before: Counter[Wait] = Counter()

        def report(line):
            if line.stage != "registration":
                by_update[line.step], stages[line.step] = log.waits - before, line.stage
            before.clear()
            before.update(log.waits)

        train_small(tmp_path, device, report)
    # The first update of a stage prepares it.
    settled = [step for step in by_update if step > 2 and stages[step] == stages.get(step - 1)]
    assert {stages[step] for step in settled} == {"pretraining", "pose", "autoregressive"}
    for step in settled:
        waits = by_update[step]
        assert len(waits) == len(WAITS), waits
        for wait, count in waits.items():
            file, line = next((file, line) for file, (line, _) in WAITS.items() if file in wait.place)
            assert line in source_line(wait), wait
            assert count == WAITS[file][1], wait


def source_line(wait: Wait) -> str:
    path, _, number = wait.place.rpartition(":")
    return Path(path).read_text().splitlines()[int(number) - 1]
