"""How Warp compiles the kernels, and starts one where torch's tensors are."""

import logging
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import torch
import warp as wp  # pyright: ignore[reportMissingImports]  # optional
from torch import Tensor

from dsar.errors import ConfigError

_log = logging.getLogger(__name__)


def func(function: Callable[..., Any]) -> Any:
    """Compile a part of a kernel."""
    return wp.func(_with_types(function))


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function that `launch` starts."""
    return wp.kernel(_with_types(function), enable_backward=False)


def differentiable_kernel(function: Callable[..., Any]) -> Any:
    """Compile a function that `launch` starts, and its derivative, which `launch_adjoint` starts."""
    return wp.kernel(_with_types(function), enable_backward=True)


def _with_types(function: Callable[..., Any]) -> Callable[..., Any]:
    """Let Warp read the types of a function that is marked, for all others, as not to be checked.

    Checkers of Python's types know neither Warp's arrays nor that numbers there have a size.
    """
    function.__dict__.pop("__no_type_check__", None)
    return function


def start_warp(device: torch.device) -> None:
    """Make Warp ready for a device.

    Raises:
        ConfigError: It is too old, or cannot use the GPU.
    """
    _start_warp()
    if device.type == "cuda" and not wp.is_cuda_available():
        driver = ".".join(map(str, wp.get_cuda_driver_version() or ("none",)))
        raise ConfigError(
            f"rasterize: Warp {wp.config.version} does not find a CUDA driver that it can use (version "
            f"found: {driver}); update NVIDIA's driver, or install gsplat and take backend='gsplat'"
        )


@cache
def _start_warp() -> None:
    """Start Warp without its greeting, and let blocks on the CPU have as many threads as on a GPU.

    Without the latter a block on the CPU is one thread, and what threads do together would remain untried.
    """
    if not hasattr(wp.config, "enable_cpu_blocks"):
        raise ConfigError(
            f"rasterize: Warp {wp.config.version} is too old; pip install --upgrade 'dsar-avatar[gpu]'"
        )
    _log.info(
        "Loading the rasteriser's Warp kernels; their first use on a machine compiles them (about 30 s)"
    )
    wp.config.log_level = max(wp.config.log_level, wp.LOG_WARNING)
    wp.config.enable_cpu_blocks = True
    wp.init()


def launch(
    kernel: Any,
    dim: int,
    inputs: Sequence[Any],
    *,
    device: torch.device,
    block: int | None = None,
) -> None:
    """Start a kernel on the stream that torch uses now.

    Args:
        kernel: What to start.
        dim: Number of threads, or, with `block`, of blocks.
        inputs: Its arguments: tensors become arrays of the type that the kernel names.
        device: Of the tensors.
        block: Threads in a block, for kernels whose threads work together.
    """
    wanted = [argument.type for argument in kernel.adj.args]
    arguments = [_as_argument(value, kind) for value, kind in zip(inputs, wanted, strict=True)]
    where = {"device": wp.device_from_torch(device), "stream": _stream(device)}
    if block is None:
        wp.launch(kernel, dim, arguments, **where, record_tape=False)
    else:
        wp.launch_tiled(kernel, dim=[dim], inputs=arguments, block_dim=block, **where, record_tape=False)


def launch_adjoint(
    kernel: Any, dim: int, inputs: Sequence[Any], gradients: Sequence[Tensor | None], device: torch.device
) -> None:
    """Start the derivative of a kernel.

    Args:
        kernel: What was started.
        dim: Number of its threads.
        inputs: Its arguments, outputs included.
        gradients: By argument: where to add the gradient, or, for an output, the gradient that arrives; None
            for what has none.
        device: Of the tensors.
    """
    wanted = [argument.type for argument in kernel.adj.args]
    arguments = [_as_argument(value, kind) for value, kind in zip(inputs, wanted, strict=True)]
    adjoints = [_as_argument(value, kind) for value, kind in zip(gradients, wanted, strict=True)]
    # A number has no array for its gradient: it passes as itself.
    adjoints = [
        argument if adjoint is None and not isinstance(value, Tensor) else adjoint
        for value, argument, adjoint in zip(inputs, arguments, adjoints, strict=True)
    ]
    wp.launch(
        kernel,
        dim,
        arguments,
        [],
        adj_inputs=adjoints,
        adj_outputs=[],
        adjoint=True,
        record_tape=False,
        device=wp.device_from_torch(device),
        stream=_stream(device),
    )


def _as_argument(value: Any, kind: Any) -> Any:
    """Return a tensor's memory as an array of a kernel's argument; anything else as it is."""
    if not isinstance(value, Tensor):
        return value
    return wp.from_torch(value.detach(), dtype=kind.dtype, requires_grad=False, return_ctype=True)


def _stream(device: torch.device) -> Any:
    """Return torch's current stream, None on the CPU."""
    if device.type == "cpu":
        return None
    return _as_warp_stream(torch.cuda.current_stream(device))


@cache
def _as_warp_stream(stream: torch.cuda.Stream) -> Any:
    """Return a stream of torch as one of Warp; torch keeps few, and never gives them up."""
    return wp.stream_from_torch(stream)
