"""Every setting of a run: its meaning, its unit and its default.

A run's config.json is exactly a `TrainConfig`. Settings marked *extension* have no counterpart in the paper.
"""

from dataclasses import dataclass, field
from typing import Literal

from dsar.errors import ConfigError

EMBEDDED = "embedded"
EMBEDDED_CAPTURES = {EMBEDDED: "embedded", "embedded-wool": "embedded_wool"}
"""Names that stand for the captures that come with the package, and their folders in dsar/data."""
PRESET_NAMES = ("demo", "small", "paper")


@dataclass(frozen=True)
class AtlasConfig:
    """The grid of texels, one Gaussian each."""

    resolution: int = 96
    """Side of the body's UV square in texels."""
    garment: Literal["auto", "off"] = "auto"
    """`auto` adds a chart fitted to the visual hull where cloth stands off the body (extension)."""
    garment_rows: int = 32
    """Height of the garment chart in texels; its width is `resolution`."""
    weight_smoothing: float = 0.12
    """Standard deviation in metres of the kernel that smooths the garment chart's skin weights."""


@dataclass(frozen=True)
class ModelConfig:
    """The network."""

    wiring: Literal["shared", "late", "perframe"] = "perframe"
    """`shared` feeds the previous offset to every frame of the window (the paper: n encodings a step);
    `perframe` gives each frame the offset that preceded it (one encoding a step); `late` encodes poses by
    themselves (one a step) and adds features of the previous offset to every frame's."""
    axes: Literal["body", "surface"] = "surface"
    """Axes of offsets, velocities and accelerations: `body` is canonical and heading axes (the paper);
    `surface` is each texel's own side, up and normal, so that a flare is the same number all around."""
    window: int = 5
    """Frames n that the network sees, the current one included."""
    memory: int = 6
    """Hidden states m in the memory bank; 0 removes the state stream."""
    bank: Literal["hidden", "features"] = "hidden"
    """What the memory bank keeps of a frame: its hidden state h, or its deepest features before any attention
    (with `memory` 1: the paper's direct attention to the previous frame)."""
    feedback: int = 1
    """Previous offsets fed back (the geometric stream; the paper: 1, in ablations 3 and 5); 0 removes it."""
    causal: bool = True
    """Frames of the window attend to no later frame. It matters for the readout `mean` only."""
    readout: Literal["last", "mean"] = "last"
    """What the window's attention hands on: the newest frame's row (the paper), or the mean of all rows."""
    velocity: bool = True
    """Feed velocity maps."""
    acceleration: bool = True
    """Feed acceleration maps (extension; it nearly halves the error of driven cloth)."""
    mean_time_constants: tuple[float, ...] = ()
    """Time constants, seconds, of running means of the motion (such as 0.1 0.2 0.4); for each, the
    displacement from the newest position to the mean is an input map (extension): a memory that nothing has
    to learn. Beside a motion prior it only teaches a few motions by heart."""
    prior: Literal["cloth", "none"] = "cloth"
    """`cloth`: a coarse simulation of each loose garment, driven by the same motion, is an input map and the
    base of the offset (extension); `none`: the paper's. Without a loose garment there is none."""
    pose_components: int = 0
    """New poses are projected onto so many principal components of the training poses, and kept within two
    standard deviations of each (Li et al. 2024); 0: they are taken as they are."""
    motion_embedding: bool = True
    """Add the embedding of the motion magnitude to the deepest features."""
    channels: tuple[int, ...] = (16, 32, 64)
    """Encoder channels, finest level first; every further level halves the resolution."""
    heads: int = 4
    """Attention heads of both attentions."""
    upsample: int = 8
    """Atlas texels per pixel of the network's maps, each way (1: the paper's)."""
    pixel_shuffle: int = 1
    """Pixels of its maps per cell of the network's finest level, each way (1: the paper's): with 2, a quarter
    of the work."""
    bases: int = 0
    """Fixed maps that the output is a mixture of, instead of the decoder's convolutions; 0: the decoder."""
    uv_feature_channels: int = 8
    """Channels of learned UV features, a static map that tells pixels apart (extension)."""
    memory_weight: float = 0.5
    """Initial lambda: the weight of the memory in the hidden state."""
    offset_scale: float = 0.3
    """Metres of offset for a unit output."""
    appearance_scale: float = 0.1
    """Factor on the residuals of rotation, scale, opacity and colour: below 1 the geometry learns first,
    before colours can settle for a blur (1: the paper's)."""
    offset_limit: float = 0.5
    """Metres beyond which a loose tanh holds the offset."""
    sh_degree: int = 0
    """Degree of the spherical harmonics, 0-3."""

    @property
    def map_channels(self) -> int:
        """Channels of a frame's input maps without the offsets that are fed back."""
        motion = 3 + 3 * self.velocity + 3 * self.acceleration + 3 * len(self.mean_time_constants)
        return motion + 6 * (self.prior == "cloth")

    @property
    def appearance_channels(self) -> int:
        """Channels of the residuals besides the offset: quaternion, log-scale, logit, harmonics."""
        return 4 + 3 + 1 + 3 * (self.sh_degree + 1) ** 2


@dataclass(frozen=True)
class LossConfig:
    """Weights of the losses; image losses are means over pixels, temporal ones means over elements."""

    l1: float = 1.0
    """Absolute colour difference, averaged over a pyramid of `pyramid` levels."""
    pyramid: int = 4
    """Levels of the L1 pyramid; 1 is plain L1."""
    ssim: float = 0.1
    """1 - SSIM."""
    lpips: float = 0.0
    """LPIPS (needs its weights: tools/fetch_lpips.py)."""
    alpha: float = 0.6
    """Absolute difference of alpha and mask (extension)."""
    spatial: float = 0.0003
    """Squared difference of the offsets, in cm, of neighbours on the surface (extension): colours repeat
    in a print, so they alone pair cloth with the wrong place; cloth moves together."""
    shape: float = 0.001
    """The same of the template's own shape: how far neighbouring texels part from the garment's chart."""
    registered: float = 0.04
    """Distance in cm to the registered maps while images are compared (extension)."""
    residual: float = 0.03
    """Squared way, in cm, of the garments from their motion prior, beside each cm from the registered maps
    (extension): what a few training motions would have the network add fits no others."""
    feature: float = 0.01
    """L_feat, with the paper's gamma 0.1 at every level."""
    prediction: float = 0.1
    """L_pred, offsets in centimetres."""
    smoothness: float = 0.05
    """L_sm, accelerations in cm per frame squared."""
    temporal_scale: float = 0.001
    """Common factor of the three temporal losses, whose unit the paper does not give."""
    tau: float = 0.3
    """tau_reg in m/s: the motion magnitude V at which the temporal weight has fallen to 1/e."""
    adaptive: bool = True
    """Weigh prediction and smoothness by exp(-V / tau_reg); off: by 1."""
    magnitude: Literal["window", "frame"] = "window"
    """V of that weight: the newest frame's (the paper), or the largest in the window: at a stop V falls to
    zero at once, exactly when the cloth swings most."""
    reduction: Literal["mean", "sum"] = "mean"
    """Temporal losses over elements. The paper writes sums: over millions of features they drown images."""


@dataclass(frozen=True)
class ScheduleConfig:
    """The three stages and the optimiser."""

    steps: int = 1500
    """Updates in all."""
    minutes: float | None = None
    """Limit on the time of training, counted from the end of the first update (which compiles kernels on a
    new machine). A machine that is fast enough does the same `steps` as without it; where it is too slow the
    schedule is compressed to fit, and the run says that it was cut short."""
    template_fraction: float = 0.12
    """Fraction of the updates that fit the template alone, on near-rest frames."""
    pretraining_fraction: float = 0.2
    """Fraction of the updates that train the network on registered maps, without images; 0: no registration
    (the paper's). Registration itself takes no updates, but its time counts."""
    pose_only_fraction: float = 0.0
    """Fraction that trains the network without feedback and memory (the paper's stage 1)."""
    half_resolution_fraction: float = 0.85
    """Fraction trained on images of half the size; the template is fitted to whole ones."""
    rollouts_per_worker: int = 64
    """Rollouts that one worker steps together, its batch."""
    views: int = 1
    """Cameras rendered per rollout and rendered frame."""
    rendered_fraction: float = 0.5
    """Fraction of the frames, drawn by chance, that are rendered and compared; the network sees all."""
    chunk_frames: int = 1
    """Frames K of truncated back-propagation through time (the paper gives none; its preset: 4). At equal
    time many rollouts of one frame teach more than few of several: the state carries on over whole clips."""
    mirrored_fraction: float = 0.5
    """Fraction of the rollouts that see the mirrored motion (extension): the network learns from twice the
    motions; body and cloth must be cut symmetrically, their appearance need not be symmetric."""
    max_rollout_frames: int = 0
    """Frames after which a rollout restarts when feedback begins; it doubles until clips are whole.
    0: whole clips from the start (a rollout that starts cold in mid-motion teaches the wrong thing)."""
    learning_rate: float = 2e-3
    """Peak rate of Adam for the network; cosine to 2 % of it."""
    muon_rate: float = 0.01
    """Peak rate of Muon for the network's hidden convolutions, same cosine; 0: Adam trains them too (the
    paper's)."""
    warmup: float = 0.03
    """Fraction of the network's training in which its rates rise from zero."""
    template_rate: float = 0.02
    """Factor on the template's rates once the network trains."""
    finetuning_factor: float = 0.75
    """Factor on the network's rates after pre-training."""
    max_gradient_norm: float = 1.0
    """Largest norm of the network's gradient."""
    recomputation: Literal["auto", "on", "off"] = "auto"
    """`on`: the network's activations are computed again on the way back instead of kept till then
    (extension): a third more arithmetic, the same gradients, one frame's activations in memory instead of
    those of `chunk_frames`; `auto`: where these would not fit."""


@dataclass(frozen=True)
class TrainConfig:
    """A whole run."""

    capture: str = EMBEDDED
    """A capture folder, absolute once a run began, `embedded` or `embedded-wool`."""
    body: str | None = None
    """An SMPL-X model file, likewise; none: the capture's own, else the embedded body."""
    preset: str = "demo"
    """The preset that the other values started from."""
    train_frames: str | None = None
    """Frame range of each training sequence, e.g. 0-239; none: all."""
    test_frames: str | None = None
    """Frame range of each test sequence; none: all."""
    cameras: int | None = None
    """Cameras to learn from, spread as far as can be; none: all."""
    seed: int = 0
    """Seed of initialisation and sampling."""
    workers: int = 2
    """Processes that train together, one core each."""
    atlas: AtlasConfig = field(default_factory=AtlasConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    schedule: ScheduleConfig = field(default_factory=ScheduleConfig)

    def validate(self) -> None:
        """Raise ConfigError where settings contradict each other."""
        atlas, model, schedule = self.atlas, self.model, self.schedule
        if self.preset not in PRESET_NAMES:
            raise ConfigError(f"preset is {self.preset!r}; there are {', '.join(PRESET_NAMES)}")
        if not model.channels:
            raise ConfigError("model.channels is empty; the encoder has at least one level")
        counts = {f"model.{name}": getattr(model, name) for name in ("upsample", "pixel_shuffle", "heads")}
        counts |= {
            f"schedule.{name}": getattr(schedule, name)
            for name in ("rollouts_per_worker", "chunk_frames", "views")
        }
        for name, count in counts.items():
            if count < 1:
                raise ConfigError(f"{name} is {count}; it starts at 1")
        grid = model.upsample * model.pixel_shuffle * 2 ** (len(model.channels) - 1)
        for name, size in (("resolution", atlas.resolution), ("garment_rows", atlas.garment_rows)):
            if size % grid:
                raise ConfigError(
                    f"atlas.{name} is {size}; with model.upsample {model.upsample}, model.pixel_shuffle "
                    f"{model.pixel_shuffle} and {len(model.channels)} levels it must be a multiple of {grid}"
                )
        if model.channels[-1] % model.heads:
            raise ConfigError(
                f"model.channels ends in {model.channels[-1]}, not a multiple of {model.heads} heads"
            )
        if model.window < 1 or min(model.memory, model.feedback, model.bases, model.pose_components) < 0:
            raise ConfigError(
                f"model.window is {model.window} (>= 1), model.memory {model.memory}, model.feedback "
                f"{model.feedback}, model.bases {model.bases} and model.pose_components "
                f"{model.pose_components} (>= 0)"
            )
        if not model.causal and model.readout == "last":
            raise ConfigError(
                "model.causal is off, but the newest row of one attention sees every frame anyway: nothing "
                "would change; give --model.readout mean too, and compare with that"
            )
        if any(seconds <= 0 for seconds in model.mean_time_constants):
            raise ConfigError(
                f"model.mean_time_constants is {model.mean_time_constants}; they are seconds, above 0"
            )
        if not 0 < model.memory_weight < 1:
            raise ConfigError(
                f"model.memory_weight is {model.memory_weight}; it must lie strictly between 0 and 1"
            )
        if not 0 <= model.sh_degree <= 3:
            raise ConfigError(f"model.sh_degree is {model.sh_degree}; harmonics go from degree 0 to 3")
        if self.schedule.steps < 1 or self.workers < 1:
            raise ConfigError(
                f"schedule.steps ({self.schedule.steps}) and workers ({self.workers}) start at 1"
            )
