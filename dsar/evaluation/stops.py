"""What a garment does after its wearer has stopped: how long it moves on, how far it swings past its rest.

Both are of the garment's own movement, over what the skin carries, so that a sway of the body is none of it.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.rest_frames import peak_joint_speed
from dsar.evaluation.results import StopFigures
from dsar.evaluation.settling import rms_speeds, settling_time
from dsar.types import Body

MOVING, STILL = 0.6, 0.25
"""Mean speeds of the joints, m/s: who was faster than the one and is slower than the other has stopped."""
HOLD = 1.0
"""Seconds that a body must stay still for its garment's way to rest to be seen."""
SLOW = 0.2
"""Share of the true speed at the stop below which the garment has settled."""
_AT_REST = 0.2
"""Seconds at a stretch's end over which the final rest is averaged."""
_STIRRED = 0.1
"""Speed of the true garment at a stop, m/s (rms), below which there is nothing to settle."""
_MILLIMETRES = 1000.0


def find_stops(body: Body, transforms: Float[Tensor, "f j 4 4"], fps: float) -> list[range]:
    """Return the stretches in which a body stands after it has moved.

    Each begins with the first frame of the pose that is held, and ends with the last.

    Args:
        body: Who moves.
        transforms: T_world_rest by frame and joint.
        fps: Frames a second.
    """
    joints = (transforms[..., :3, :3] @ body.joints[:, :, None]).squeeze(-1) + transforms[..., :3, 3]
    speeds, peaks = joints.diff(dim=0).norm(dim=-1).mean(-1) * fps, peak_joint_speed(joints, fps)
    still = torch.cat([speeds < STILL, torch.tensor([False])])
    stops, start = [], None
    for frame, stands in enumerate(still.tolist()):
        if stands and start is None:
            start = frame
        elif not stands and start is not None:
            if peaks[start] > MOVING and frame - start >= HOLD * fps:
                stops.append(range(start, frame + 1))
            start = None
    return stops


def measure_stop(
    stop: range, predicted: Float[Tensor, "f v 3"], true: Float[Tensor, "f v 3"], fps: float
) -> StopFigures | None:
    """Return the figures of a stop; None where the true garment hardly moves.

    Args:
        stop: Its stretch (`find_stops`).
        predicted: Points of the garment relative to where skinning alone carries them, metres.
        true: The same of the truth.
        fps: Frames a second.
    """
    start, end = stop.start, stop.stop - 1
    speeds, true_speeds = rms_speeds(predicted, fps), rms_speeds(true, fps)
    if true_speeds[start] < _STIRRED:
        return None
    slow = SLOW * float(true_speeds[start])
    onward = true[start + 1] - true[start]
    return StopFigures(
        frame=start,
        seconds=(end - start) / fps,
        settle=settling_time(speeds, start, end, slow, fps),
        settle_true=settling_time(true_speeds, start, end, slow, fps),
        overshoot=_overshoot(predicted[start : stop.stop], onward, fps),
        overshoot_true=_overshoot(true[start : stop.stop], onward, fps),
    )


def _overshoot(points: Float[Tensor, "s v 3"], onward: Float[Tensor, "v 3"], fps: float) -> float:
    """Return how far points go past where they end, mm (rms), in the direction in which the truth moved."""
    final = points[-max(1, round(_AT_REST * fps)) :].mean(0)
    along = ((points - final) * (onward / onward.norm())).sum((-2, -1)) / len(onward) ** 0.5
    return float(along.amax().clamp_min(0)) * _MILLIMETRES
