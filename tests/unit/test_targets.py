"""Training images: premultiplied, reduced and cropped, with the camera of exactly their pixels."""

import pytest
import torch

from dsar.data.captures.formats import open_capture
from dsar.metrics.images import mask_box
from dsar.training.kept_views import KeptViews
from dsar.training.targets import MARGIN, load_target


@pytest.mark.parametrize("reduction", [1, 2, 3])
def test_targets_are_block_averages_of_premultiplied_pixels(reduction):
    capture = open_capture("embedded")
    pixels = torch.tensor(capture.image("walk", 40, 3)).float() / 255
    camera = capture.cameras[3]
    target = load_target(KeptViews(capture), "walk", 40, 3, reduction)
    premultiplied = torch.cat([pixels[..., :3] * pixels[..., 3:], pixels[..., 3:]], -1).permute(2, 0, 1)
    whole = torch.nn.functional.avg_pool2d(premultiplied, reduction).permute(1, 2, 0)
    shift = (camera.K / reduction - target.camera.K)[:2, 2].round().int()
    x, y, h, w = *shift.tolist(), *target.alpha.shape
    assert torch.allclose(target.color, whole[y : y + h, x : x + w, :3], atol=1e-6)
    assert torch.allclose(target.alpha, whole[y : y + h, x : x + w, 3], atol=1e-6)
    assert (target.camera.width, target.camera.height) == (w, h)
    # Nothing of the person is cut off.
    x0, y0, x1, y1 = mask_box(capture.image("walk", 40, 3)[..., 3], 0)
    assert x * reduction <= max(x0 - MARGIN, 0) + reduction
    assert (x + w) * reduction >= x1
    assert y * reduction <= y0
    assert (y + h) * reduction >= y1
