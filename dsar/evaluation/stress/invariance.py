"""Cases of what must not matter: where a body is, what comes later, its frame rate, noise of its capture."""

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.driving import DrivingSignal
from dsar.body.skinning import blend_transforms
from dsar.data.motions.files import resample
from dsar.evaluation.stress.motions import change_future, shake_joints, teleport_motion
from dsar.evaluation.stress.rollouts import (
    MILLIMETRES,
    Rollout,
    rms_distance,
    roll_offsets,
    worst_of,
)
from dsar.evaluation.stress.verdicts import CaseVerdict, rounded, sound
from dsar.types import Motion

RATES = (15.0, 60.0, 120.0)
"""Frames a second at which a motion comes."""
_NOISE_DEGREES = 1.0


def run_teleport(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """A body that appears 10 m away and turned about in mid-motion: largest change of any offset.

    The curve is the largest change frame by frame, mm.
    """
    there = Rollout(avatar, teleport_motion(motion, avatar.body.to(device="cpu"), len(motion) // 2))
    pairs = zip(Rollout(avatar, motion).offsets(), there.offsets(), strict=True)
    apart = torch.stack([(one - other).norm(dim=-1).amax() for one, other in pairs]) * MILLIMETRES
    worst = worst_of(apart)
    return CaseVerdict(
        value=sound(apart.amax(), apart),
        threshold=0.1,
        unit="mm",
        reason="a cut is taken out before the network sees it, so that only rounding is left: a tenth of "
        "what a 4K picture shows",
        curve=rounded(apart),
        frame=worst,
        moment=there.moment(worst),
    )


def run_causal(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Two futures of one past: largest difference before they part.

    The curve is the largest difference frame by frame, mm.
    """
    part = len(motion) // 2
    # One after the other, so that the second would find whatever the first left behind.
    offsets = roll_offsets(avatar, motion)
    other = Rollout(avatar, change_future(motion, part))
    pairs = zip(offsets, other.offsets(), strict=True)
    apart = torch.stack([(one - two).abs().amax() for one, two in pairs]) * MILLIMETRES
    return CaseVerdict(
        value=sound(apart[:part].amax()),
        threshold=0.0,
        unit="mm",
        reason="the same past gives the same bits, or a rollout depends on what has not happened yet, or on "
        "another rollout before it",
        curve=rounded(apart),
        present=bool(apart[part:].amax() > 0),
        frame=(worst := worst_of(apart[:part])),
        moment=other.moment(worst),
    )


def run_noise(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Poses that are 1 degree wrong, each frame otherwise: jitter of the cloth, over the body's own.

    Jitter is the root mean square third difference of the way between the noisy rollout and the sound one;
    points of the garment, or of all where there is none. The body's is that of the same points under skinning
    alone. The curve is the cloth's by frame, mm.
    """
    shaken = shake_joints(motion, _NOISE_DEGREES, torch.Generator().manual_seed(0))
    rollout = Rollout(avatar, shaken)
    points = avatar.garment_control_points()
    points = points if len(points) else torch.arange(len(avatar.control.cells), device=avatar.device)
    cloth = _posed_points(rollout, points) - _posed_points(Rollout(avatar, motion), points)
    skin = _skinned_points(avatar, shaken)[:, points] - _skinned_points(avatar, motion)[:, points]
    jitter, own = (way.diff(n=3, dim=0).square().sum(-1).mean(-1).sqrt() for way in (cloth, skin))
    gain = jitter.square().mean().sqrt() / own.square().mean().sqrt().clamp_min(1e-9)
    worst = 3 + worst_of(jitter)
    return CaseVerdict(
        value=sound(gain, cloth),
        threshold=2.0,
        unit="of the body's",
        reason="fits of bodies to video are about a degree wrong; a loose hem may shake at twice the skin's "
        "amplitude before it is seen as flicker",
        curve=rounded(jitter * MILLIMETRES),
        frame=worst,
        details={"body_mm": float(own.square().mean().sqrt()) * MILLIMETRES},
        moment=rollout.moment(worst),
    )


def run_rate(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """The same motion at 15, 60 and 120 frames a second, resampled: how much more cloth moves.

    At 15 a second every other pose is lost, and resampling puts the body itself elsewhere. So the garment's
    rms difference counts only beyond what the resampling itself costs: beyond the difference of its points
    under skinning alone, and of cloth that is simulated on both motions where the avatar has a prior (which
    the case `prior` judges). Velocities must be the same at twice the rate, or their unit is wrong. The curve
    is the whole difference at each rate, mm.
    """
    points = avatar.garment_control_points()
    points = points if len(points) else torch.arange(len(avatar.control.cells), device=avatar.device)
    exact = roll_offsets(avatar, motion)[:, points]
    apart, body, cloth, rollouts = [], [], [], []
    for rate in RATES:
        there = resample(resample(motion, rate), avatar.fps)
        rollout = Rollout(avatar, there)
        other = torch.stack(list(rollout.offsets()))[:, points]
        apart.append(rms_distance(exact[: len(other)], other))
        skins = (_skinned_points(avatar, each)[: len(other), points] for each in (motion, there))
        body.append(rms_distance(*skins))
        cloth.append(_simulated_apart(avatar, motion, there))
        rollouts.append(rollout)
    distances, moved, swung = (
        torch.stack([each.square().mean().sqrt() for each in every]) for every in (apart, body, cloth)
    )
    beyond = (distances - torch.maximum(moved, swung)).clamp_min(0)
    which = worst_of(beyond)
    worst = worst_of(apart[which])
    ratio = _velocity_ratio(avatar, motion)
    return CaseVerdict(
        value=sound(beyond.amax(), distances),
        threshold=2.0,
        unit="mm",
        reason="resampling moves the body, cloth that stays behind moves against it by as much, and cloth "
        "that is simulated by a little more: no fault of the model; two millimetres beyond it would be",
        curve=rounded(distances),
        present=0.8 < ratio < 1.25,
        frame=worst,
        details={
            "body_mm_at_15": float(moved[0]),
            "simulated_mm_at_15": float(swung[0]),
            "velocity_ratio": ratio,
        },
        moment=rollouts[which].moment(worst),
    )


def _simulated_apart(avatar: Avatar, motion: Motion, other: Motion) -> Float[Tensor, " f"]:
    """Return by how much the prior's cloth differs between two motions, mm (rms); zero without a prior."""
    one, two = (avatar.driving_signal(each).cloth for each in (motion, other))
    if one is None or two is None:
        return torch.zeros(1, device=avatar.device)
    return rms_distance(one[: len(two), :, :3], two[..., :3])


def _velocity_ratio(avatar: Avatar, motion: Motion) -> float:
    """Return the mean speed that the network sees at twice the rate, over that at the avatar's."""
    means = []
    for rate in (1, 2):
        signal = avatar.driving_signal(resample(motion, rate * motion.fps))
        frames = range(0, rate * (len(motion) - 1) + 1, rate)
        inputs = avatar.input_maps(signal.windows[list(frames)], signal.fps, signal.cloth_at(frames))
        means.append(inputs.magnitude.mean())
    return float(means[1] / means[0].clamp_min(1e-9))


def _posed_points(rollout: Rollout, points: Tensor) -> Float[Tensor, "f p 3"]:
    """Return where a rollout has some control points, relative to the pelvis, metres."""
    avatar = rollout.avatar
    return torch.stack(
        [
            avatar.deformed_control_points(frame.motion_window, frame.output)[0, points]
            - _pelvis(avatar, frame.motion_window[:, 0])
            for frame in rollout.frames()
        ]
    )


def _skinned_points(avatar: Avatar, motion: Motion) -> Float[Tensor, "f p 3"]:
    """Return where skinning alone has the control points, relative to the pelvis, metres."""
    signal = DrivingSignal.of_motion(avatar.body, motion, ())
    blended = blend_transforms(avatar.control.weights, signal.transforms)
    points = (blended[..., :3] * avatar.control.points[:, None]).sum(-1) + blended[..., 3]
    return points - _pelvis(avatar, signal.transforms)[:, None]


def _pelvis(avatar: Avatar, transforms: Float[Tensor, "f j 4 4"]) -> Float[Tensor, "f 3"]:
    return transforms[:, 0, :3, :3] @ avatar.body_joints[0] + transforms[:, 0, :3, 3]
