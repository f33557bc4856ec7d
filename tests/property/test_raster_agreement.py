"""The fast backend draws what the slow one draws, whatever the scene and the camera."""

import dataclasses
import math

import pytest
import torch
from hypothesis import event, given, settings
from hypothesis import strategies as st
from raster_scenes import WARP

from dsar.raster import rasterize_views
from dsar.types import Camera, Gaussians

FIELDS = tuple(field.name for field in dataclasses.fields(Gaussians))
EXTRAS = ("median_depth", "first_hit_depth", "largest_weight_id", "contributors")
# Values that a diverged optimisation or a broken file brings, by field.
SPOILS = {
    "means": (math.nan, math.inf, -1.0, 0.0),
    "rotations": (math.nan, -math.inf),
    "scales": (math.nan, math.inf, 0.0, -0.1, 1e-12),
    "opacities": (math.nan, 0.0, 1e-3, 1.0),
    "harmonics": (math.nan, math.inf, -math.inf, -5.0),
}


@st.composite
def cameras(draw):
    """Draw a camera at the origin that looks along +z: any size, fx != fy, any principal point."""
    width, height = draw(st.integers(1, 70)), draw(st.integers(1, 40))
    focal = draw(st.floats(5, 120))
    K = torch.tensor([
        [focal, 0.0, width * draw(st.floats(-0.5, 1.5))],
        [0.0, focal * draw(st.floats(0.5, 2)), height * draw(st.floats(-0.5, 1.5))],
        [0.0, 0.0, 1.0],
    ])  # fmt: skip
    return Camera(K, torch.eye(4), width, height, "front")


@st.composite
def scenes(draw, most=150, ks=(1, 4, 9, 16)):
    """Draw Gaussians in front of, beside and behind such a camera; some are spoilt."""
    count, k = draw(st.integers(0, most)), draw(st.sampled_from(ks))
    generator = torch.Generator().manual_seed(draw(st.integers(0, 2**31)))

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    spread, size = draw(st.floats(0.01, 3)), 10 ** draw(st.floats(-4, 0))
    faintest = draw(st.sampled_from([0.05, 0.9, 1.0]))
    gaussians = Gaussians(
        (uniform(count, 3) * 2 - 1) * spread + torch.tensor([0.0, 0.0, draw(st.sampled_from([1.0, 3.0]))]),
        torch.randn(count, 4, generator=generator),
        size * 10 ** -(draw(st.sampled_from([0.0, 2.0])) * uniform(count, 3)),
        faintest + (1 - faintest) * uniform(count),
        torch.randn(count, k, 3, generator=generator) * 0.4,
    )
    for field in draw(st.lists(st.sampled_from(FIELDS), max_size=4)) if count else []:
        values = getattr(gaussians, field).view(count, -1)
        values[draw(st.integers(0, count - 1)), -1] = draw(st.sampled_from(SPOILS[field]))
    return gaussians


@st.composite
def batches(draw):
    """Draw sets of Gaussians and the cameras of each, none for some; at least one in all."""
    ks = [draw(st.sampled_from([1, 4, 9, 16]))]
    sets = draw(st.lists(scenes(80, ks), min_size=1, max_size=3))
    views = [draw(st.lists(cameras(), max_size=3)) for _ in sets]
    return sets, views if any(views) else [[draw(cameras())], *views[1:]]


def weigh(output, dtype):
    """Return a fixed random weighting of all of an image."""
    # Depth is a quotient by alpha: its gradient is as inexact as a faint pixel's alpha, one minus nearly one.
    images = (output.color, output.alpha, output.depth * output.alpha.detach())
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(image.shape, generator=generator).to(dtype) for image in images]
    return torch.stack([(image * weight).sum() for image, weight in zip(images, weights, strict=True)]).sum()


def draw_and_differentiate(sets, views, backend, dtype, **options):
    """Return the images of each set, and the gradients of its fields."""
    leaves = [group.map(lambda values: values.to(dtype, copy=True).requires_grad_()) for group in sets]
    outputs = rasterize_views(leaves, views, backend=backend, outputs=EXTRAS, **options)
    loss = torch.stack([weigh(output, dtype) for group in outputs for output in group]).sum()
    fields = [getattr(group, field) for group in leaves for field in FIELDS]
    gradients = iter(torch.autograd.grad(loss, fields, materialize_grads=True))
    return outputs, [[next(gradients) for _ in FIELDS] for _ in sets]


def assert_same_view(fast, slow):
    """Compare two images; return whether every pixel blends the same number of fragments."""
    # A fragment right at a cut-off (alpha of 1/255, transmittance of 1e-4) may fall on either side of it.
    same = slow.contributors.counts == fast.contributors.counts
    assert (~same).sum() <= 1 + 0.002 * same.numel()
    assert abs(fast.culled - slow.culled) <= 1
    brightest = 1 + slow.color.detach().amax()
    error = (fast.color - slow.color).detach().abs().amax(-1)
    assert (error[same] <= 1e-4 * brightest).all()
    assert (error <= 0.005 * brightest).all()
    assert ((fast.alpha - slow.alpha).abs()[same] <= 1e-4).all()
    # Where the quotient of depth is well conditioned.
    solid = same & (slow.alpha > 0.05)
    assert ((fast.depth - slow.depth).abs()[solid] <= 1e-4 * slow.depth[solid]).all()
    if same.all():
        assert torch.equal(fast.contributors.ids, slow.contributors.ids)
        assert ((fast.contributors.weights - slow.contributors.weights).abs() <= 1e-4).all()
    return bool(same.all())


def assert_same_gradients(fast, slow, same):
    """Compare gradients of fields where images blend the same fragments."""
    for field, one, other in zip(FIELDS, fast, slow, strict=True):
        assert one.isfinite().all(), field
        # Rotations of a round Gaussian have no gradient; of terms around 10 float32 leaves this much.
        assert not same or (one - other).norm() <= 1e-3 * other.norm() + 1e-4, field


@pytest.mark.parametrize("backend", ["cpu", WARP])
@settings(max_examples=60, deadline=None)
@given(
    gaussians=scenes(),
    camera=cameras(),
    antialiased=st.booleans(),
    dilation=st.sampled_from([0.1375, 0.3, 2.0]),
)
def test_fast_equals_slow_on_any_scene(backend, gaussians, camera, antialiased, dilation):
    given_ = [gaussians], [[camera]]
    options = {"antialiased": antialiased, "dilation": dilation}
    ((slow,),), (slow_gradients,) = draw_and_differentiate(*given_, "reference", torch.float64, **options)
    ((fast,),), (fast_gradients,) = draw_and_differentiate(*given_, backend, torch.float32, **options)
    same = assert_same_view(fast, slow)
    event("every pixel blends the same number of fragments" if same else "a fragment fell at a cut-off")
    assert_same_gradients(fast_gradients, slow_gradients, same)


@pytest.mark.parametrize("backend", ["cpu", WARP])
@settings(max_examples=25, deadline=None)
@given(batch=batches(), antialiased=st.booleans())
def test_fast_equals_slow_on_any_batch(backend, batch, antialiased):
    slow, slow_gradients = draw_and_differentiate(*batch, "reference", torch.float64, antialiased=antialiased)
    fast, fast_gradients = draw_and_differentiate(*batch, backend, torch.float32, antialiased=antialiased)
    assert [len(group) for group in fast] == [len(views) for views in batch[1]]
    for ones, others, gradients, true_gradients in zip(
        fast, slow, fast_gradients, slow_gradients, strict=True
    ):
        same = [assert_same_view(one, other) for one, other in zip(ones, others, strict=True)]
        assert_same_gradients(gradients, true_gradients, all(same))
