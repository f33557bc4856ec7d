"""The Warp backend's kernels as they are compiled, and which backend a GPU gets."""

import importlib
import re

import pytest
import torch
from raster_scenes import NEEDS_WARP, make_camera, make_gaussians, one_gaussian

from dsar.errors import ConfigError, MissingDependencyError, RasterError
from dsar.raster import backends, rasterize

KERNELS = {
    "kernels_projection": {"find_drawable", "make_records"},
    "kernels_binning": {"list_pairs", "sum_pairs"},
    "kernels_compositing": {"composite", "composite_backward"},
    "kernels_extras": {"composite_extras"},
}


@NEEDS_WARP
@pytest.mark.parametrize("architecture", [75, 80, 86, 89, 90, 100])
def test_kernels_compile_for_a_gpu_without_its_driver(architecture, tmp_path):
    import warp as wp

    for name, kernels in KERNELS.items():
        module = importlib.import_module(f"dsar.raster.warp_backend.{name}")
        wp.compile_aot_module(module, arch=architecture, module_dir=tmp_path / name, use_ptx=True)
        (file,) = (tmp_path / name).rglob("*.ptx")
        text = file.read_text()
        assert f".target sm_{architecture}" in text
        entries = re.findall(r"\.entry (\w+?)_[0-9a-f]+_cuda_kernel_forward", text)
        assert set(entries) == kernels


def test_a_gpu_gets_warp_then_gsplat_then_advice(monkeypatch):
    installed = {"warp", "gsplat"}
    monkeypatch.setattr(backends, "find_spec", lambda name: name if name in installed else None)
    assert backends._fast_backend("cuda") == "warp"
    installed.remove("warp")
    assert backends._fast_backend("cuda") == "gsplat"
    installed.clear()
    with pytest.raises(MissingDependencyError, match=r"needs no compiler: pip install 'dsar-avatar\[gpu\]'"):
        backends._fast_backend("cuda")
    with pytest.raises(MissingDependencyError, match=r"dsar-avatar\[gpu\]"):
        rasterize(one_gaussian(), make_camera(), backend="warp")
    assert backends._fast_backend("cpu") == "cpu"
    assert backends._fast_backend("mps") == "reference"


@NEEDS_WARP
def test_a_driver_that_warp_cannot_use_is_named(monkeypatch):
    import warp as wp

    from dsar.raster.warp_backend.compiling import start_warp

    monkeypatch.setattr(wp, "is_cuda_available", lambda: False)
    with pytest.raises(ConfigError, match="does not find a CUDA driver"):
        start_warp(torch.device("cuda"))


@NEEDS_WARP
def test_a_list_of_tiles_that_would_not_fit_is_refused(monkeypatch):
    from dsar.raster.warp_backend import splats

    monkeypatch.setattr(splats, "_MAX_PAIRS", 11)
    wall = one_gaussian(scales=torch.full((1, 3), 50.0))
    with pytest.raises(RasterError, match="1 Gaussians cover 12 tiles"):
        rasterize(wall, make_camera(), backend="warp")


@NEEDS_WARP
def test_fields_need_not_be_contiguous_or_aligned():
    gaussians = make_gaussians(40, k=4).map(torch.Tensor.float)
    strided = gaussians.map(lambda values: values.repeat_interleave(2, -1)[..., ::2])
    shifted = gaussians.map(lambda values: torch.cat([values[:1], values])[1:])
    whole = rasterize(gaussians, make_camera(), backend="warp").color
    for others in (strided, shifted):
        assert torch.equal(rasterize(others, make_camera(), backend="warp").color, whole)
