"""CUDA graphs on the pretended device.

While a graph is captured nothing is computed: memory keeps its values, and what is made has none yet. A wait
of the host in it raises, as on CUDA. `replay` computes all of it, into the same memory.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from tests.devices.host_waits import watch
from tests.devices.pretended_device import recorded_by


class RecordedGraph:
    """Stands for `torch.cuda.CUDAGraph`."""

    def __init__(self) -> None:
        self._steps: list[tuple[torch._ops.OpOverload, tuple[Any, ...], dict[str, Any], Any]] = []
        self._overwritten: dict[int, tuple[Any, Any]] = {}
        self.replays = 0

    @contextmanager
    def capture(self) -> Iterator[None]:
        """Record what the device is given in a block."""
        with watch(allowed=False), recorded_by(self._record):
            yield
        for storage, before in self._overwritten.values():
            storage.copy_(before)
        for _, args, kwargs, made in self._steps:
            for tensor in _new_tensors(made, args, kwargs):
                if tensor.is_floating_point():
                    tensor.fill_(float("nan"))

    @torch.no_grad()
    def replay(self) -> None:
        """Compute all that was recorded, into the memory that was made for it."""
        self.replays += 1
        for func, args, kwargs, made in self._steps:
            again = func(*args, **kwargs)
            kept = _new_tensors(made, args, kwargs)
            for tensor, value in zip(kept, _new_tensors(again, args, kwargs), strict=True):
                tensor.copy_(value)

    def _record(self, func: torch._ops.OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        for argument, value in zip(func._schema.arguments, args, strict=False):
            if argument.alias_info is not None and argument.alias_info.is_write:
                for tensor in tree_leaves(value):
                    storage = tensor.untyped_storage()
                    self._overwritten.setdefault(storage._cdata, (storage, storage.clone()))
        made = func(*args, **kwargs)
        self._steps.append((func, args, kwargs, made))
        return made


def _new_tensors(made: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> list[Tensor]:
    """Return what an operation made in memory of its own: no argument, and no view of one."""
    given = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor)]
    storages = {tensor.untyped_storage()._cdata for tensor in given}
    return [
        leaf
        for leaf in tree_leaves(made)
        if isinstance(leaf, Tensor) and leaf.untyped_storage()._cdata not in storages
    ]


@contextmanager
def cuda_graphs() -> Iterator[list[RecordedGraph]]:
    """Let code that asks torch for CUDA graphs have these in a block; yield the list of those it made."""
    made: list[RecordedGraph] = []

    def make() -> RecordedGraph:
        made.append(RecordedGraph())
        return made[-1]

    before = torch.cuda.CUDAGraph, torch.cuda.graph
    torch.cuda.CUDAGraph, torch.cuda.graph = make, RecordedGraph.capture
    try:
        yield made
    finally:
        torch.cuda.CUDAGraph, torch.cuda.graph = before
