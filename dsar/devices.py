"""Where to compute: in main memory, or on a GPU.

A tensor is made where the tensors are that it meets. So a device is chosen once, for a command, and what
follows from there needs none: an avatar has one, and motions, images and states go to it.
"""

import torch
from torch import Tensor

from dsar.errors import ConfigError

KERNEL_DEVICES = frozenset({"cpu"})
"""Types of devices in whose memory the compiled kernels (Numba) work."""
_EXPECTED = "expected auto, cpu, cuda, or cuda:N with the number of a GPU"


def choose_device(name: str) -> torch.device:
    """Return the device that a flag names.

    Args:
        name: `cpu`, `cuda` or `cuda:N`; `auto` is the first GPU where torch finds one, else the CPU.

    Raises:
        ConfigError: it names none, or a GPU that torch does not find.
    """
    count = torch.cuda.device_count() if torch.cuda.is_available() else 0
    if name == "auto":
        return torch.device("cuda:0" if count else "cpu")
    kind, colon, number = name.partition(":")
    if name == "cpu":
        return torch.device("cpu")
    if kind != "cuda" or (colon and not number.isdecimal()):
        raise ConfigError(f"--device {name}: {_EXPECTED}")
    if not count:
        raise ConfigError(
            f"--device {name}: torch {torch.__version__} finds no GPU here; leave --device out, or install "
            "torch for CUDA and NVIDIA's driver"
        )
    index = int(number or 0)
    if index >= count:
        raise ConfigError(f"--device {name}: {_EXPECTED}; torch finds {count}, from cuda:0 on")
    return torch.device("cuda", index)


def takes_kernels(tensor: Tensor) -> bool:
    """Return whether the compiled kernels can work on a tensor where it is."""
    return tensor.device.type in KERNEL_DEVICES


def send(tensor: Tensor, device: torch.device) -> Tensor:
    """Return a tensor from main memory on a device; the host does not wait for what the device is doing."""
    if device.type == "cpu":
        return tensor
    if device.type == "meta":
        # Sizes alone, of which no memory is a part.
        return tensor.to(device)
    return tensor.pin_memory().to(device, non_blocking=True)
