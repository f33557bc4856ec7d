"""The GPU benchmark's whole frame: from the bones to an image of 200,000 Gaussians, paper's network."""

import statistics
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import asdict
from functools import partial

import torch
from gpu_memory import forget_peak, read_peak
from gpu_network import OURS, Variant, settings, tf32
from scene import make_camera
from timing import time_runs

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, body_chart
from dsar.data.captures.formats import open_capture
from dsar.devices import choose_device
from dsar.evaluation.profiling import read_clock
from dsar.network.session import InferenceSession
from dsar.raster import rasterize

RESOLUTION, QUICK_RESOLUTION = 576, 32
"""Texels across the body's chart: 576 give 199,000 Gaussians, where the paper preset's 512 give 157,000."""
IMAGE, QUICK_IMAGE = (940, 1280), (24, 32)
FRAME = 70
"""The frame of the motion that is drawn again and again: no part of it runs faster for what it sees."""
MOTION = "far"
PRECISIONS = ("float32", "tf32", "bf16")
"""Of the network; all else computes in float32."""


def measure_frame(quick: bool, device: str) -> Iterator[dict]:
    """Yield the time of a whole frame, and of its parts, by precision of the network."""
    where, image = choose_device(device), QUICK_IMAGE if quick else IMAGE
    avatar = make_avatar(quick).to(where)
    # A session records its step as a graph, except on a CPU.
    start = "eager" if where.type == "cpu" else "graph"
    for precision in PRECISIONS[:1] if quick else PRECISIONS:
        variant = Variant(OURS, precision, start)
        forget_peak()
        with tf32(variant.precision != "float32"):
            stages = make_stages(avatar, image, variant)
            frame = partial(draw_frame, stages)
            # The first compiles the rasteriser's kernels, the fourth records the network's graph.
            for _ in range(6):
                frame()
            parts = time_parts(stages, 3 if quick else 30)
            timing = time_runs(partial(_finish, frame), 0.05 if quick else 4.0, 400)
        row = {**asdict(variant), "gaussians": avatar.num_gaussians, "width": image[0], "height": image[1]}
        row |= {**asdict(timing), "frames_per_s": 1e3 / timing.median_ms, "parts_ms": parts}
        yield row | {"peak_bytes": read_peak(), "skipped": None}


def make_avatar(quick: bool) -> Avatar:
    """Return an untrained avatar of the paper's preset without a garment's chart, in main memory."""
    torch.manual_seed(0)
    capture, config = open_capture(), settings("paper", quick)
    atlas = Atlas.stack([body_chart(capture.body, QUICK_RESOLUTION if quick else RESOLUTION)])
    avatar = Avatar(capture.body, atlas, config.model, capture.motions[MOTION].fps)
    torch.nn.init.normal_(avatar.network.decoder.head.weight, std=0.01)
    return avatar


def make_stages(
    avatar: Avatar, image: tuple[int, int], variant: Variant
) -> dict[str, Callable[[object], object]]:
    """Return the parts of a frame by name: each takes what the one before it returned."""
    signal = avatar.driving_signal(open_capture().motions[MOTION])
    window, camera = signal.windows[[FRAME]], make_camera(*image)
    session = InferenceSession(
        avatar.network, precision=torch.bfloat16 if variant.precision == "bf16" else None
    )
    return {
        "maps": lambda _: avatar.standardize(avatar.input_maps(window, avatar.fps)),
        "network": lambda maps: session.step(*maps),
        "pose": lambda output: avatar.gaussians(window, output)[0],
        "raster": lambda gaussians: rasterize(gaussians, camera),
    }


@torch.no_grad()
def draw_frame(stages: dict[str, Callable[[object], object]]) -> object:
    """Return the next frame's image."""
    value: object = None
    for stage in stages.values():
        value = stage(value)
    return value


@torch.no_grad()
def time_parts(stages: dict[str, Callable[[object], object]], repeats: int) -> dict[str, float]:
    """Return the median milliseconds of each part, the GPU waited for after each."""
    found = defaultdict(list)
    for _ in range(repeats):
        value: object = None
        for name, stage in stages.items():
            start = read_clock()
            value = stage(value)
            found[name].append(1e3 * (read_clock() - start))
    return {name: statistics.median(times) for name, times in found.items()}


def _finish(frame: Callable[[], object]) -> None:
    """Draw, and wait for the GPU."""
    frame()
    read_clock()
