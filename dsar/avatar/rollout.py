"""Drive an avatar through a motion, one frame in memory at a time."""

import dataclasses
from collections.abc import Collection, Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.body.model import JOINT_NAMES
from dsar.body.skinning import forward_kinematics
from dsar.errors import MotionError
from dsar.network import STREAMS, NetworkOutput, Stream
from dsar.network.streaming import Rollout
from dsar.types import Binding, Gaussians, GaussianSequence, Motion

START_FRAME = 1001
"""Number of a motion's first frame, as film pipelines count."""


def roll_out(
    avatar: Avatar,
    motion: Motion,
    *,
    frames: Sequence[int] | None = None,
    streams: Collection[Stream] = STREAMS,
    provenance: dict[str, str] | None = None,
) -> GaussianSequence:
    """Return the avatar's posed Gaussians over a motion at the avatar's frame rate.

    Every frame up to the last requested one is computed, since each follows from the one before;
    only those in `frames` (numbers from 1001 on; None: all) are yielded. Without one of the `streams`
    the network runs as if it had none of its memory: an ablation of a network trained with it.

    Raises:
        MotionError: the rate is not the avatar's, or a requested frame lies outside the motion.
    """
    if abs(motion.fps - avatar.fps) > 1e-3:
        raise MotionError(
            f"motion {motion.name} has {motion.fps:g} fps, the avatar {avatar.fps:g}; resample it"
        )
    last = START_FRAME + len(motion) - 1
    numbers = list(frames) if frames is not None else list(range(START_FRAME, last + 1))
    outside = [n for n in numbers if not START_FRAME <= n <= last]
    if outside or not numbers:
        raise MotionError(
            f"frame {outside[0] if outside else 'range'} is outside motion {motion.name}, "
            f"which has frames {START_FRAME}-{last}"
        )
    numbers = sorted(set(numbers))
    return GaussianSequence(
        frame_numbers=numbers,
        fps=avatar.fps,
        num_gaussians=avatar.num_gaussians,
        produce=lambda: _produce(avatar, motion, {n - START_FRAME for n in numbers}, streams),
        provenance={"motion": motion.name, **(provenance or {})},
        binding=_bind(avatar, motion, numbers),
    )


def _bind(avatar: Avatar, motion: Motion, numbers: Sequence[int]) -> Binding:
    """Return how the avatar hangs on its body in some frames of a motion."""
    poses = motion.rotations.to(avatar.body_joints), motion.translations.to(avatar.body_joints)
    transforms = forward_kinematics(avatar.body, *poses)
    width = avatar.atlas_size[1]
    rows, columns = avatar.texels // width, avatar.texels % width
    # The body's chart is a square; charts of garments lie below it.
    uv = torch.stack([(columns + 0.5) / width, 1 - (rows + 0.5) / width], -1)
    # Writers work on the CPU, whatever the avatar does.
    return Binding(
        body=avatar.body.to(device="cpu"),
        joint_names=JOINT_NAMES,
        points=avatar.texel_positions.cpu(),
        weights=avatar.texel_weights.cpu(),
        uv=uv.cpu(),
        T_world_rest=transforms[[number - START_FRAME for number in numbers]].cpu(),
    )


def template_sequence(sequence: GaussianSequence, avatar: Avatar, motion: Motion) -> GaussianSequence:
    """Return the same frames of the template under skinning alone: the baseline without a network."""
    track = avatar.track(motion)

    @torch.no_grad()
    def produce() -> Iterator[Gaussians]:
        for number in sequence.frame_numbers:
            yield avatar.gaussians(track[[number - START_FRAME]], None)[0]

    return dataclasses.replace(sequence, produce=produce)


def network_outputs(
    avatar: Avatar, motion: Motion, *, streams: Collection[Stream] = STREAMS
) -> Iterator[tuple[Float[Tensor, "1 t j 4 4"], NetworkOutput]]:
    """Yield each frame's context and what the network makes of it.

    On a GPU an output lasts until the next is asked for.
    """
    track = avatar.track(motion)
    rollout = Rollout(avatar.network, streams, torch.bfloat16 if track.is_cuda else None)
    for frame in range(len(track)):
        with torch.no_grad():
            context = track[[frame]]
            output = rollout.step(*avatar.standardized(avatar.maps(context, avatar.fps)))
        yield context, output


def _produce(
    avatar: Avatar, motion: Motion, wanted: set[int], streams: Collection[Stream]
) -> Iterator[Gaussians]:
    last = max(wanted)
    for frame, (context, output) in enumerate(network_outputs(avatar, motion, streams=streams)):
        if frame in wanted:
            with torch.no_grad():
                made = avatar.gaussians(context, output)[0]
            yield made
        if frame == last:
            return
