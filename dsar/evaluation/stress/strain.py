"""Cases of poses and motions that training never had: whether anything breaks.

There is no truth for them. What breaks a picture can still be seen: cloth that is torn apart, Gaussians that
swell, points that leap from frame to frame, cloth inside the body.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.guards import LIMITS
from dsar.avatar.input_maps import REFERENCE_FPS
from dsar.dynamics.collider import BodyCollider
from dsar.evaluation.stress import poses
from dsar.evaluation.stress.motions import play_keys, scale_motion, wander_poses
from dsar.evaluation.stress.rollouts import MILLIMETRES, Rollout, control_offsets, worst_of
from dsar.evaluation.stress.verdicts import CaseVerdict, rounded, sound
from dsar.types import Motion

STRETCH = 4.0
"""Length over length at rest, of 99.9 % of the garment's edges, from which on it is torn to the eye."""
SIGMAS = (1.0, 2.0, 3.0, 4.0, 5.0)
"""Standard deviations of the motion's poses to which they wander."""
FACTORS = (0.8, 1.25)
"""Sizes of whom a motion was captured on, over the avatar's own."""
LARGE = 0.09
"""Metres, standard deviation: a Gaussian as large as a hand is a spot of fog; at 0.1 they are cut."""
DEEP = 0.01
"""Metres under the skin from which on cloth is inside the body."""
_LEAST_EDGE = 0.005
"""Metres: shorter edges at rest count as this long."""
_UNIT = "of what breaks a picture"
_REASON = (
    "1 is where 0.1 % of the garment's edges are four times as long as at rest, a point moves against the "
    "body by 12 m/s, or a Gaussian swells to the size of a hand (90 mm)"
)


@dataclass(frozen=True)
class Strain:
    """What a motion does to an avatar, by frame."""

    rollout: Rollout
    """Of the motion."""
    stretch: Float[Tensor, " f"]
    """Length of edges over that at rest, of the edge that 99.9 % do not reach."""
    leap: Float[Tensor, " f"]
    """Largest change of an offset since the frame before, metres per 1/30 s."""
    size: Float[Tensor, " f"]
    """Largest standard deviation of a Gaussian, metres."""
    inside: Float[Tensor, " f"]
    """Share of the garment's points deep inside the body; 0 without a garment."""
    offset: Float[Tensor, " f"]
    """Root mean square offset of the garment, or else of all points, metres."""

    @property
    def breakage(self) -> Float[Tensor, " f"]:
        """How near each frame is to one that looks broken, which is 1."""
        worst = torch.stack([self.stretch / STRETCH, self.leap / LIMITS.speed, self.size / LARGE])
        return torch.where(worst.isfinite().all(0), worst.amax(0), torch.inf)

    def details(self) -> dict[str, float]:
        """Return the worst of each, for a results file."""
        return {
            "stretch": float(self.stretch.amax()),
            "leap_m_per_s": float(self.leap.amax()) * REFERENCE_FPS,
            "largest_gaussian_mm": float(self.size.amax()) * MILLIMETRES,
            "inside_percent": 100 * float(self.inside.amax()),
        }


@torch.no_grad()
def measure_strain(avatar: Avatar, motion: Motion) -> Strain:
    """Return what a motion does to an avatar."""
    rollout, control = Rollout(avatar, motion), avatar.control
    points = avatar.garment_control_points()
    dressed = len(points) > 0
    points = points if dressed else torch.arange(len(control.cells), device=avatar.device)
    edges = control.edges[torch.isin(control.edges, points).all(1)]
    rest = _lengths(control.points, edges).clamp_min(_LEAST_EDGE)
    collider = _collider(avatar, points) if dressed else None
    rate, before, rows = avatar.fps / REFERENCE_FPS, None, []
    for frame in rollout.frames():
        offsets = control_offsets(avatar, frame.output)[0].clone()
        place = avatar.deformed_control_points(frame.motion_window, frame.output)[0]
        gaussians = avatar.gaussians(frame.motion_window, frame.output)[0]
        change = offsets - (offsets if before is None else before)
        deep = place.new_zeros(())
        if collider is not None:
            deep = _share_inside(collider, frame.motion_window[:, 0], place[points])
        rows.append(
            torch.stack(
                [
                    (_lengths(place, edges) / rest).quantile(0.999),
                    change.norm(dim=-1).amax() * rate,
                    gaussians.scales.amax(),
                    deep.to(place),
                    offsets[points].square().sum(-1).mean().sqrt(),
                ]
            )
        )
        before = offsets
    return Strain(rollout, *torch.stack(rows).unbind(1))


def run_ood(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Poses that wander to 1 to 5 standard deviations along the main components: how near to broken.

    The curve is the worst at each.
    """
    found = [measure_strain(avatar, wander_poses(motion, sigmas)) for sigmas in SIGMAS]
    return _judge(found, {f"offset_mm_at_{s:g}": each for s, each in zip(SIGMAS, found, strict=True)})


def run_extreme(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Kicks to the limits of joints, a backflip, a cartwheel, a pirouette: how near to broken.

    The curve is the worst of each frame.
    """
    body = avatar.body.to(device="cpu")
    return _judge([measure_strain(avatar, play_keys(motion, body, poses.EXTREME, "extreme"))], {})


def run_floor(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """A body that kneels, sits, falls, lies and rolls: how near to broken. The curve is by frame."""
    body = avatar.body.to(device="cpu")
    return _judge([measure_strain(avatar, play_keys(motion, body, poses.FLOOR, "floor"))], {})


def run_scale(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """The motion of a smaller and of a larger person: how near to broken.

    Steps and hips are 0.8 and 1.25 times what the avatar's legs make, as where a motion of another body is
    not fitted. The curve is the worst at each factor.
    """
    body = avatar.body.to(device="cpu")
    found = [measure_strain(avatar, scale_motion(motion, body, factor)) for factor in FACTORS]
    return _judge(found, {f"offset_mm_at_{f:g}": each for f, each in zip(FACTORS, found, strict=True)})


def run_shear(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Hips spread by 60 degrees, sideways, fore and aft: how long the garment's edges get, over their rest.

    Of the edge that 99.9 % do not reach. The curve is that by frame.
    """
    body = avatar.body.to(device="cpu")
    found = measure_strain(avatar, play_keys(motion, body, poses.SHEAR, "shear"))
    worst = worst_of(found.stretch)
    return CaseVerdict(
        value=sound(found.stretch.amax(), found.offset),
        threshold=STRETCH,
        unit="of the length at rest",
        reason="Gaussians of neighbours overlap fourfold at rest: stretched further, the surface has holes",
        curve=rounded(found.stretch),
        frame=worst,
        details=found.details(),
        moment=found.rollout.moment(worst),
    )


def run_contact(avatar: Avatar, motion: Motion) -> CaseVerdict:
    """Arms crossed, hands on the skirt, squat, lotus, bow: share of the garment deep inside the body.

    More than a centimetre, per cent of its control points, mean over frames; the curve is that by frame.
    """
    body = avatar.body.to(device="cpu")
    found = measure_strain(avatar, play_keys(motion, body, poses.CONTACT, "contact"))
    worst = worst_of(found.inside)
    return CaseVerdict(
        value=sound(100 * found.inside.mean(), found.offset, found.stretch),
        threshold=10.0,
        unit="% inside",
        reason="skinning alone puts the skirt of a squatting body into its thighs; where a tenth of it is "
        "inside, skin shows through in most frames",
        curve=rounded(100 * found.inside),
        frame=worst,
        details=found.details(),
        moment=found.rollout.moment(worst),
    )


def _judge(found: Sequence[Strain], sizes: dict[str, Strain]) -> CaseVerdict:
    """Return the verdict on what several motions, or one, have done."""
    peaks = torch.stack([each.breakage.amax() for each in found])
    which = worst_of(peaks)
    worst = worst_of(found[which].breakage)
    return CaseVerdict(
        value=sound(peaks.amax(), *(each.offset for each in found)),
        threshold=1.0,
        unit=_UNIT,
        reason=_REASON,
        curve=rounded(peaks if len(found) > 1 else found[0].breakage),
        frame=worst,
        details=found[which].details()
        | {name: float(each.offset.amax()) * MILLIMETRES for name, each in sizes.items()},
        moment=found[which].rollout.moment(worst),
    )


def _lengths(points: Float[Tensor, "p 3"], edges: Tensor) -> Float[Tensor, " e"]:
    return (points[edges[:, 0]] - points[edges[:, 1]]).norm(dim=-1)


def _collider(avatar: Avatar, points: Tensor) -> BodyCollider:
    heights = avatar.control.points[points, 1]
    return BodyCollider(avatar.body.to(device="cpu"), float(heights.max()), float(heights.min()))


def _share_inside(
    collider: BodyCollider, transforms: Float[Tensor, "1 j 4 4"], points: Float[Tensor, "g 3"]
) -> Float[Tensor, ""]:
    body, normals = (each[0] for each in collider.pose(transforms.cpu()))
    nearest = torch.cdist(points.cpu(), body).argmin(1)
    depth = ((points.cpu() - body[nearest]) * normals[nearest]).sum(-1)
    return (depth < -DEEP).float().mean()
