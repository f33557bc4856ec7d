"""The case of the motion prior: whether the simulation that the default stands on comes to rest."""

import torch

from dsar.avatar.avatar import Avatar
from dsar.evaluation.stress import poses
from dsar.evaluation.stress.motions import play_keys, spin_and_stop
from dsar.evaluation.stress.rollouts import MILLIMETRES, Rollout, rms_distance
from dsar.evaluation.stress.verdicts import CaseVerdict, rounded, sound
from dsar.types import Motion

REST_SECONDS = 6.0
"""Time that the body stands at the end of each motion."""
_REASON = (
    "three seconds after a body stands, simulated cloth hangs as it will: a prior that swings on, or that "
    "crumples, would drag the network with it; five millimetres are within what the network mends"
)


def run_prior(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """The prior alone after a spin, a fall and acrobatics: rms way from where it ends up, 3 s later.

    An avatar without a prior passes with 0. The curve is the way from the end after the spin, mm.
    """
    if avatar.prior is None:
        return CaseVerdict(0.0, 5.0, "mm", _REASON, curve=(0.0,))
    body = avatar.body.to(device="cpu")
    still = poses.Key(1.0, hold=REST_SECONDS)
    motions = {
        "spin": spin_and_stop(motion, rest=REST_SECONDS)[0],
        "floor": play_keys(motion, body, (*poses.FLOOR, still), "floor"),
        "extreme": play_keys(motion, body, (*poses.EXTREME, still), "extreme"),
    }
    late, largest, curve = {}, {}, torch.zeros(1)
    resting = round(REST_SECONDS * avatar.fps)
    for name, each in motions.items():
        cloth = avatar.driving_signal(each).cloth
        assert cloth is not None
        ways = cloth[-resting:, :, :3]
        residual = rms_distance(ways, ways[-1:].expand_as(ways))
        late[name] = residual[round(3 * avatar.fps) :].amax()
        largest[name] = cloth[..., :3].norm(dim=-1).amax()
        curve = residual if name == "spin" else curve
    name = max(late, key=lambda key: float(late[key]))
    worst = len(motions[name]) - resting + round(3 * avatar.fps)
    return CaseVerdict(
        value=sound(torch.stack(list(late.values())).amax(), *largest.values()),
        threshold=5.0,
        unit="mm",
        reason=_REASON,
        curve=rounded(curve),
        frame=worst,
        details={f"mm_after_{key}": float(value) for key, value in late.items()}
        | {f"largest_mm_in_{key}": float(value) * MILLIMETRES for key, value in largest.items()},
        moment=Rollout(avatar, motions[name]).moment(worst),
    )
