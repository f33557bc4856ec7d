"""An avatar in a skirt and captures of it with garment truth, made in memory in a moment."""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dsar.avatar.avatar import Avatar
from dsar.avatar.charts import Atlas, ChartTexels, body_chart
from dsar.avatar.garment_chart import diffuse_weights, tube_tangents
from dsar.body.files import load_body
from dsar.body.uv_map import surface_frames
from dsar.config import ModelConfig
from dsar.data.captures.multiview import MultiViewCapture
from dsar.geometry.rotations import matrix_from_axis_angle
from dsar.types import Motion

FPS, ROWS, COLUMNS = 30.0, 8, 32
_UNIT = 5e-5


def skirt_avatar(axes: str = "surface", prior: str = "none") -> Avatar:
    """Return an untrained avatar, whose network moves nothing, with a tube around its hips.

    With a motion prior, its rest shape is in place and it is trusted fully.
    """
    body = load_body()
    azimuth = (torch.arange(COLUMNS) + 0.5) / COLUMNS * 2 * torch.pi
    out = torch.stack([azimuth.sin(), torch.zeros(COLUMNS), azimuth.cos()], -1).repeat(ROWS, 1, 1)
    down = torch.linspace(0, 1, ROWS)[:, None, None]
    positions = (body.joints[0] + out * (0.2 + 0.2 * down) - torch.tensor([0, 0.5, 0]) * down).reshape(-1, 3)
    skirt = ChartTexels(
        name="garment",
        topology="tube",
        covered=torch.ones(ROWS, COLUMNS, dtype=torch.bool),
        positions=positions,
        weights=diffuse_weights(body, positions, 0.1),
        frames=surface_frames(out.reshape(-1, 3)),
        tangents=tube_tangents(positions.unflatten(0, (ROWS, COLUMNS))),
    )
    torch.manual_seed(0)
    model = ModelConfig(
        channels=(4, 8),
        heads=2,
        window=3,
        memory=2,
        upsample=4,
        axes=axes,
        mean_time_constants=(0.1, 0.2, 0.4),
        prior=prior,
    )
    avatar = Avatar(body, Atlas.stack([body_chart(body, COLUMNS), skirt]), model, FPS).eval()
    with torch.no_grad():
        avatar.template.means += 0.004 * torch.randn(avatar.template.means.shape)
    avatar.place_prior()
    for garment in avatar.prior.garments if avatar.prior is not None else ():
        garment.trust.fill_(1.0)
    return avatar


def striding(frames: int, seed: int, name: str) -> Motion:
    """Return legs that stride, hips that turn and a body that goes somewhere, from a pose that is held."""
    generator = torch.Generator().manual_seed(seed)
    t = (torch.arange(frames) / FPS - 0.3).clamp_min(0)
    rotations, translations = torch.zeros(frames, 55, 3), torch.zeros(frames, 3)
    speeds = 3 + 3 * torch.rand(4, generator=generator)
    rotations[:, 1, 0], rotations[:, 2, 0] = 0.6 * (speeds[0] * t).sin(), -0.6 * (speeds[1] * t).sin()
    rotations[:, 0, 1], rotations[:, 4, 0] = speeds[2] * t, 0.5 * (speeds[3] * t).sin().abs()
    translations[:, 0], translations[:, 1] = 0.6 * t, 1.0
    return Motion(rotations, translations, FPS, name)


def capture_of(
    folder: Path,
    avatar: Avatar,
    motions: dict[str, Motion],
    garments: dict[str, list[Tensor]],
    splits: dict[str, tuple[str, ...]],
) -> MultiViewCapture:
    """Return a capture without images; its true garments (runs of [f v 3], world metres) lie in a folder."""
    paths = {}
    for name, runs in garments.items():
        paths[name] = folder / f"{name}.npz"
        steps = {}
        for number, run in enumerate(runs):
            places = np.round(run.double().numpy() / _UNIT).astype(np.int64)
            steps[f"run{number}"] = np.diff(places, axis=0, prepend=0 * places[:1]).astype(np.int16)
            assert (np.cumsum(steps[f"run{number}"].astype(np.int64), 0) == places).all()
        faces = np.array([[0, 1, 2]], np.int32)
        np.savez(paths[name], **steps, unit=np.float64(_UNIT), faces=faces)
    made = MultiViewCapture(
        root=folder,
        name="made",
        fps=FPS,
        cameras=(),
        body=avatar.body,
        body_path=None,
        betas=torch.zeros(0),
        motions=motions,
        splits={"train": (), "test": (), **splits},
        views={},
        reopen=lambda: made,
        garments=paths,
    )
    return made


def heading(angle: float) -> Tensor:
    """Return a rotation about the vertical."""
    return matrix_from_axis_angle(torch.tensor([0.0, angle, 0.0]))
