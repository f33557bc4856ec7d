"""Image losses of every kind of computation against their definition, image by image."""

import dataclasses
from unittest.mock import patch

import pytest
import torch

from dsar.config import LossConfig
from dsar.metrics.images import ssim
from dsar.metrics.lpips import Lpips
from dsar.training.image_losses import image_losses
from dsar.training.targets import Target
from dsar.types import Camera, RenderOutput

SIZES = ((37, 22), (64, 48), (7, 5), (64, 33), (1, 1))
"""Heights and widths, of one batch."""


def defined_loss(color, alpha, truth, mask, config):
    """Return the loss of one image as it is written down: mean after mean, block after block."""
    loss, difference = config.alpha * (alpha - mask).abs().mean(), (color - truth).double()
    for _ in range(config.pyramid):
        loss = loss + config.l1 / config.pyramid * difference.abs().mean()
        rows = difference.split(2)
        blocks = [[block.mean((0, 1)) for block in row.split(2, 1)] for row in rows]
        difference = torch.stack([torch.stack(row) for row in blocks])
    return loss + config.ssim * (1 - ssim(color.double(), truth.double())) if config.ssim else loss


def make_views(sizes, seed=3):
    generator = torch.Generator().manual_seed(seed)
    images, targets = [], []
    for height, width in sizes:
        mask = torch.rand(height, width, generator=generator)
        truth = torch.rand(height, width, 3, generator=generator) * mask[..., None]
        color = (truth + 0.3 * torch.randn(height, width, 3, generator=generator)).requires_grad_()
        alpha = torch.rand(height, width, generator=generator).requires_grad_()
        images.append(RenderOutput(color, alpha, alpha.detach(), torch.tensor(0)))
        targets.append(Target(truth, mask, Camera(torch.eye(3), torch.eye(4), width, height, "any")))
    return images, targets, torch.rand(len(sizes), 3, generator=generator)


def plainly(compare):
    """Compute as on a device where no compiled kernels work."""
    with patch("dsar.devices.KERNEL_DEVICES", frozenset()):
        return compare()


@pytest.mark.parametrize("compute", [lambda compare: compare(), plainly], ids=["compiled", "batched"])
@pytest.mark.parametrize("weights", [(1.0, 0.1, 0.3), (0.5, 0.0, 0.0), (0.0, 1.0, 0.0)])
@pytest.mark.parametrize("levels", [1, 4])
def test_losses_and_gradients_of_a_batch_are_those_of_the_definition(compute, weights, levels):
    images, targets, backgrounds = make_views(SIZES)
    l1, similarity, cover = weights
    config = dataclasses.replace(LossConfig(), l1=l1, ssim=similarity, alpha=cover, pyramid=levels)
    losses, errors = compute(lambda: image_losses(images, targets, backgrounds, config, None))
    for k, (image, target) in enumerate(zip(images, targets, strict=True)):
        leaves = image.color, image.alpha
        truth = target.color + (1 - target.alpha[..., None]) * backgrounds[k]
        expected = defined_loss(image.color, image.alpha, truth, target.alpha, config)
        torch.testing.assert_close(losses[k].double(), expected.double(), rtol=1e-4, atol=1e-7)
        torch.testing.assert_close(errors[k], (image.color - truth).detach().square().mean())
        pairs = [
            torch.autograd.grad(3 * loss, leaves, retain_graph=True, materialize_grads=True)
            for loss in (expected, losses[k])
        ]
        for gradient, found in zip(*pairs, strict=True):
            scale = float(gradient.abs().max()) + 1e-9
            torch.testing.assert_close(found, gradient, rtol=1e-4, atol=1e-5 * scale)


def test_lpips_of_a_batch_is_that_of_each_image():
    torch.manual_seed(0)
    lpips, sizes = Lpips("alex").eval(), ((64, 48), (50, 70))
    images, targets, backgrounds = make_views(sizes)
    config = dataclasses.replace(LossConfig(), l1=0.0, ssim=0.0, alpha=0.0, lpips=0.5)
    for compute in (lambda compare: compare(), plainly):
        losses, _ = compute(lambda: image_losses(images, targets, backgrounds, config, lpips))
        for k, (image, target) in enumerate(zip(images, targets, strict=True)):
            truth = target.color + (1 - target.alpha[..., None]) * backgrounds[k]
            pair = [each.permute(2, 0, 1)[None].clamp(0, 1) for each in (image.color, truth)]
            torch.testing.assert_close(losses[k], 0.5 * lpips(*pair)[0])


def test_pyramid_sees_a_shift_that_plain_l1_cannot_order():
    stripes = (torch.arange(64) // 4 % 2).float()[None, :, None].expand(64, 64, 3).contiguous()
    near, far, blank = torch.roll(stripes, 1, 1), torch.roll(stripes, 4, 1), torch.full_like(stripes, 0.5)

    def l1(image, levels):
        mask = torch.ones(64, 64)
        config = dataclasses.replace(LossConfig(), l1=1.0, ssim=0.0, alpha=0.0, pyramid=levels)
        output = RenderOutput(image, mask, mask, torch.tensor(0))
        target = Target(stripes, mask, Camera(torch.eye(3), torch.eye(4), 64, 64, "any"))
        return float(image_losses([output], [target], torch.zeros(1, 3), config, None)[0])

    assert l1(stripes, 4) == 0
    assert l1(near, 1) == pytest.approx(float((near - stripes).abs().mean()))
    assert l1(far, 1) > l1(near, 1)
    assert l1(blank, 4) < l1(blank, 1)
