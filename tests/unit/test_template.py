"""The template's first Gaussians: one texel, one Gaussian of the texel's own shape."""

import numpy as np
import torch

from dsar.avatar.charts import body_chart
from dsar.avatar.garment_chart import tube_tangents
from dsar.avatar.template import SCALE_IN_TEXELS, SCALE_RANGE, THICKNESS, texel_footprints
from dsar.body.files import load_body
from dsar.geometry.rotations import matrix_from_axis_angle, matrix_from_quaternion


def test_footprint_has_the_texels_own_covariance():
    torch.manual_seed(0)
    tangents = torch.randn(200, 3, 2) * 0.01
    rotations, scales = texel_footprints(tangents)
    axes = matrix_from_quaternion(rotations)
    flat = axes[..., :2] * scales[:, None, :2]
    expected = SCALE_IN_TEXELS**2 * tangents @ tangents.mT
    assert torch.allclose(flat @ flat.mT, expected, atol=1e-9)
    # The thin axis is the texel's normal.
    assert (axes[..., 2:].mT @ tangents).abs().max() < 1e-7
    assert torch.allclose(scales[:, 2], (THICKNESS * scales[:, :2].amin(1)).clamp_min(SCALE_RANGE[0]))


def test_footprint_turns_with_the_texel_and_follows_its_sides():
    tangents = torch.tensor([[[0.01, 0.0], [0.0, 0.03], [0.0, 0.0]], [[0.03, 0.0], [0.0, 0.01], [0.0, 0.0]]])
    rotations, scales = texel_footprints(tangents)
    assert torch.allclose(matrix_from_quaternion(rotations), torch.eye(3).expand(2, 3, 3), atol=1e-6)
    assert torch.allclose(scales[0, :2], scales[1, :2].flip(0))
    turn = matrix_from_axis_angle(torch.tensor([0.4, -0.2, 1.0]))
    turned, same = texel_footprints(turn @ tangents)
    assert torch.allclose(matrix_from_quaternion(turned), turn.expand(2, 3, 3), atol=1e-5)
    assert torch.allclose(same, scales)


def test_body_tangents_lead_to_the_next_texel():
    chart = body_chart(load_body(), 128)
    index = torch.full(chart.covered.shape, -1)
    index[chart.covered] = torch.arange(len(chart.positions))
    for column, (down, right) in enumerate(((0, 1), (1, 0))):
        here, there = index[: 128 - down, : 128 - right].flatten(), index[down:, right:].flatten()
        both = (here >= 0) & (there >= 0)
        step = chart.positions[there[both]] - chart.positions[here[both]]
        error = (step - chart.tangents[here[both], :, column]).norm(dim=1)
        # Neighbours in other triangles bend away, and those across an island's border lie elsewhere.
        assert error.median() < 0.1 * step.norm(dim=1).median()


def test_tube_tangents_close_around_the_seam():
    azimuth = torch.arange(48) / 48 * 2 * np.pi
    circle = torch.stack([azimuth.sin(), torch.zeros(48), azimuth.cos()], -1)
    tube = torch.stack([0.3 * circle + torch.tensor([0.0, -0.02 * row, 0.0]) for row in range(5)])
    tangents = tube_tangents(tube)
    assert torch.allclose(tangents[:, :, 1], torch.tensor([0.0, -0.02, 0.0]).expand(240, 3), atol=1e-6)
    assert torch.allclose(
        tangents[:, :, 0].norm(dim=1), torch.full((240,), 0.3 * np.sin(2 * np.pi / 48)).float()
    )
