"""Posing: rotations that are rotations, and Gaussians that move as rigidly as the bones."""

import pytest
import torch

from dsar.avatar.bilinear import bilinear_sampling, sample_bilinear
from dsar.avatar.charts import Chart
from dsar.avatar.fused_posing import pose_fused
from dsar.avatar.posing import _nearest_quaternions_plain, nearest_quaternions, pose_gaussians
from dsar.avatar.template import GaussianParameters
from dsar.avatar.texel_skin import TexelSkin
from dsar.body.skinning import blend_transforms
from dsar.geometry.rotations import matrix_from_axis_angle, matrix_from_quaternion, nearest_rotation


@pytest.mark.parametrize("find", [nearest_quaternions, _nearest_quaternions_plain])
def test_the_polar_factor_of_blended_bones_is_found(find):
    generator = torch.Generator().manual_seed(0)
    turns = matrix_from_axis_angle(torch.randn(3, 500, 2, 3, generator=generator))
    share = torch.rand(3, 500, 1, 1, generator=generator)
    blended = share * turns[:, :, 0] + (1 - share) * turns[:, :, 1]
    # Opposite bones blend to nothing; such matrices have no nearest rotation to speak of.
    sane = torch.linalg.det(blended) > 0.05
    matrices = blended if find is nearest_quaternions else blended.reshape(-1, 9)
    fast = matrix_from_quaternion(find(matrices).double()).reshape(blended.shape)
    exact = nearest_rotation(blended.double())
    assert sane.float().mean() > 0.5
    assert (fast - exact)[sane].abs().max() < 1e-5


def test_a_rigid_move_carries_means_covariances_and_radiance():
    torch.manual_seed(0)
    template = GaussianParameters(
        torch.randn(20, 3), torch.randn(20, 3, 2), torch.zeros(20, dtype=torch.bool), sh_degree=1
    )
    with torch.no_grad():
        template.log_scales.add_(torch.randn(20, 3))
        template.quaternions.add_(torch.randn(20, 4))
        template.harmonics.add_(torch.randn(20, 4, 3))
    turn, shift = matrix_from_axis_angle(torch.tensor([0.3, -1.0, 0.7])), torch.tensor([1.0, 2.0, 3.0])
    rigid = torch.cat([turn, shift[:, None]], 1).expand(1, 20, 3, 4)
    still = torch.cat([torch.eye(3), torch.zeros(3, 1)], 1).expand(1, 20, 3, 4)
    rest, moved = (pose_gaussians(template.activate(), blended)[0] for blended in (still, rigid))
    assert torch.allclose(moved.means, rest.means @ turn.T + shift, atol=1e-5)

    def covariance(gaussians):
        axes = matrix_from_quaternion(gaussians.rotations) * gaussians.scales[:, None]
        return axes @ axes.mT

    assert torch.allclose(covariance(moved), turn @ covariance(rest) @ turn.T, atol=1e-6)
    assert torch.allclose(moved.harmonics[:, 0], rest.harmonics[:, 0])
    assert not torch.allclose(moved.harmonics[:, 1:], rest.harmonics[:, 1:], atol=1e-2)


def test_the_texels_skin_is_blended_as_if_all_joints_moved_every_texel():
    generator = torch.Generator().manual_seed(3)
    weights = torch.rand(37, 9, generator=generator)
    weights = torch.where(torch.rand(37, 9, generator=generator) < 0.7, 0.0, weights)
    weights[:, 4] += 0.05
    weights = weights / weights.sum(1, keepdim=True)
    transforms = torch.eye(4).repeat(3, 9, 1, 1)
    transforms[..., :3, :3] = matrix_from_axis_angle(0.3 * torch.randn(3, 9, 3, generator=generator))
    transforms[..., :3, 3] = torch.randn(3, 9, 3, generator=generator)
    expected = blend_transforms(weights, transforms)
    blended, rotations = TexelSkin.of_weights(weights).blend(transforms)
    torch.testing.assert_close(blended, expected)
    torch.testing.assert_close(rotations, nearest_quaternions(expected[..., :3]))


@pytest.mark.parametrize("degree", [0, 2])
def test_fused_posing_equals_sampling_activation_and_posing_in_turn(degree):
    generator = torch.Generator().manual_seed(1)

    def random(*shape):
        return torch.randn(*shape, generator=generator)

    n, channels = 60, 8 + 3 * (degree + 1) ** 2
    template = GaussianParameters(random(n, 3), random(n, 3, 2), torch.zeros(n, dtype=torch.bool), degree)
    with torch.no_grad():
        for parameter in template.parameters():
            parameter.add_(0.5 * random(*parameter.shape))
        # Both limits of the scales are met.
        template.log_scales[:5] = -12.0
        template.log_scales[5:10] = 1.0
    rows, columns = torch.randint(24, (n,), generator=generator), torch.randint(16, (n,), generator=generator)
    charts = [Chart("body", "island", range(16)), Chart("garment", "tube", range(16, 24))]
    sampling = bilinear_sampling(rows, columns, 4, 4, charts)
    axes = matrix_from_axis_angle(random(n, 3))
    turns = matrix_from_axis_angle(random(2, n, 3))
    blended = torch.cat([turns * 1.1, random(2, n, 3, 1)], -1)
    offset, appearance = (random(2, c, 6, 4).mul(0.2).requires_grad_() for c in (3, channels))
    leaves, fixed = [offset, appearance, *template.parameters()], torch.arange(n) % 3 == 0

    offsets = (axes * sample_bilinear(offset, sampling)[..., None, :]).sum(-1)
    expected = pose_gaussians(
        template.activate(offsets, sample_bilinear(appearance, sampling), fixed), blended
    )
    rotations = nearest_quaternions(blended[..., :3])
    fused = pose_fused(template, offset, appearance, sampling, axes, blended, rotations, fixed)
    fields = [[value for g in both for value in vars(g).values()] for both in (expected, fused)]
    for slow, fast in zip(*fields, strict=True):
        assert torch.allclose(slow, fast, atol=1e-6)
    arriving = [random(*value.shape) for value in fields[0]]
    gradients = [torch.autograd.grad(values, leaves, arriving) for values in fields]
    for slow, fast in zip(*gradients, strict=True):
        assert slow.abs().max() > 0
        assert torch.allclose(slow, fast, atol=1e-4, rtol=1e-4)
