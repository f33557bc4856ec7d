"""What an evaluation measures of a run; the fields are the keys of `dsar eval --json`.

Images are display-referred sRGB in [0, 1] over white. None: not measured, with the reason in `skipped`.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class ViewMetrics:
    """One predicted view against the truth."""

    frame: int
    """Of the sequence, from 0."""
    camera: int
    """Index in the capture."""
    psnr: float
    """dB."""
    psnr_box: float
    """dB, in the bounding box of the true mask."""
    psnr_box_template: float
    """dB, of the template with skinning alone, in the same box."""
    ssim: float
    psnr_garment: float | None = None
    """dB, where the garment is visible in truth."""
    psnr_uncovered: float | None = None
    """dB, where the body is visible in truth and a garment at rest would hide it."""
    lpips: float | None = None
    lpips_vgg: float | None = None
    flip: float | None = None
    tpsnr: float | None = None
    """dB, of the change since the frame before."""
    tlpips: float | None = None
    """How much more, or less, a frame differs from the one before than it does in truth."""
    warp_error: float | None = None
    """Mean squared difference from the frame before, moved as the Gaussians moved."""


@dataclass(frozen=True)
class VideoMetrics:
    """The videos of a split against the true ones."""

    vmaf: float | None = None
    """0 to about 100."""
    frechet_slices: float | None = None
    fvd: float | None = None


@dataclass(frozen=True)
class SplitMetrics:
    """Means over all views of a split that have a figure (`ViewMetrics` says their units)."""

    psnr: float | None
    psnr_box: float | None
    psnr_box_template: float | None
    psnr_garment: float | None
    psnr_uncovered: float | None
    ssim: float | None
    lpips: float | None
    lpips_vgg: float | None
    flip: float | None
    tpsnr: float | None
    tlpips: float | None
    warp_error: float | None
    mmd: float | None
    """Maximum mean discrepancy of the split's poses from those of training."""
    frames: int
    """How many frames were looked at."""
    views: int
    """Cameras of the capture."""
    vmaf: float | None = None
    frechet_slices: float | None = None
    fvd: float | None = None


@dataclass(frozen=True)
class OneToManyFigures:
    """Predicted against true difference of images at one pose with two pasts."""

    correlation: float
    ratio: float
    """Size of the predicted difference by the true one's."""


@dataclass(frozen=True)
class GarmentFigures:
    """A garment's shape against the simulated truth."""

    chamfer: float
    """Metres, mean of both directions."""
    fscore: float
    """At two centimetres."""
    hem_radius: float
    """Metres, root mean square error over frames."""
    hem_height: float
    """Metres, root mean square error over frames."""
    jitter: float
    """Mean jerk of the points, m/s³."""


@dataclass(frozen=True)
class StopFigures:
    """What the garment does after the body has stopped, over what the skin carries."""

    frame: int
    """The first of the pose that is held."""
    seconds: float
    """For which it is held: a garment that has not settled by then has this as its time."""
    settle: float
    """Seconds until the garment stays slower than a fifth of the true speed at the stop."""
    settle_true: float
    overshoot: float
    """Millimetres (rms) by which the garment swings past its final rest, the way the true one moved at the
    stop."""
    overshoot_true: float


@dataclass(frozen=True)
class UnseenMotion:
    """The garment's points on a motion that nobody trained on: root mean square distances from the truth."""

    mm: float
    """Millimetres, over all frames and all points that the body does not hold."""
    mm_template: float
    """Millimetres, of the template under skinning alone."""
    mm_second: float | None
    """Millimetres, of another true run of the same motion; None where there is none."""
    frames: int
    """Of the motion."""
    stops: Sequence[StopFigures]
    """In order."""


@dataclass(frozen=True)
class UnseenFigures:
    """The unseen motions of a split."""

    motions: Mapping[str, UnseenMotion]
    mm: float
    """Mean over motions, as the next two."""
    mm_template: float
    mm_second: float | None
    """Of the motions that have one; None where none has."""
    ratio: float
    """The mean of `mm` by the mean of `mm_template`."""
    ratio_ci: tuple[float, float]
    """Its 95 % interval by bootstrap over motions."""


@dataclass(frozen=True)
class FrameTimes:
    """Milliseconds a frame by stage: the network's parts, posing, rasterisation of one camera."""

    ms: Mapping[str, float]
    """Medians."""
    ms_p95: Mapping[str, float]
    """What 95 of 100 frames stay below."""

    @property
    def fps(self) -> float:
        """Frames per second of all stages together."""
        return 1e3 / sum(self.ms.values())


@dataclass(frozen=True)
class WorstView:
    """A view with a low PSNR in the mask's box."""

    sequence: str
    frame: int
    camera: int
    psnr_box: float
    """dB."""


@dataclass(frozen=True)
class HeldoutFigures:
    """All figures of a run."""

    splits: Mapping[str, SplitMetrics | None]
    """`train`, `test`, `nd`, `fd`; None where the capture has no such sequence."""
    fps: float
    """Frames per second, of one camera."""
    ms: Mapping[str, float]
    """Median milliseconds by stage."""
    ms_p95: Mapping[str, float]
    gaussians: int
    parameters: int
    """Of the network."""
    one_to_many: OneToManyFigures | None
    garment: Mapping[str, Mapping[str, GarmentFigures] | None]
    """By test sequence: of the prediction, the template, another simulation and the truth itself."""
    borrowed: float | None
    """Share of the body's texels beneath garments that training never saw without one, and that look as the
    nearest that it saw; None where no garment covers any."""
    unseen: Mapping[str, UnseenFigures] | None
    """Motions that nobody trained on: `validation`, on which choices are made, and `test`, which is only
    reported; None where they cannot be measured."""
    worst: Sequence[WorstView]
    skipped: Mapping[str, str]
    """Why metrics were not measured."""

    def to_json(self) -> dict[str, Any]:
        """Return all figures in JSON's types."""
        return dataclasses.asdict(self)
