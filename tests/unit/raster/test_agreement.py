"""The fast backends held against the reference: images, gradients, extra outputs, any number of threads."""

import dataclasses

import numba
import pytest
import torch
from raster_scenes import (
    BACKENDS,
    EXTRAS,
    FAST,
    FIELDS,
    SCENES,
    assert_same_image,
    draw,
    make_camera,
    make_gaussians,
    render_with_gradients,
)
from torch import Tensor

from dsar.raster import rasterize
from dsar.types import Gaussians


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("scene", SCENES)
def test_fast_backend_equals_reference(scene, backend, antialiased):
    (slow, slow_gradients), (fast, fast_gradients) = (
        render_with_gradients(SCENES[scene], make_camera(), which, dtype, antialiased=antialiased)
        for which, dtype in (("reference", torch.float64), (backend, torch.float32))
    )
    for name, image in slow.items():
        assert_same_image(fast[name], image, name)
    for name, gradient in slow_gradients.items():
        assert (fast_gradients[name] - gradient).norm() <= 1e-3 * gradient.norm() + 1e-5, name


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("size", [(1, 1), (3, 70), (64, 48), (33, 17)])
def test_any_image_size_works(size, backend):
    camera = make_camera(*size, off_center=(0.0, 0.0))
    gaussians = make_gaussians(200)
    slow, slow_gradients = render_with_gradients(gaussians, camera, "reference", torch.float64)
    fast, fast_gradients = render_with_gradients(gaussians, camera, backend, torch.float32)
    assert fast["color"].shape == (size[1], size[0], 3)
    assert_same_image(fast["color"], slow["color"], "color")
    assert (fast_gradients["means"] - slow_gradients["means"]).norm() <= 1e-3 * slow_gradients["means"].norm()


@pytest.mark.parametrize("antialiased", [False, True])
def test_reference_gradients_equal_finite_differences(antialiased):
    # Wide and faint splats on a small image: no fragment is near a cut-off, where the image jumps.
    camera = make_camera(4, 3, focal=5.0, off_center=(0.3, -0.2))
    camera = dataclasses.replace(camera, K=camera.K.double(), T_camera_world=camera.T_camera_world.double())
    gaussians = make_gaussians(3, k=4, spread=0.2, size=2.0, opacity=(0.2, 0.6))
    background = torch.tensor([0.1, 0.6, 0.3], dtype=torch.float64, requires_grad=True)

    def render(*values):
        output = rasterize(
            Gaussians(*values[:-1]),
            camera,
            background=values[-1],
            backend="reference",
            antialiased=antialiased,
        )
        return output.color, output.alpha, output.depth

    leaves = [getattr(gaussians, field).requires_grad_() for field in FIELDS]
    assert torch.autograd.gradcheck(render, (*leaves, background))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("scene", ["random", "dense", "saturated", "with broken ones", "empty"])
def test_contributors_rebuild_the_image(backend, scene):
    gaussians = SCENES[scene].map(Tensor.float)
    output = draw(gaussians, make_camera(), backend, outputs=EXTRAS)
    counts, ids, weights = (getattr(output.contributors, name) for name in ("counts", "ids", "weights"))
    pixels = torch.arange(37 * 53).repeat_interleave(counts.flatten())
    alpha = torch.zeros(37 * 53).index_add(0, pixels, weights)
    depth = torch.zeros(37 * 53).index_add(0, pixels, weights * gaussians.means[ids, 2])
    assert len(ids) == len(weights) == counts.sum()
    assert (weights > 0).all()
    assert torch.allclose(alpha.view(37, 53), output.alpha, atol=1e-5)
    assert torch.allclose(depth.view(37, 53), output.depth * output.alpha, atol=1e-4)
    same_pixel = pixels[1:] == pixels[:-1]
    assert (gaussians.means[ids, 2].diff()[same_pixel] >= 0).all()


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("scene", ["random", "dense", "saturated", "empty"])
def test_extra_outputs_equal_the_reference(scene, backend):
    slow, fast = (
        draw(SCENES[scene].map(Tensor.float), make_camera(), which, outputs=EXTRAS)
        for which in ("reference", backend)
    )
    # A fragment right at a cut-off may fall on either side of it.
    assert (fast.contributors.counts != slow.contributors.counts).float().mean() < 0.01
    assert (fast.largest_weight_id != slow.largest_weight_id).float().mean() < 0.01
    assert (~((fast.first_hit_depth - slow.first_hit_depth).abs() <= 1e-4)).float().mean() < 0.01
    assert (~((fast.median_depth - slow.median_depth).abs() <= 1e-4)).float().mean() < 0.01
    same = (fast.contributors.counts == slow.contributors.counts).all(1)
    rows = [
        [
            pixel.tolist()
            for pixel in output.contributors.ids.split(output.contributors.counts.sum(1).tolist())
        ]
        for output in (slow, fast)
    ]
    assert all(one == other for one, other, equal in zip(*rows, same, strict=True) if equal)


@pytest.mark.parametrize("scene", ["dense", "saturated", "empty"])
def test_images_and_gradients_are_bitwise_equal_for_any_number_of_threads(monkeypatch, scene):
    runs = []
    for threads in (1, 2, 5):
        monkeypatch.setattr(numba, "get_num_threads", lambda threads=threads: threads)
        images, gradients = render_with_gradients(
            SCENES[scene], make_camera(), "cpu", torch.float32, antialiased=True
        )
        extras = draw(SCENES[scene].map(Tensor.float), make_camera(), "cpu", outputs=EXTRAS)
        images |= {name: getattr(extras, name) for name in EXTRAS[:3]} | vars(extras.contributors)
        runs.append((images, gradients))
    for images, gradients in runs[1:]:
        assert all(torch.equal(image, runs[0][0][name]) for name, image in images.items())
        assert all(torch.equal(gradient, runs[0][1][name]) for name, gradient in gradients.items())


@pytest.mark.parametrize("backend", FAST)
def test_gradients_of_one_output_do_not_need_the_others(backend):
    gaussians = make_gaussians(50).map(torch.Tensor.float)
    for name in ("color", "alpha", "depth"):
        slow, fast = (
            torch.autograd.grad(
                getattr(draw(leaves, make_camera(), which), name).square().sum(), leaves.means
            )[0]
            for which in ("reference", backend)
            for leaves in [gaussians.map(lambda values: values.clone().requires_grad_())]
        )
        assert (fast - slow).norm() <= 1e-3 * slow.norm(), name
