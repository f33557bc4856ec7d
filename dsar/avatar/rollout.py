"""Drive an avatar through a motion, one frame in memory at a time."""

import dataclasses
from collections.abc import Collection, Iterator, Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.resampling import Moment, blend_residuals, keep_residuals, place_frames, pose_frames
from dsar.body.model import JOINT_NAMES
from dsar.errors import MotionError
from dsar.geometry.paths import START_FRAME
from dsar.geometry.rates import same_rate
from dsar.network import STREAMS, NetworkOutput, Stream
from dsar.network.streaming import Rollout
from dsar.types import Binding, Gaussians, GaussianSequence, Motion


def roll_out(
    avatar: Avatar,
    motion: Motion,
    *,
    delivered: Motion | None = None,
    frames: Sequence[int] | None = None,
    streams: Collection[Stream] = STREAMS,
    provenance: dict[str, str] | None = None,
) -> GaussianSequence:
    """Return the avatar's posed Gaussians over a motion, which is at the avatar's frame rate.

    Every frame up to the last requested one is computed, since each follows from the one before;
    only those in `frames` (numbers from 1001 on; None: all) are yielded. Without one of the `streams`
    the network runs as if it had none of its memory: an ablation of a network trained with it.

    Args:
        avatar: Who moves.
        motion: What the network sees.
        delivered: The same motion at the rate of the frames that are wanted (`dsar.data.motion.resample`);
            None: the avatar's. Frames that lie at a time of the rollout's own are those; see
            `dsar.avatar.resampling` for the others.
        frames: Which of the delivered frames.
        streams: The network's memories.
        provenance: Written into every file.

    Raises:
        MotionError: the motion's rate is not the avatar's, the delivery is longer, or a requested frame lies
            outside.
    """
    if not same_rate(motion.fps, avatar.fps):
        raise MotionError(
            f"motion {motion.name} has {motion.fps:g} fps, the avatar {avatar.fps:g}; resample it"
        )
    delivered = motion if delivered is None else delivered
    last = START_FRAME + len(delivered) - 1
    numbers = list(frames) if frames is not None else list(range(START_FRAME, last + 1))
    outside = [n for n in numbers if not START_FRAME <= n <= last]
    if outside or not numbers:
        raise MotionError(
            f"frame {outside[0] if outside else 'range'} is outside motion {motion.name}, "
            f"which has frames {START_FRAME}-{last} at {delivered.fps:g} a second"
        )
    numbers = sorted(set(numbers))
    wanted = [number - START_FRAME for number in numbers]
    moments = place_frames(avatar.body, motion, delivered)
    poses = pose_frames(avatar.body, motion, delivered, moments)[wanted]
    moments = [moments[frame] for frame in wanted]
    return GaussianSequence(
        frame_numbers=numbers,
        fps=avatar.fps if same_rate(delivered.fps, avatar.fps) else delivered.fps,
        num_gaussians=avatar.num_gaussians,
        produce=lambda: _produce(avatar, motion, moments, poses, streams),
        provenance={"motion": motion.name, **(provenance or {})},
        binding=_bind(avatar, poses),
    )


def _bind(avatar: Avatar, poses: Float[Tensor, "f j 4 4"]) -> Binding:
    """Return how the avatar hangs on its body where that carries it (T_world_rest of its joints)."""
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
        T_world_rest=poses.cpu(),
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
    avatar: Avatar,
    motion: Motion,
    moments: Sequence[Moment],
    poses: Float[Tensor, "f j 4 4"],
    streams: Collection[Stream],
) -> Iterator[Gaussians]:
    """Yield the Gaussians at ascending moments of a rollout; `poses` are those of the body at each."""
    steps = network_outputs(avatar, motion, streams=streams)
    step, before, (context, output) = 0, None, next(steps)
    for moment, pose in zip(moments, poses, strict=True):
        while step < moment.step + (moment.share > 0):
            before = keep_residuals(output)
            # After the last step its residuals stay.
            step, (context, output) = step + 1, next(steps, (context, output))
        with torch.no_grad():
            if before is None or moment.share == 0:
                made = avatar.gaussians(context, output)[0]
            else:
                made = avatar.gaussians(pose[None, None], blend_residuals(before, output, moment.share))[0]
        yield made
