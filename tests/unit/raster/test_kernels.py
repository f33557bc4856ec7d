"""Which backend draws, and how its kernels are compiled and fed."""

import logging
import subprocess
import sys

import torch
from raster_scenes import (
    draw,
    make_camera,
    make_gaussians,
    one_gaussian,
)

from dsar.raster import cpu, rasterize


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


def test_fields_need_not_be_contiguous():
    gaussians = make_gaussians(40, k=4).map(torch.Tensor.float)
    strided = gaussians.map(lambda values: values.repeat_interleave(2, -1)[..., ::2])
    assert not strided.means.is_contiguous()
    assert torch.equal(draw(strided, make_camera(), "cpu").color, draw(gaussians, make_camera(), "cpu").color)
