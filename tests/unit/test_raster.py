"""The rasteriser: closed forms, what is left out, and the fast backend held against the slow one."""

import dataclasses
import logging
import math
import subprocess
import sys

import numba
import pytest
import torch
from torch import Tensor

from dsar.errors import CaptureError, ConfigError, RasterError
from dsar.geometry.harmonics import C0
from dsar.raster import _check_outputs, cpu, rasterize, reduced_dilation
from dsar.types import Camera, Gaussians

FIELDS = ("means", "rotations", "scales", "opacities", "harmonics")
CUDA = pytest.param("cuda", marks=pytest.mark.gpu)
FAST = ("cpu", CUDA)
BACKENDS = ("reference", *FAST)


def on(device, record):
    """Return a record of tensors with all of them on a device."""
    if dataclasses.is_dataclass(record):
        fields = {field.name: on(device, getattr(record, field.name)) for field in dataclasses.fields(record)}
        return dataclasses.replace(record, **fields)
    return record.to(device) if isinstance(record, Tensor) else record


def draw(gaussians, camera, backend, background=None, **options):
    """Rasterise where a backend wants its tensors; return the images in main memory."""
    device = "cuda" if backend == "cuda" else "cpu"
    background = on(device, background)
    output = rasterize(on(device, gaussians), camera, background=background, backend=backend, **options)
    return on("cpu", output)


def make_camera(width=53, height=37, focal=60.0, off_center=(4.3, -2.7)):
    """Return a camera at the world's origin that looks along +z, its principal point off the middle."""
    K = torch.tensor(
        [
            [focal, 0.0, width / 2 + off_center[0]],
            [0.0, 1.1 * focal, height / 2 + off_center[1]],
            [0.0, 0.0, 1.0],
        ]
    )
    return Camera(K, torch.eye(4), width, height, "front")


def make_gaussians(count, k=1, seed=0, spread=0.5, size=0.05, opacity=(0.05, 0.95)):
    """Return Gaussians around (0, 0, 1.5), in front of `make_camera`, float64."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = (uniform(count, 3) * 2 - 1) * torch.tensor([2 * spread, spread, spread]) + torch.tensor(
        [0, 0, 1.5]
    )
    return Gaussians(
        means,
        torch.randn(count, 4, generator=generator, dtype=torch.float64),
        size * (0.2 + uniform(count, 3)),
        opacity[0] + (opacity[1] - opacity[0]) * uniform(count),
        torch.randn(count, k, 3, generator=generator, dtype=torch.float64) * 0.5,
    )


def one_gaussian(**changes):
    """Return a grey isotropic Gaussian at (0, 0, 2)."""
    values = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "rotations": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), 0.1),
        "opacities": torch.tensor([0.8]),
        "harmonics": torch.zeros(1, 1, 3),
    }
    return Gaussians(**(values | changes))


def broken_gaussians():
    """Return one Gaussian for each way not to be drawn, with its name."""
    good = one_gaussian()
    changes = {
        "behind": {"means": torch.tensor([[0.0, 0.0, -2.0]])},
        "too near": {"means": torch.tensor([[0.0, 0.0, 0.009]])},
        "outside": {"means": torch.tensor([[50.0, 0.0, 2.0]])},
        "transparent": {"opacities": torch.zeros(1)},
        "fainter than a step": {"opacities": torch.tensor([0.99 / 255])},
        "flat": {"scales": torch.tensor([[0.1, 0.0, 0.1]])},
        "negative scale": {"scales": torch.tensor([[0.1, -0.1, 0.1]])},
        "no rotation": {"rotations": torch.zeros(1, 4)},
    }
    for field in FIELDS:
        for value in (math.nan, math.inf):
            spoiled = getattr(good, field).clone()
            spoiled.flatten()[-1] = value
            changes[f"{value} in {field}"] = {field: spoiled}
    return {name: dataclasses.replace(good, **change) for name, change in changes.items()}


def concatenate(*parts):
    return Gaussians(*(torch.cat([getattr(part, field) for part in parts]) for field in FIELDS))


def render_with_gradients(gaussians, camera, backend, dtype, **options):
    """Return the images and the gradients of a fixed random weighting of all of them."""
    leaves = gaussians.map(lambda values: values.detach().to(dtype).clone().requires_grad_())
    background = torch.tensor([0.2, 0.5, 0.9], dtype=dtype, requires_grad=True)
    output = draw(leaves, camera, backend, background, **options)
    images = (output.color, output.alpha, output.depth)
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(i.shape, generator=generator, dtype=torch.float64).to(dtype) for i in images]
    loss = torch.stack([(image * weight).sum() for image, weight in zip(images, weights, strict=True)]).sum()
    inputs = {field: getattr(leaves, field) for field in FIELDS} | {"background": background}
    # An image without Gaussians depends on the background alone.
    gradients = torch.autograd.grad(loss, list(inputs.values()), materialize_grads=True)
    named_images = dict(zip(("color", "alpha", "depth"), images, strict=True))
    return named_images, dict(zip(inputs, gradients, strict=True))


def assert_same_image(fast, slow, name):
    """Compare images to 1e-4; a fragment right at the 1/255 cut-off may fall on either side of it."""
    error = (fast - slow).detach().abs().flatten()
    assert (~(error <= 1e-4)).float().mean() <= 0.002, name
    assert name == "depth" or (error < 0.01).all(), name


SCENES = {
    "random": make_gaussians(300, k=4),
    "dense": make_gaussians(3000, k=1, opacity=(0.8, 1.0)),
    "saturated": make_gaussians(40, k=16, size=0.4, opacity=(1.0, 1.0)),
    "edge of the frustum": make_gaussians(400, k=9, spread=1.45, size=0.3),
    "tiny": make_gaussians(300, k=4, size=1e-4),
    "long and thin": dataclasses.replace(
        make_gaussians(60, k=1),
        scales=torch.tensor([0.3, 0.003, 0.0003], dtype=torch.float64).expand(60, 3),
    ),
    "with broken ones": concatenate(
        make_gaussians(50, seed=2),
        *(gaussian.map(torch.Tensor.double) for gaussian in broken_gaussians().values()),
        make_gaussians(50, seed=3),
    ),
    "empty": make_gaussians(0),
}


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
def test_isotropic_gaussian_has_the_closed_form_image(backend):
    camera = make_camera(off_center=(0.0, 0.0))
    gaussians = one_gaussian(harmonics=(torch.tensor([[[0.9, 0.4, 0.1]]]) - 0.5) / C0)
    output = draw(gaussians, camera, backend)
    y, x = torch.meshgrid(torch.arange(37) + 0.5, torch.arange(53) + 0.5, indexing="ij")
    # sigma of 0.1 m at 2 m through focal lengths 60 and 66, plus the dilation of 0.3 pixels².
    exponent = (x - 26.5) ** 2 / (3.0**2 + 0.3) + (y - 18.5) ** 2 / (3.3**2 + 0.3)
    alpha = 0.8 * torch.exp(-0.5 * exponent)
    alpha = torch.where(alpha >= 1 / 255, alpha, 0)
    assert torch.allclose(output.alpha, alpha, atol=2e-6)
    assert torch.allclose(output.color, alpha[..., None] * torch.tensor([0.9, 0.4, 0.1]), atol=2e-6)
    assert torch.allclose(output.depth, torch.where(alpha > 0, 2.0, 0.0), atol=1e-4)


@pytest.mark.parametrize("backend", BACKENDS)
def test_gaussians_at_one_depth_show_that_depth(backend):
    gaussians = make_gaussians(200).map(torch.Tensor.float)
    gaussians.means[:, 2] = 1.25
    output = draw(gaussians, make_camera(), backend)
    hit = output.alpha > 0
    assert 0.1 < hit.float().mean() < 1
    assert torch.allclose(output.depth[hit], torch.tensor(1.25), atol=1e-4)
    assert (output.depth[~hit] == 0).all()


@pytest.mark.parametrize("backend", BACKENDS)
def test_background_shows_through_what_transmittance_is_left(backend):
    gaussians, background = make_gaussians(100).map(torch.Tensor.float), torch.tensor([0.1, 0.5, 0.9])
    bare = draw(gaussians, make_camera(), backend)
    over = draw(gaussians, make_camera(), backend, background)
    expected = bare.color + (1 - bare.alpha)[..., None] * background
    assert torch.allclose(over.color, expected, atol=1e-6)
    assert torch.equal(over.alpha, bare.alpha)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", broken_gaussians())
def test_what_cannot_be_drawn_leaves_background_and_zero_gradients(backend, name):
    images, gradients = render_with_gradients(broken_gaussians()[name], make_camera(), backend, torch.float32)
    assert torch.equal(images["color"], torch.tensor([0.2, 0.5, 0.9]).expand(37, 53, 3))
    assert not images["alpha"].any()
    assert not images["depth"].any()
    assert not any(gradients[field].any() for field in FIELDS)


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_left_out_is_counted(backend):
    broken = concatenate(*broken_gaussians().values())
    good = make_gaussians(50, spread=0.2).map(torch.Tensor.float)
    assert draw(concatenate(good, broken), make_camera(), backend).culled == len(broken)


@pytest.mark.parametrize("backend", BACKENDS)
def test_distant_splats_keep_their_light_when_antialiased(backend):
    """Else dilation makes a splat much smaller than a pixel as large as one, and as opaque as before."""
    camera = make_camera(off_center=(0.0, 0.0))
    gaussian = one_gaussian(scales=torch.full((1, 3), 0.01))
    # sigma of 0.3 and 0.33 pixels; the light of a splat is 2 pi opacity sigma_x sigma_y.
    light = 2 * math.pi * 0.8 * 0.3 * 0.33
    smooth = draw(gaussian, camera, backend, antialiased=True, dilation=0.5).alpha.sum()
    # The rim below 1/255 is lost.
    assert 0.95 < smooth / light < 1
    assert draw(gaussian, camera, backend, dilation=0.5).alpha.sum() > 5 * light


EXTRAS = ("median_depth", "first_hit_depth", "largest_weight_id", "contributors")


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


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("scene", ["random", "saturated", "empty"])
def test_the_first_and_the_heaviest_gaussian_are_those_of_the_list(backend, scene):
    gaussians = SCENES[scene].map(Tensor.float)
    output = draw(gaussians, make_camera(), backend, outputs=EXTRAS)
    counts, ids, weights = (getattr(output.contributors, name) for name in ("counts", "ids", "weights"))
    for pixel, (shares, mine) in enumerate(
        zip(weights.split(counts.flatten().tolist()), ids.split(counts.flatten().tolist()), strict=True)
    ):
        heaviest, front = output.largest_weight_id.flatten()[pixel], output.first_hit_depth.flatten()[pixel]
        assert heaviest == (mine[shares.argmax()] if len(mine) else -1)
        assert front == pytest.approx(float(gaussians.means[mine[0], 2]) if len(mine) else 0.0, abs=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_median_depth_is_where_half_of_the_light_is_gone(backend):
    """Three sheets of opacity .4: .6 of the light passes the first, .36 the second."""
    sheets = [
        one_gaussian(
            means=torch.tensor([[0.0, 0.0, z]]),
            scales=torch.full((1, 3), 50.0),
            opacities=torch.tensor([0.4]),
        )
        for z in (3.0, 2.0, 1.0)
    ]
    camera = make_camera(off_center=(0.0, 0.0))
    output = draw(concatenate(*sheets), camera, backend, outputs=["median_depth"])
    assert (output.median_depth == 2.0).all()
    assert output.contributors is None
    faint = draw(sheets[0], camera, backend, outputs=["median_depth"])
    assert (faint.median_depth == 3.0).all()
    assert draw(sheets[0], camera, backend).median_depth is None


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_rotation_whose_square_overflows_is_left_out(backend):
    """Else its inverse norm is 0, and it is drawn as if it were not turned."""
    assert draw(one_gaussian(rotations=torch.full((1, 4), 1e20)), make_camera(), backend).culled == 1


def test_opaque_wall_hides_what_is_behind_it_exactly():
    walls = [one_gaussian(scales=torch.full((1, 3), 5.0), opacities=torch.ones(1)) for _ in range(3)]
    hidden = one_gaussian(means=torch.tensor([[0.0, 0.0, 3.0]]), harmonics=torch.full((1, 1, 3), 5.0))
    camera = make_camera(off_center=(0.0, 0.0))
    with_hidden = rasterize(concatenate(*walls, hidden), camera)
    assert torch.equal(with_hidden.color, rasterize(concatenate(*walls), camera).color)


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


def test_auto_takes_the_kernels_for_float32_and_the_reference_for_float64(monkeypatch):
    taken, kernels = [], cpu.rasterize_cpu

    def count(*arguments):
        taken.append(arguments)
        return kernels(*arguments)

    monkeypatch.setattr(cpu, "rasterize_cpu", count)
    gaussians = make_gaussians(5)
    assert rasterize(gaussians, make_camera()).color.dtype == torch.float64
    assert not taken
    assert rasterize(gaussians.map(torch.Tensor.float), make_camera()).color.dtype == torch.float32
    assert len(taken) == 1


def test_loading_the_kernels_is_announced_once(caplog):
    cpu._load_kernels.cache_clear()
    with caplog.at_level(logging.INFO, "dsar.raster"):
        rasterize(one_gaussian(), make_camera())
        rasterize(one_gaussian(), make_camera())
    assert [record.message.split()[0] for record in caplog.records] == ["Loading", "Rasteriser"]


def test_loading_leaves_nothing_to_compile_at_the_first_image():
    """Else that image takes half a minute after all, without a word."""
    script = """
import torch
from dsar.raster import cpu, rasterize
from dsar.types import Camera, Gaussians
kernels = [value for value in vars(cpu).values() if hasattr(value, "signatures")]
cpu._load_kernels()
loaded = [len(kernel.signatures) for kernel in kernels]
gaussians = Gaussians(
    torch.rand(50, 3) + torch.tensor([0.0, 0.0, 1.0]), torch.rand(50, 4), torch.rand(50, 3) * 0.1,
    torch.rand(50), torch.rand(50, 16, 3),
).map(torch.Tensor.requires_grad_)
camera = Camera(torch.tensor([[40.0, 0, 20], [0, 40, 15], [0, 0, 1]]), torch.eye(4), 40, 30, "front")
for extras in ((), ("median_depth", "largest_weight_id", "contributors")):
    rasterize(gaussians, camera, antialiased=True, outputs=extras).color.sum().backward()
assert len(kernels) >= 6 and min(loaded) == 1, loaded
assert [len(kernel.signatures) for kernel in kernels] == loaded
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_kernels_are_compiled_anew_when_what_they_share_changes():
    stamp = cpu.composite_part._cache._cache_file._source_stamp
    assert {"simd.py", "tiles.py", "conventions.py"} <= {name for name, _, _ in stamp[1]}


def test_a_list_of_tiles_that_would_not_fit_is_refused(monkeypatch):
    monkeypatch.setattr(cpu, "_MAX_PAIRS", 11)
    wall = one_gaussian(scales=torch.full((1, 3), 50.0))
    with pytest.raises(RasterError, match="1 Gaussians cover 12 tiles"):
        rasterize(wall, make_camera())


def test_fields_need_not_be_contiguous():
    gaussians = make_gaussians(40, k=4).map(torch.Tensor.float)
    strided = gaussians.map(lambda values: values.repeat_interleave(2, -1)[..., ::2])
    assert not strided.means.is_contiguous()
    assert torch.equal(draw(strided, make_camera(), "cpu").color, draw(gaussians, make_camera(), "cpu").color)


def test_inputs_that_do_not_fit_are_refused():
    gaussians, camera = one_gaussian(), make_camera()
    skewed = camera.K.clone()
    skewed[0, 1] = 2.0
    with pytest.raises(CaptureError, match="fx, fy > 0"):
        rasterize(gaussians, dataclasses.replace(camera, K=skewed))
    with pytest.raises(CaptureError, match="not finite"):
        rasterize(gaussians, dataclasses.replace(camera, T_camera_world=camera.T_camera_world * math.nan))
    with pytest.raises(ConfigError, match="dilation must be positive"):
        rasterize(gaussians, camera, dilation=0.0)
    with pytest.raises(CaptureError, match="0 x 37 pixels"):
        rasterize(gaussians, dataclasses.replace(camera, width=0))
    with pytest.raises(ConfigError, match="not 3"):
        rasterize(one_gaussian(harmonics=torch.zeros(1, 3, 3)), camera)
    with pytest.raises(ConfigError, match="float32 tensors in main memory"):
        rasterize(gaussians.map(torch.Tensor.double), camera, backend="cpu")
    with pytest.raises(ConfigError, match="tensors differ"):
        rasterize(dataclasses.replace(gaussians, means=gaussians.means.double()), camera)
    with pytest.raises(ConfigError, match="no camera gradients"):
        rasterize(gaussians, dataclasses.replace(camera, K=camera.K.clone().requires_grad_()))
    with pytest.raises(
        ConfigError,
        match="outputs can be median_depth, first_hit_depth, largest_weight_id, contributors; found normals",
    ):
        _check_outputs(["normals"])
    with pytest.raises(ConfigError, match="float32 tensors on a GPU, not"):
        rasterize(gaussians, camera, backend="cuda")


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_small_image_equals_block_averages_of_the_large_one(backend):
    """Else Gaussians that were fitted to small images come out too thin for large ones."""
    camera = make_camera(96, 64, 120.0)
    gaussians = make_gaussians(30, size=0.03, opacity=(0.2, 0.6))
    if backend != "reference":
        gaussians = gaussians.map(Tensor.float)
    large = draw(gaussians, camera, backend).alpha
    averages = torch.nn.functional.avg_pool2d(large[None, None], 2)[0, 0]
    small = camera.resized(48, 32)
    matched = draw(gaussians, small, backend, dilation=reduced_dilation(2)).alpha
    usual = draw(gaussians, small, backend).alpha
    # What is left: the peak of a splat as thin as a pixel, which averaging lowers and dilation does not.
    assert (matched - averages).abs().max() < 0.1
    assert (matched - averages).abs().mean() < 0.4 * (usual - averages).abs().mean()
