"""Many sets of Gaussians and many cameras in one call."""

import dataclasses

import pytest
import torch
from raster_scenes import EXTRAS, FIELDS, NEEDS_WARP, WARP, make_camera, make_gaussians, one_gaussian
from torch.utils._python_dispatch import TorchDispatchMode

from dsar.errors import ConfigError
from dsar.raster import rasterize, rasterize_views

ON_CPU = ("reference", "cpu", WARP)


def make_batch():
    """Return sets of 40, no and 70 Gaussians, seen by 2, 1 and 3 cameras, and one that nobody sees."""
    sets = [make_gaussians(count, k=4, seed=count).map(torch.Tensor.float) for count in (40, 0, 5, 70)]
    whole = make_camera()
    views = [
        [whole, whole.cropped(7, 11, 20, 9)],
        [make_camera(5, 4)],
        [],
        [make_camera(64, 48, focal=80.0), make_camera(1, 1), whole.cropped(30, 20, 23, 17)],
    ]
    generator = torch.Generator().manual_seed(0)
    return sets, views, torch.rand(6, 3, generator=generator)


def leaves_of(sets, backgrounds):
    copies = [group.map(lambda values: values.clone().requires_grad_()) for group in sets]
    return copies, backgrounds.clone().requires_grad_()


def weigh(outputs):
    """Return a fixed random weighting of images."""
    generator = torch.Generator().manual_seed(3)
    images = [image for output in outputs for image in (output.color, output.alpha, output.depth)]
    return torch.stack([(torch.rand(i.shape, generator=generator) * i).sum() for i in images]).sum()


@pytest.mark.parametrize("backend", ON_CPU)
def test_a_batch_equals_its_views_drawn_one_by_one(backend):
    sets, views, backgrounds = make_batch()
    options = {"backend": backend, "dilation": 0.1375, "antialiased": True, "outputs": EXTRAS}
    leaves, colors = leaves_of(sets, backgrounds)
    batch = rasterize_views(leaves, views, backgrounds=colors, **options)
    others, other_colors = leaves_of(sets, backgrounds)
    rows = iter(other_colors)
    alone = [
        [rasterize(group, camera, background=next(rows), **options) for camera in cameras]
        for group, cameras in zip(others, views, strict=True)
    ]
    assert [len(outputs) for outputs in batch] == [2, 1, 0, 3]
    pairs = [pair for both in zip(batch, alone, strict=True) for pair in zip(*both, strict=True)]
    for one, other in pairs:
        for name in ("color", "alpha", "depth", "culled", *EXTRAS[:3]):
            assert torch.equal(getattr(one, name), getattr(other, name)), name
        for name in ("counts", "ids", "weights"):
            assert torch.equal(getattr(one.contributors, name), getattr(other.contributors, name)), name
    weigh([one for one, _ in pairs]).backward()
    weigh([other for _, other in pairs]).backward()
    for group, other in zip(leaves, others, strict=True):
        for field in FIELDS:
            ours, theirs = getattr(group, field).grad, getattr(other, field).grad
            if theirs is None:
                assert ours is None or not ours.any()
            else:
                assert (ours - theirs).norm() <= 1e-5 * theirs.norm(), field
    assert (colors.grad - other_colors.grad).norm() <= 1e-5 * other_colors.grad.norm()


@pytest.mark.parametrize("backend", ON_CPU)
def test_a_crop_is_that_part_of_the_whole_image(backend):
    gaussians, camera = (
        make_gaussians(300, k=4, spread=0.3, size=0.015).map(torch.Tensor.float),
        make_camera(),
    )
    # Splats reach no further than the margin within which the projection is not held back.
    ((whole, crop),) = rasterize_views(
        [gaussians], [[camera, camera.cropped(7, 11, 20, 13)]], backend=backend, outputs=EXTRAS
    )
    for name in ("color", "alpha", "depth", "median_depth"):
        part = getattr(whole, name)[11:24, 7:27]
        assert ((getattr(crop, name) - part).abs() <= 1e-4).float().mean() > 0.998, name
    assert (crop.largest_weight_id != whole.largest_weight_id[11:24, 7:27]).float().mean() < 0.01


@pytest.mark.parametrize("backend", ON_CPU)
def test_without_cameras_there_are_no_images(backend):
    gaussians = one_gaussian()
    assert rasterize_views([gaussians, gaussians], [[], []], backend=backend) == [[], []]
    assert rasterize_views([], [], backend=backend) == []


def test_batches_that_do_not_fit_are_refused():
    gaussians, camera = one_gaussian(), make_camera()
    with pytest.raises(ConfigError, match="2 sets of Gaussians have 1 lists of cameras"):
        rasterize_views([gaussians] * 2, [[camera]])
    with pytest.raises(ConfigError, match=r"2 views have backgrounds of shape \(2, 3\), found \(1, 3\)"):
        rasterize_views([gaussians], [[camera] * 2], backgrounds=torch.zeros(1, 3))
    with pytest.raises(ConfigError, match=r"backgrounds are torch\.float64"):
        rasterize(gaussians, camera, background=torch.zeros(3, dtype=torch.float64))
    more = dataclasses.replace(gaussians, harmonics=torch.zeros(1, 4, 3))
    with pytest.raises(ConfigError, match="equally many harmonics, found 1 and 4"):
        rasterize_views([gaussians, more], [[camera]] * 2)
    with pytest.raises(ConfigError, match="tensors differ"):
        rasterize_views([gaussians, gaussians.map(torch.Tensor.double)], [[camera]] * 2)
    moving = dataclasses.replace(camera, K=camera.K.clone().requires_grad_())
    with pytest.raises(ConfigError, match="no camera gradients"):
        rasterize_views([gaussians] * 2, [[camera], [camera, moving]])


@NEEDS_WARP
def test_every_run_of_warp_gives_the_same_bits():
    sets, views, backgrounds = make_batch()
    runs = []
    for _ in range(3):
        leaves, colors = leaves_of(sets, backgrounds)
        outputs = rasterize_views(leaves, views, backgrounds=colors, backend="warp")
        weigh([output for group in outputs for output in group]).backward()
        runs.append([getattr(group, field).grad for group in leaves for field in FIELDS] + [colors.grad])
    for run in runs[1:]:
        assert all(torch.equal(one, other) for one, other in zip(run, runs[0], strict=True))


class CountWaits(TorchDispatchMode):
    """Count the values that the host takes from tensors, for which it would wait for a GPU."""

    def __init__(self):
        super().__init__()
        self.count = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.count += func is torch.ops.aten._local_scalar_dense.default
        return func(*args, **(kwargs or {}))


@NEEDS_WARP
def test_the_host_waits_once_for_a_whole_batch():
    from dsar.raster.warp_backend import rasterize_views_warp

    sets, views, backgrounds = make_batch()
    leaves, colors = leaves_of(sets, backgrounds)
    with CountWaits() as waits:
        outputs = rasterize_views_warp(leaves, views, colors, 0.3, False, ())
        weigh([output for group in outputs for output in group]).backward()
    assert waits.count == 1


@NEEDS_WARP
def test_a_batch_needs_no_more_launches_than_one_view(monkeypatch):
    import warp as wp

    started = []

    def count(launch):
        return lambda *arguments, **options: started.append(1) or launch(*arguments, **options)

    for name in ("launch", "launch_tiled"):
        monkeypatch.setattr(wp, name, count(getattr(wp, name)))
    sets, views, _ = make_batch()
    numbers = []
    for these, those in ((sets, views), (sets[:1], [views[0][:1]])):
        outputs = rasterize_views(
            [group.map(torch.Tensor.requires_grad_) for group in these], those, backend="warp"
        )
        forward = len(started)
        weigh([output for group in outputs for output in group]).backward()
        numbers.append((forward, len(started) - forward))
        started.clear()
    assert numbers == [(5, 3), (5, 3)]
