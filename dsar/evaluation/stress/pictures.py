"""Cases that look at pictures: other precisions, and views in which nobody is."""

import copy
import dataclasses
from collections.abc import Iterator

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.evaluation.stress.rollouts import Rollout, posed, worst_of
from dsar.evaluation.stress.verdicts import CaseVerdict, rounded, sound
from dsar.evaluation.views import to_bytes
from dsar.geometry.cameras import look_at
from dsar.network import NetworkOutput
from dsar.network.session import InferenceSession
from dsar.raster import rasterize
from dsar.types import Camera, Gaussians, Motion

LEVELS = 255.0
"""Grey levels of a picture of 8 bits."""
_SIZE = (192, 256)
_DISTANCE = 4.5
"""Metres from which a person is seen."""
_LENS = 1.7
"""Focal length over the picture's height."""
_FRAMES = 60
"""Of a motion that are rolled out in other precisions."""
_STRIDE = 6


def camera_at(
    target: Float[Tensor, "3"], size: tuple[int, int] = _SIZE, side: tuple[float, float] = (0.6, 0.8)
) -> Camera:
    """Return a camera that looks at a point from the front, a little from its left.

    Args:
        target: World metres.
        size: Width and height, pixels.
        side: Where it stands, in X and Z, a unit vector.
    """
    width, height = size
    eye = target + _DISTANCE * target.new_tensor([side[0], 0.1, side[1]])
    K = torch.tensor([[_LENS * height, 0.0, width / 2], [0.0, _LENS * height, height / 2], [0.0, 0.0, 1.0]])
    return Camera(K, look_at(eye.numpy(), target.numpy()), width, height, "stress")


def run_precision(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """The same rollout in other precisions, and by training's path: rms difference of pictures, grey levels.

    bfloat16 against float32, and where the avatar is on a GPU, float32 on the CPU. The curve is the largest
    difference by picture, every sixth frame of the first two seconds.
    """
    short = motion.slice(0, _FRAMES)
    others = {"bfloat16": _other_precision(avatar, short), "training": _training_path(avatar, short)}
    if avatar.device.type != "cpu":
        others["cpu"] = _frames_of(copy.deepcopy(avatar).to("cpu"), short)
    differences: dict[str, list[Tensor]] = {name: [] for name in others}
    for frame, gaussians in enumerate(_frames_of(avatar, short)):
        theirs = {name: next(frames) for name, frames in others.items()}
        if frame % _STRIDE == 0:
            camera = camera_at(gaussians.means.mean(0))
            own = _draw(gaussians, camera)
            for name, each in theirs.items():
                differences[name].append((_draw(each, camera) - own).square().mean().sqrt() * LEVELS)
    every = torch.stack([torch.stack(each) for each in differences.values()])
    worst = _STRIDE * worst_of(every.amax(0))
    return CaseVerdict(
        value=sound(every.amax(), every),
        threshold=1.43,
        unit="grey levels",
        reason="45 dB: less than half of what 8 bits and video compression change",
        curve=rounded(every.amax(0)),
        frame=worst,
        details={f"levels_{name}": float(each.amax()) for name, each in zip(differences, every, strict=True)},
        moment=Rollout(avatar, short).moment(worst),
    )


def run_empty(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Views in which nobody is: largest difference of a picture from its background, grey levels.

    A camera that looks away, one inside of nothing a kilometre off, a person who is wholly transparent. The
    curve is the difference in each. And one who is there must be seen.
    """
    gaussians = next(_frames_of(avatar, motion.slice(0, 1)))
    camera = camera_at(gaussians.means.mean(0))
    away = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])) @ camera.T_camera_world
    far = dataclasses.replace(gaussians, means=gaussians.means + torch.tensor([1000.0, 0.0, 0.0]))
    clear = dataclasses.replace(gaussians, opacities=torch.zeros_like(gaussians.opacities))
    background = torch.tensor([0.2, 0.4, 0.6])
    pictures = [
        rasterize(gaussians, dataclasses.replace(camera, T_camera_world=away), background=background).color,
        rasterize(far, camera, background=background).color,
        rasterize(clear, camera, background=background).color,
    ]
    apart = torch.stack([(picture - background).abs().amax() for picture in pictures]) * LEVELS
    seen = (rasterize(gaussians, camera, background=background).color - background).abs().amax() > 1 / LEVELS
    return CaseVerdict(
        value=sound(apart.amax(), apart),
        threshold=0.0,
        unit="grey levels",
        reason="a picture of nobody is its background to the last bit, or a matte is dirty",
        curve=rounded(apart),
        present=bool(seen),
        frame=0,
        moment=Rollout(avatar, motion.slice(0, 1)).moment(0),
    )


def draw_followed(gaussians: Gaussians, size: tuple[int, int]) -> UInt8[np.ndarray, "h w 3"]:
    """Return a picture of somebody, wherever they are, over white; width and height in pixels."""
    sound = gaussians.means[gaussians.means.isfinite().all(-1)]
    target = sound.median(0).values if len(sound) else torch.zeros(3)
    return to_bytes(_draw(gaussians, camera_at(target, size)))


def _draw(gaussians: Gaussians, camera: Camera) -> Tensor:
    return rasterize(gaussians, camera, background=torch.ones(3)).color


def _frames_of(avatar: Avatar, motion: Motion) -> Iterator[Gaussians]:
    for frame in Rollout(avatar, motion).frames():
        yield posed(avatar, frame.motion_window, frame.output)


@torch.no_grad()
def _other_precision(avatar: Avatar, motion: Motion) -> Iterator[Gaussians]:
    """Yield the frames of a rollout whose network computes in 16-bit numbers."""
    signal = avatar.driving_signal(motion)
    session = InferenceSession(avatar.network, precision=torch.bfloat16)
    for frame in range(len(signal)):
        window, cloth = signal.windows[frame : frame + 1], signal.cloth_at(range(frame, frame + 1))
        inputs = avatar.standardize(avatar.input_maps(window, avatar.fps, cloth))
        output = session.step(*inputs)
        single = NetworkOutput(output.offset.float(), output.appearance.float(), ())
        yield posed(avatar, window, avatar.add_prior(single, cloth))


@torch.no_grad()
def _training_path(avatar: Avatar, motion: Motion) -> Iterator[Gaussians]:
    """Yield the frames as training computes them: the same sums in another order."""
    signal, state = avatar.driving_signal(motion), avatar.initial_state()
    for frame in range(len(signal)):
        window, cloth = signal.windows[frame : frame + 1], signal.cloth_at(range(frame, frame + 1))
        output, state, _ = avatar.forward_frame(window, state, cloth)
        yield posed(avatar, window, output)
