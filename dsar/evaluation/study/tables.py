"""Which models a table compares, by the settings in which they differ from a preset, and the paper's figures.

Rows whose settings are equal are one model, trained once.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from dsar.network import Stream

_Settings = dict[str, Any]


@dataclass(frozen=True)
class Row:
    """One line of a table."""

    label: str
    """What the table calls it."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings that differ from the preset's, as in `model.window`; `cameras` is the run's own."""
    paper: Mapping[str, float] = field(default_factory=dict)
    """The paper's figures of this row, if it has it; other data, other hardware."""
    seeds: int = 1
    """Runs, each with a seed of its own."""
    zeroed: tuple[Stream, ...] = ()
    """Streams that are taken away from the trained model when it is measured."""


@dataclass(frozen=True)
class Table:
    """A table of the paper, or one of ours."""

    title: str
    rows: tuple[Row, ...]
    split: str = "fd"
    """The split that the paper's figures are of."""


_NO_FEEDBACK: _Settings = {"model.feedback": 0}
_NO_BANK: _Settings = {"model.memory": 0}
# Lags and acceleration are velocities in disguise.
_NO_VELOCITY: _Settings = {
    "model.velocity": False,
    "model.acceleration": False,
    "model.mean_time_constants": (),
}
_NO_PRIOR: _Settings = {"model.prior": "none"}
_LAGS: _Settings = {"model.mean_time_constants": (0.1, 0.2, 0.4)}
_WINDOW_ONLY: _Settings = {**_NO_FEEDBACK, **_NO_BANK, **_NO_PRIOR}
_POSE_ONLY: _Settings = {
    **_WINDOW_ONLY,
    **_NO_VELOCITY,
    "model.window": 1,
    "model.motion_embedding": False,
}

_HEADLINE = (
    Row("full model", paper={"psnr": 30.6720, "ssim": 0.9739, "lpips": 0.0302}, seeds=3),
    Row(
        "without the geometric stream",
        _NO_FEEDBACK,
        {"psnr": 24.2694, "ssim": 0.9557, "lpips": 0.0623},
        seeds=3,
    ),
    Row("without the state stream", _NO_BANK, {"psnr": 28.2286, "ssim": 0.9632, "lpips": 0.0511}, seeds=3),
)
_ZEROED = (
    Row("full model, geometric stream zeroed at test", zeroed=("geometric",)),
    Row("full model, state stream zeroed at test", zeroed=("state",)),
)

ABLATIONS: dict[str, Table] = {
    "ablation": Table(
        "Streams and adaptive regularisation (paper's table 2, FD)",
        (
            *_HEADLINE,
            Row(
                "without adaptive regularisation",
                {"loss.adaptive": False},
                {"psnr": 28.8778, "ssim": 0.9658, "lpips": 0.0492},
            ),
            *_ZEROED,
        ),
    ),
    "windows": Table(
        "Window and memory (n, m)",
        tuple(
            Row(
                f"({n}, {n})",
                {"model.window": n, "model.memory": n},
                {"psnr": psnr, "ssim": ssim, "lpips": lpips},
            )
            for n, psnr, ssim, lpips in (
                (5, 30.2421, 0.9791, 0.0331),
                (10, 30.9515, 0.9798, 0.0311),
                (20, 30.8193, 0.9801, 0.0314),
            )
        ),
        split="test",
    ),
    "views": Table(
        "Training cameras",
        tuple(
            Row(label, settings, {"psnr": psnr, "ssim": ssim, "lpips": lpips})
            for label, settings, psnr, ssim, lpips in (
                ("4", {"cameras": 4}, 30.5542, 0.9791, 0.0318),
                # The embedded capture has eight.
                ("all (the paper: 8)", {}, 31.0515, 0.9805, 0.0313),
            )
        ),
        split="test",
    ),
    "components": Table(
        "Single components (FD)",
        (
            Row("full model", paper={"psnr": 30.6723, "ssim": 0.9739}, seeds=3),
            Row("without previous offsets", _NO_FEEDBACK, {"psnr": 24.2694, "ssim": 0.9557}, seeds=3),
            Row(
                "without velocity, acceleration and lag maps", _NO_VELOCITY, {"psnr": 29.8436, "ssim": 0.9682}
            ),
            Row(
                "position maps only",
                {**_NO_VELOCITY, **_NO_FEEDBACK},
                {"psnr": 23.8318, "ssim": 0.9498},
            ),
            Row(
                "bidirectional attention, mean of rows",
                {"model.causal": False, "model.readout": "mean"},
                {"psnr": 28.3341, "ssim": 0.9648},
            ),
            Row("causal attention, mean of rows", {"model.readout": "mean"}),
            Row(
                "direct attention to the previous frame",
                {"model.bank": "features", "model.memory": 1},
                {"psnr": 29.1247, "ssim": 0.9661},
            ),
            Row(
                "without motion embedding",
                {"model.motion_embedding": False},
                {"psnr": 30.0153, "ssim": 0.9703},
            ),
            Row(
                "long pose history, no state stream",
                {**_NO_BANK, "model.window": 20},
                {"psnr": 28.3174, "ssim": 0.9637},
            ),
            Row("3 previous offsets", {"model.feedback": 3}, {"psnr": 30.7161, "ssim": 0.9741}),
            Row("5 previous offsets", {"model.feedback": 5}, {"psnr": 30.5247, "ssim": 0.9733}),
        ),
    ),
    "extensions": Table(
        "What we added to the paper, taken away again",
        (
            Row("all of it", seeds=3),
            Row("the paper's wiring", {"model.wiring": "shared"}),
            Row("late wiring", {"model.wiring": "late"}),
            Row("without the motion prior", _NO_PRIOR, seeds=3),
            Row("without acceleration", {"model.acceleration": False}),
            Row("without the map of identities", {"model.uv_feature_channels": 0}),
            Row("without registration", {"schedule.pretraining_fraction": 0.0, "loss.registered": 0.0}),
            Row("without a smooth template", {"loss.shape": 0.0}),
            Row("without mirrored rollouts", {"schedule.mirrored_fraction": 0.0}),
            Row("Adam alone", {"schedule.muon_rate": 0.0}, seeds=3),
        ),
    ),
    "memories": Table(
        "What remembers: the motion prior, the bank, the previous offset, running means (lags)",
        (
            Row("prior, bank and feedback", seeds=3),
            Row("bank and feedback alone (the paper's two streams)", _NO_PRIOR, seeds=3),
            Row("without the bank", _NO_BANK),
            Row("without feedback", _NO_FEEDBACK),
            Row("the prior alone", {**_NO_FEEDBACK, **_NO_BANK, "model.window": 1}),
            Row("lags beside the prior", _LAGS),
            Row("lags in its place", {**_NO_PRIOR, **_LAGS}, seeds=3),
        ),
    ),
    "sizes": Table(
        "Sizes: is the model larger than the scene needs?",
        (
            Row("the demo's", seeds=3),
            Row("half the channels", {"model.channels": (8, 16, 32)}),
            Row("twice the channels", {"model.channels": (32, 64, 128)}),
            Row("maps twice as fine", {"model.upsample": 4, "model.pixel_shuffle": 2}),
            Row("fewer texels", {"atlas.resolution": 64}),
            Row("more texels", {"atlas.resolution": 128, "atlas.garment_rows": 64}),
            Row(
                "the preset small",
                {
                    "atlas.resolution": 128,
                    "atlas.garment_rows": 64,
                    "model.channels": (32, 64, 96),
                    "model.upsample": 4,
                    "schedule.views": 2,
                },
            ),
            Row("one frame, one memory", {"model.window": 1, "model.memory": 1}),
        ),
    ),
}

ABLATIONS["time"] = Table(
    "Length of training",
    tuple(
        Row(label, {**settings, "schedule.steps": steps})
        for steps in (750, 3000, 6000)
        for label, settings in (("full model", {}), ("pose only", _POSE_ONLY))
    ),
)

BASELINES: dict[str, Table] = {
    "baselines": Table(
        "Paradigms of other systems, in our code (not their authors')",
        (
            Row("full model", seeds=3),
            Row("pose only, one frame", _POSE_ONLY, seeds=3),
            Row(
                "the same, poses projected (the paradigm of Animatable-GS)",
                {**_POSE_ONLY, "model.pose_components": 20},
            ),
            Row("window of poses, no streams", _WINDOW_ONLY),
            Row("long history of poses, no streams", {**_WINDOW_ONLY, "model.window": 20}),
            Row("pose, linear bases (the paradigm of MMLPs)", {**_POSE_ONLY, "model.bases": 30}),
            Row(
                "pose features at each Gaussian (the paradigm of GaussianAvatar)",
                {**_POSE_ONLY, "model.channels": (64,), "model.uv_feature_channels": 32},
            ),
        ),
    ),
}
