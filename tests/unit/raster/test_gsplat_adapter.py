"""The gsplat adapter's own arithmetic, with a stand-in that answers as gsplat 1.5.3 does: no GPU needed."""

import builtins
import sys
import types

import pytest
import torch

from dsar.errors import ConfigError, MissingDependencyError
from dsar.raster import gsplat_backend as adapter
from dsar.raster.reference import _project, _radii, rasterize_reference
from dsar.types import Camera, Gaussians

EXTRAS = ("median_depth", "first_hit_depth", "largest_weight_id", "contributors")


class StandIn:
    """Draws with the reference; what gsplat leaves unwritten is NaN."""

    def rasterization(
        self, means, quats, scales, opacities, colors, viewmats, Ks, width, height,
        *, near_plane, eps2d, sh_degree, packed, render_mode, rasterize_mode,
    ):  # fmt: skip
        assert not packed
        assert render_mode == "RGB+ED"
        assert colors.shape[1] == (sh_degree + 1) ** 2
        gaussians = Gaussians(means, quats, scales, opacities, colors)
        assert all(values.isfinite().all() for values in vars(gaussians).values())
        camera, antialiased = (
            Camera(Ks[0], viewmats[0], width, height, "gsplat"),
            rasterize_mode == "antialiased",
        )
        drawing = rasterize_reference(gaussians, camera, None, eps2d, antialiased, EXTRAS)
        self.contributors = drawing.contributors
        means2d, covariances, depths, effective = _project(gaussians, camera, eps2d, antialiased)
        a, b, d = covariances[:, 0, 0], covariances[:, 0, 1], covariances[:, 1, 1]
        conics = torch.stack([d, -b, a], -1) / (a * d - b * b)[:, None]
        # Drawn is what a box of whole pixels brings into the image.
        boxes = _radii(covariances, effective).ceil()
        size = torch.tensor([width, height])
        drawn = ((means2d + boxes > 0) & (means2d - boxes < size)).all(-1)
        drawn &= (depths > near_plane) & (effective >= 1 / 255)
        self.drawn = int(drawn.sum())
        hidden = torch.where(drawn, 0.0, torch.nan)
        meta = {
            "radii": drawn[:, None].expand(-1, 2)[None].int() * 9,
            "means2d": (means2d + hidden[:, None])[None],
            "conics": (conics + hidden[:, None])[None],
            "depths": (depths + hidden)[None],
            "opacities": effective[None],
            "tile_size": 16,
            "isect_offsets": None,
            "flatten_ids": None,
        }
        image = torch.cat([drawing.color, drawing.depth[..., None]], -1)
        return image[None], drawing.alpha[None, ..., None], meta

    def rasterize_to_indices_in_range(
        self, range_start, range_end, transmittances, means2d, conics, opacities, image_width, image_height,
        tile_size, isect_offsets, flatten_ids,
    ):  # fmt: skip
        assert transmittances.shape == (1, image_height, image_width)
        assert (transmittances == 1).all()
        assert range_end < 2**32
        pixels = torch.arange(image_width * image_height).repeat_interleave(
            self.contributors.counts.flatten()
        )
        return self.contributors.ids, pixels, torch.zeros_like(pixels)


@pytest.fixture
def scene():
    generator = torch.Generator().manual_seed(0)
    gaussians = Gaussians(
        torch.randn(150, 3, generator=generator) * 0.4 + torch.tensor([0.0, 0.0, 2.0]),
        torch.randn(150, 4, generator=generator),
        0.01 + 0.1 * torch.rand(150, 3, generator=generator),
        torch.rand(150, generator=generator),
        torch.randn(150, 4, 3, generator=generator) * 0.5,
    )
    gaussians.means[3, 0], gaussians.scales[4, 1], gaussians.harmonics[5, 2, 0] = torch.nan, -1.0, torch.inf
    gaussians.rotations[6] = 0.0
    K = torch.tensor([[40.0, 0.0, 15.0], [0.0, 44.0, 12.0], [0.0, 0.0, 1.0]])
    return gaussians, Camera(K, torch.eye(4), 33, 21, "front")


@pytest.mark.parametrize("antialiased", [False, True])
def test_adapter_returns_what_the_reference_does(monkeypatch, scene, antialiased):
    gaussians, camera = scene
    gaussians = gaussians.map(lambda values: values.requires_grad_())
    background = torch.tensor([0.2, 0.5, 0.9])
    gsplat = StandIn()
    monkeypatch.setattr(adapter, "_load_gsplat", lambda: gsplat)
    ours = adapter.rasterize_gsplat(gaussians, camera, background, 0.3, antialiased, EXTRAS)
    true = rasterize_reference(gaussians, camera, background, 0.3, antialiased, EXTRAS)
    for name in ("color", "alpha", "depth", "median_depth", "first_hit_depth", "largest_weight_id"):
        assert torch.allclose(getattr(ours, name), getattr(true, name), atol=1e-5), name
    assert torch.equal(ours.contributors.counts, true.contributors.counts)
    assert torch.equal(ours.contributors.ids, true.contributors.ids)
    assert torch.allclose(ours.contributors.weights, true.contributors.weights, atol=1e-5)
    assert ours.culled == 150 - gsplat.drawn
    assert 4 <= ours.culled <= true.culled
    ours.color.sum().backward()
    assert all(values.grad.isfinite().all() for values in vars(gaussians).values())
    assert not gaussians.means.grad[3:7].any()


def test_extras_are_computed_only_on_request(monkeypatch, scene):
    monkeypatch.setattr(adapter, "_load_gsplat", StandIn)
    bare = adapter.rasterize_gsplat(*scene, None, 0.3, False, ())
    assert bare.median_depth is None
    assert bare.contributors is None
    assert adapter.rasterize_gsplat(*scene, None, 0.3, False, ("median_depth",)).contributors is None


@pytest.fixture
def forgetful():
    """Have gsplat looked for anew, before and after."""
    adapter._load_gsplat.cache_clear()
    yield
    adapter._load_gsplat.cache_clear()


def test_what_is_missing_is_said(monkeypatch, scene, forgetful):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ConfigError, match="needs an NVIDIA GPU"):
        adapter.rasterize_gsplat(*scene, None, 0.3, False, ())
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)
    with pytest.raises(MissingDependencyError, match=r"dsar-avatar\[gsplat\]"):
        adapter.rasterize_gsplat(*scene, None, 0.3, False, ())


@pytest.mark.parametrize(
    "error",
    [
        AttributeError("'NoneType' object has no attribute 'CameraModelType'"),
        ImportError("cannot import name 'csrc' from 'gsplat'"),
        RuntimeError("Error building extension 'gsplat_cuda'\n[1/9] nvcc ..."),
        OSError("CUDA_HOME environment variable is not set"),
        None,
    ],
)
def test_what_keeps_gsplat_from_drawing_comes_with_advice(monkeypatch, forgetful, error):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    fakes = {name: types.ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend")}
    fakes["gsplat.cuda._backend"]._C = None
    for name, module in fakes.items():
        monkeypatch.setitem(sys.modules, name, module)

    def fail(name, *more):
        if error and name == "gsplat":
            raise error
        return find(name, *more)

    find = builtins.__import__
    monkeypatch.setattr(builtins, "__import__", fail)
    reason = str(error).splitlines()[0] if error else "it found no CUDA toolkit"
    with pytest.raises(ConfigError) as caught:
        adapter._load_gsplat()
    assert reason in str(caught.value)
    assert "dsar-avatar[gpu]" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_gsplat_with_its_kernels_is_taken(monkeypatch, forgetful):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    fakes = {name: types.ModuleType(name) for name in ("gsplat", "gsplat.cuda", "gsplat.cuda._backend")}
    fakes["gsplat.cuda._backend"]._C = object()
    for name, module in fakes.items():
        monkeypatch.setitem(sys.modules, name, module)
    assert adapter._load_gsplat() is fakes["gsplat"]
