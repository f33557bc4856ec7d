"""A frame's work taken apart: the network's encoding, attention and decoding, posing, rasterisation."""

import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, TypeVar

import torch
from torch.utils.flop_counter import FlopCounterMode

from dsar.avatar.avatar import Avatar
from dsar.evaluation.results import FrameTimes
from dsar.evaluation.views import render_white
from dsar.network import DualStreamNetwork
from dsar.network.session import InferenceSession
from dsar.types import Capture

T = TypeVar("T")
_WARM_UP = 10
"""Frames before times count."""
Interceptor = Callable[[str, Callable[[], Any]], Any]
"""Is given a part's name and a call of it, and returns what the call returns."""


@contextmanager
def intercept_stages(network: DualStreamNetwork, interceptor: Interceptor) -> Iterator[None]:
    """Have every call into the encoder (`encode`) and the decoder (`decode`) go through an interceptor."""
    encoder, decoder = network.encoder, network.decoder
    calls = [
        (encoder, "encode_frame", "encode"),
        (encoder, "precompute", "encode"),
        (encoder, "assemble_window", "encode"),
    ]
    calls += [(network, "embed_motion", "encode"), (decoder, "forward", "decode")]
    for owner, name, part in calls:
        method = getattr(owner, name)

        def intercepted(*arguments: Any, method: Any = method, part: str = part) -> Any:
            return interceptor(part, lambda: method(*arguments))

        # On the object, where it hides the class's method.
        owner.__dict__[name] = intercepted
    try:
        yield
    finally:
        for owner, name, _ in calls:
            del owner.__dict__[name]


def time_stages(network: DualStreamNetwork, step: Callable[[], T]) -> tuple[T, dict[str, float]]:
    """Return what a step returns, and its milliseconds by part: `attention` is what the others are not."""
    seconds: dict[str, float] = defaultdict(float)

    def interceptor(part: str, call: Callable[[], Any]) -> Any:
        start = read_clock()
        result = call()
        seconds[part] += read_clock() - start
        return result

    start = read_clock()
    with intercept_stages(network, interceptor):
        result = step()
    total = read_clock() - start
    return result, _with_attention(seconds, total, 1e3)


def count_stage_flops(network: DualStreamNetwork, step: Callable[[], object]) -> dict[str, float]:
    """Return the GFLOP of one step by part: convolutions and matrix products only, a multiply-add is two."""
    flops: dict[str, float] = defaultdict(float)

    def interceptor(part: str, call: Callable[[], Any]) -> Any:
        with FlopCounterMode(display=False) as counter:
            result = call()
        flops[part] += counter.get_total_flops()
        return result

    with FlopCounterMode(display=False) as counter, intercept_stages(network, interceptor):
        step()
    return _with_attention(flops, counter.get_total_flops(), 1e-9)


@torch.no_grad()
def time_rollout(avatar: Avatar, capture: Capture, sequence: str, frames: int = 100) -> FrameTimes:
    """Return the milliseconds of the network's parts, posing and rasterisation of one camera.

    The first frames are left out. Posing includes the input maps, which are posed control points. A motion
    prior is simulated for all frames at once; each is charged its share.
    """
    signal = avatar.driving_signal(capture.motions[sequence])
    prior_start = read_clock()
    avatar.with_cloth(signal)
    prior = 1e3 * (read_clock() - prior_start) / len(signal)
    session = InferenceSession(avatar.network)
    times: dict[str, list[float]] = defaultdict(list)
    for frame in range(_WARM_UP + frames):
        start = read_clock()
        number = frame % len(signal)
        motion_window = signal.windows[number : number + 1]
        cloth = signal.cloth_at(range(number, number + 1))
        maps, magnitude = avatar.standardize(avatar.input_maps(motion_window, avatar.fps, cloth))
        network_start = read_clock()
        step = partial(session.step, maps, magnitude)
        output, stages = time_stages(session.network, step)
        network_end = read_clock()
        output = avatar.add_prior(output, cloth)
        gaussians = avatar.gaussians(motion_window, output)[0]
        posed = read_clock()
        render_white(gaussians, capture.cameras[0])
        posing = network_start - start + posed - network_end
        stages |= {"prior": prior} if avatar.prior is not None else {}
        stages |= {"pose": 1e3 * posing, "raster": 1e3 * (read_clock() - posed)}
        for name, milliseconds in stages.items():
            times[name].append(milliseconds)
    steady = {name: values[_WARM_UP:] for name, values in times.items() if name != "total"}
    return FrameTimes(
        {name: statistics.median(values) for name, values in steady.items()},
        {name: statistics.quantiles(values, n=20)[-1] for name, values in steady.items()},
    )


def read_clock() -> float:
    """Return seconds, once the GPU has done what it was given."""
    if torch.cuda.is_initialized():
        torch.cuda.synchronize()
    return time.perf_counter()


def _with_attention(parts: dict[str, float], total: float, unit: float) -> dict[str, float]:
    encode, decode = parts["encode"], parts["decode"]
    return {
        "encode": unit * encode,
        "attention": unit * (total - encode - decode),
        "decode": unit * decode,
        "total": unit * total,
    }
