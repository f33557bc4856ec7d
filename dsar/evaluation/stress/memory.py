"""Cases of what a rollout remembers: for how long, of what, and whether it forgets what is wrong."""

from collections import deque

import torch
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.evaluation.looping import loop_motion
from dsar.evaluation.stress.motions import fastest_gap, fill_gap, spin_and_stop, sway_motion
from dsar.evaluation.stress.rollouts import (
    MILLIMETRES,
    Rollout,
    around,
    control_offsets,
    draw_noise,
    posed,
    rms_distance,
    roll_offsets,
    seconds_apart,
    worst_of,
)
from dsar.evaluation.stress.verdicts import CaseVerdict, Moment, rounded, sound
from dsar.types import Motion

NOISE = 0.02
"""Metres, rms, by which a twin's previous offsets are wrong."""
_MOVING_SHARE = 0.05
"""Share of its speed in the spin that cloth must keep a fifth of a second after the stop."""
_SEEN = 1.0
"""Distance, mm, at a stop below which there is nothing to come to rest from."""
GAPS = (1, 2, 5, 10)
"""Frames in a row that are missing."""
SECOND_RUN = 10.0
"""Millimetres, rms, by which two true runs of a motion may differ: cloth that starts otherwise folds so."""


def run_long(avatar: Avatar, motion: Motion, frames: int = 10_000) -> CaseVerdict:
    """A motion repeated for `frames` frames: change of the mean offset per 1000 frames, over its mean.

    Its slope is that of a line through the means of rounds; the curve is these means, mm.
    """
    _, period = loop_motion(motion, 1)
    rounds = max(3, -(-frames // period))
    rollout = Rollout(avatar, loop_motion(motion, rounds)[0])
    sizes = torch.stack([offset.norm(dim=-1).mean() for offset in rollout.offsets()])
    means = sizes.reshape(rounds, period).mean(1).double()
    centred = torch.arange(rounds, device=means.device) - (rounds - 1) / 2
    slope = (centred * means).sum() / centred.square().sum() * (1000 / period) / means.mean().clamp_min(1e-9)
    worst = worst_of(sizes)
    return CaseVerdict(
        value=sound(slope.abs()),
        threshold=0.01,
        unit="per 1000 frames",
        reason="an hour of 108,000 frames then moves the mean offset by no more than itself",
        curve=rounded(means * MILLIMETRES),
        frame=worst,
        moment=rollout.moment(worst),
    )


def run_cycle(avatar: Avatar, motion: Motion, cycles: int = 100) -> CaseVerdict:
    """A pose that turns to and fro: rms difference of a cycle from the one before it, median from the 5th on.

    The curve is that difference, cycle by cycle, mm.
    """
    sway, period = sway_motion(motion, cycles)
    rollout = Rollout(avatar, sway)
    last: deque[Tensor] = deque(maxlen=period)
    distances = []
    for offset in rollout.offsets():
        if len(last) == period:
            distances.append(rms_distance(offset, last[0]))
        last.append(offset)
    every = torch.stack(distances)
    apart = every.reshape(cycles - 1, period).square().mean(1).sqrt()
    worst = period + worst_of(every)
    return CaseVerdict(
        value=sound(apart[4:].median()),
        threshold=0.5,
        unit="mm",
        reason="half a pixel of a person who fills the height of a 4K picture; a loop of film shows no seam",
        curve=rounded(apart),
        frame=worst,
        moment=rollout.moment(worst),
    )


@torch.no_grad()
def run_twin(avatar: Avatar, motion: Motion, start: int = 30) -> CaseVerdict:
    """Two rollouts, one of which is put wrong at a frame: seconds until they are 1 mm (rms) apart for good.

    It is given a bank of noise and offsets that are 2 cm (rms) wrong. The curve is their distance, mm, from
    there on.
    """
    long, _ = loop_motion(motion, 3)
    signal, generator = avatar.driving_signal(long), torch.Generator().manual_seed(0)
    state, apart, pictures = avatar.initial_state(2), [], {}
    for frame in range(len(signal)):
        if frame == start:
            state = state.map(torch.clone)
            memory, offsets = state.memory[1], state.offsets[1]
            memory.copy_(draw_noise(memory, generator) * memory.square().mean().sqrt())
            offsets.add_(NOISE * draw_noise(offsets, generator))
        window = signal.windows[frame : frame + 1]
        cloth = signal.cloth_at([frame, frame])
        output, state, _ = avatar.forward_frame(window.expand(2, -1, -1, -1, -1), state, cloth)
        if frame >= start:
            apart.append(rms_distance(*control_offsets(avatar, output)))
        if frame in around(start, len(signal)):
            pictures[frame] = posed(avatar, window, output.select(torch.tensor([1], device=avatar.device)))
    distances = torch.stack(apart)
    return CaseVerdict(
        value=sound(seconds_apart(distances, 1.0, avatar.fps), distances),
        threshold=3.0,
        unit="s",
        reason="a skirt swings out in one to two seconds; a wrong state that lives longer is no inertia",
        curve=rounded(distances),
        frame=start + worst_of(distances),
        moment=Moment(tuple(pictures), tuple(pictures.values())),
    )


def run_cold(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """A rollout that starts in mid-motion: seconds until it is near the one from the beginning for good.

    It starts at a quarter, a half and three quarters of the motion, as a shot or a farm's job may. Near is as
    two true runs of a motion are (`SECOND_RUN`). The curve is the largest distance of the three by frame
    after the start, mm.
    """
    long, period = loop_motion(motion, 3)
    whole = roll_offsets(avatar, long)
    length = len(long) - period
    starts = [quarter * len(motion) // 4 for quarter in (1, 2, 3)]
    rollouts = [Rollout(avatar, long.slice(start, start + length)) for start in starts]
    apart = torch.stack(
        [
            rms_distance(torch.stack(list(rollout.offsets())), whole[start : start + length])
            for start, rollout in zip(starts, rollouts, strict=True)
        ]
    )
    burn_in = torch.stack([seconds_apart(each, SECOND_RUN, avatar.fps) for each in apart])
    which = worst_of(burn_in)
    worst = worst_of(apart[which])
    exactly = max(float(seconds_apart(each, 1.0, avatar.fps)) for each in apart)
    return CaseVerdict(
        value=sound(burn_in.amax(), apart),
        threshold=3.0,
        unit="s",
        reason="a shot has no more than three seconds of handles before its first frame; then cloth must "
        "be as near as a second true run of the same motion is (9 mm on the demo's spin)",
        curve=rounded(apart.amax(0)),
        frame=worst,
        details={"seconds_to_1_mm": exactly},
        moment=rollouts[which].moment(worst),
    )


def run_gap(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """1 to 10 frames that are missing and filled in between: rms difference as many frames after them.

    Each gap is where the body is fastest, but does not turn so far that nobody could say which way round. The
    curve is the distance for the longest gap, frame by frame, mm.
    """
    whole = roll_offsets(avatar, motion)
    after, curve, moment = {}, whole.new_zeros(1), None
    for gap in GAPS:
        start = fastest_gap(motion, gap)
        rollout = Rollout(avatar, fill_gap(motion, start, gap))
        curve = rms_distance(torch.stack(list(rollout.offsets())), whole)
        after[gap] = curve[min(start + 2 * gap - 1, len(motion) - 1)]
        moment = rollout.moment(worst_of(curve)) if gap == GAPS[-1] else None
    return CaseVerdict(
        value=sound(torch.stack(list(after.values())).amax(), curve),
        threshold=SECOND_RUN,
        unit="mm",
        reason="as long after a gap as it was long, cloth must be as near as a second true run of the same "
        "motion is (9 mm on the demo's spin)",
        curve=rounded(curve),
        frame=worst_of(curve),
        details={f"mm_after_{gap}": float(each) for gap, each in after.items()},
        moment=moment,
    )


def run_stop(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """A spin that stops at once: rms distance from where the cloth ends up, 3 seconds later over at the stop.

    After a fifth of a second it must still move at 5 % of its mean speed in the spin, or memory is not
    at work. The curve is the distance from the end, frame by frame from the stop on, mm.
    """
    spin, stop = spin_and_stop(motion)
    rollout = Rollout(avatar, spin)
    offsets = torch.stack(list(rollout.offsets()))
    speeds = rms_distance(offsets[1:], offsets[:-1])
    residual = rms_distance(offsets[stop:], offsets[-1:].expand_as(offsets[stop:]))
    present = bool(speeds[stop + round(0.2 * avatar.fps)] > _MOVING_SHARE * speeds[:stop].mean())
    late = residual[round(3 * avatar.fps) :]
    worst = stop + round(3 * avatar.fps) + worst_of(late)
    return CaseVerdict(
        value=sound(late.amax() / residual[0].clamp_min(_SEEN), offsets),
        threshold=0.15,
        unit="of the distance at the stop",
        reason="cloth comes to rest, in its own time: of two simulations of the demo's true skirt after this "
        "spin one keeps 5 % of its distance for three seconds, the other 14 %",
        curve=rounded(residual),
        present=present,
        frame=worst,
        moment=rollout.moment(worst),
    )
