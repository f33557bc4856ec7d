"""What operations of torch cost: the bytes that live while they run, their arithmetic and their traffic.

It works on any device. On torch's `meta` device, whose tensors have sizes and no values, it costs next to
nothing to learn what an update of any size would need.
"""

import weakref
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import flop_registry

Arithmetic = Literal["convolution", "product", "elementwise"]


@dataclass(frozen=True)
class Operation:
    """What one operation asks of a device."""

    part: str
    """What it belongs to."""
    arithmetic: Arithmetic
    """Convolutions and matrix products have rates of their own; all else is bound by memory."""
    flop: int
    """Floating-point operations; counted of convolutions and products only."""
    traffic: int
    """Bytes of the tensors that it reads and writes."""


class OperationMeter(TorchDispatchMode):
    """Follows every tensor that is made while it is entered, until it is gone.

    Not seen: what libraries take behind torch's back, and what an allocator rounds up.
    """

    def __init__(self, device: str) -> None:
        """Begin with nothing; only tensors on devices of a type count."""
        super().__init__()
        self._device = device
        self.operations: list[Operation] = []
        """All of them, in their order."""
        self.live: Counter[str] = Counter()
        """Bytes that live now, by part."""
        self.peak: Mapping[str, int] = {}
        """Bytes by part when most lived."""
        self._part = ""
        self._most = self._now = 0
        self._storages: set[int] = set()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count what is made inside as a part."""
        before, self._part = self._part, name
        try:
            yield
        finally:
            self._part = before

    def follow(self, part: str, tensors: Iterable[Tensor]) -> None:
        """Count tensors that were made before."""
        with self.part(part):
            for tensor in tensors:
                self._follow(tensor)

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        """Run an operation, and note what it makes."""
        kwargs = kwargs or {}
        made = func(*args, **kwargs)
        given = {_place(tensor): tensor for tensor in self._tensors((args, kwargs))}
        results = list(self._tensors(made))
        for tensor in results:
            self._follow(tensor)
        fresh = [tensor for tensor in results if _place(tensor) not in given]
        if fresh or (given and func._schema.is_mutable):
            self._note(func, args, kwargs, made, [*given.values(), *fresh])
        return made

    def _note(self, func: Any, args: Any, kwargs: Any, made: Any, touched: Iterable[Tensor]) -> None:
        count: Callable[..., int] | None = flop_registry.get(func._overloadpacket)
        flop = count(*args, **kwargs, out_val=made) if count is not None else 0
        kind: Arithmetic = "elementwise"
        if flop:
            kind = "convolution" if "convolution" in func._schema.name else "product"
        traffic = sum(tensor.numel() * tensor.element_size() for tensor in touched)
        self.operations.append(Operation(self._part, kind, flop, traffic))

    def _tensors(self, tree: Any) -> Iterator[Tensor]:
        return (x for x in tree_leaves(tree) if isinstance(x, Tensor) and x.device.type == self._device)

    def _follow(self, tensor: Tensor) -> None:
        storage = tensor.untyped_storage()
        place, size, part = storage._cdata, storage.nbytes(), self._part
        if place in self._storages:
            return
        self._storages.add(place)
        self.live[part] += size
        self._now += size
        if self._now > self._most:
            self._most, self.peak = self._now, dict(self.live)
        weakref.finalize(storage, self._forget, place, size, part).atexit = False

    def _forget(self, place: int, size: int, part: str) -> None:
        self._storages.discard(place)
        self.live[part] -= size
        self._now -= size


def _place(tensor: Tensor) -> int:
    """Return what tells the tensor's memory from others'; views share it."""
    return tensor.untyped_storage()._cdata
