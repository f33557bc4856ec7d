"""Where the host waits for the pretended device: every place, as a program on a GPU would.

A GPU works behind the host's back. The host has to wait for it whenever a value, or a size that follows from
values, is wanted on the host, and when it hands over memory that is not pinned.
"""

import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor

aten = torch.ops.aten

READS = frozenset(
    """_local_scalar_dense is_nonzero equal nonzero masked_select bincount histc unique_consecutive unique_dim
    _unique _unique2 _linalg_check_errors _linalg_svd _linalg_eigh _linalg_eigvals linalg_eig
    linalg_lstsq""".split()
)
"""Operations after which the host needs a value or a size, or a library of the device makes it wait."""
COPIES = frozenset({aten.copy_.default, aten._copy_from.default, aten._foreach_copy_.default})
INDEXING = frozenset(
    {
        *(aten.index.Tensor, aten._unsafe_index.Tensor),
        *(aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default),
        aten._unsafe_index_put.default,
    }
)
_WITHOUT_KERNEL = frozenset(
    "_unsafe_view detach lift_fresh empty empty_like empty_strided new_empty new_empty_strided".split()
)
_DOUBLE = ("host_waits.py", "pretended_device.py", "recorded_graphs.py")
_SKIPPED = (
    os.path.dirname(torch.__file__),
    *(os.path.join(os.path.dirname(__file__), name) for name in _DOUBLE),
    *("/jaxtyping/", "<@beartype"),
)


class HostWaitError(RuntimeError):
    """The host would wait for the device where it must not."""


class Wait(NamedTuple):
    """A place at which the host waits."""

    why: str
    """The operation, or what about it makes the host wait."""
    place: str
    """File and line of the innermost caller that is neither torch nor this double."""


@dataclass
class Log:
    """What the device was given while it was watched."""

    waits: Counter[Wait] = field(default_factory=Counter)
    """How often the host waited, by place."""
    operations: Counter[str] = field(default_factory=Counter)
    """Operations that would be at least one kernel each, by name; views are none."""
    allowed: bool = True
    """Whether the host may wait."""

    def waits_outside(self, *parts: str) -> int:
        """Return how often the host waited in files whose path has none of some parts."""
        return sum(n for wait, n in self.waits.items() if not any(part in wait.place for part in parts))


_watching: list[Log] = []


@contextmanager
def watch(*, allowed: bool = True) -> Iterator[Log]:
    """Log what the device is given in a block; where waits are not allowed, they raise `HostWaitError`."""
    log = Log(allowed=allowed)
    _watching.append(log)
    try:
        yield log
    finally:
        _watching.remove(log)


def note_operation(func: torch._ops.OpOverload) -> None:
    """Count an operation."""
    if not func.is_view and _name(func) not in _WITHOUT_KERNEL:
        for log in _watching:
            log.operations[_name(func)] += 1


def note_wait(why: str) -> None:
    """Count a wait at the place from which the device was called."""
    place = _calling_place()
    for log in _watching:
        log.waits[Wait(why, place)] += 1
        if not log.allowed:
            raise HostWaitError(f"{why} at {place}")


def why_host_waits(
    func: torch._ops.OpOverload, args: tuple[Any, ...], kwargs: dict[str, Any], host: list[Tensor]
) -> str | None:
    """Return why the host would wait in an operation, None where it would not.

    Args:
        func: The operation.
        args: Its arguments.
        kwargs: Its named arguments.
        host: Those of its tensors that are in main memory.
    """
    if func in COPIES:
        return _why_copy_waits(args, kwargs, host)
    name = _name(func)
    if name == "_to_copy" and str(kwargs.get("device")) == "cpu":
        return "copy to the host"
    if func in INDEXING:
        indices = [index for index in args[1] if index is not None]
        if any(index.dtype in (torch.bool, torch.uint8) for index in indices):
            return "mask as index"
        return "index from the host" if any(any(index is one for one in host) for index in indices) else None
    if name == "repeat_interleave" and not kwargs.get("output_size"):
        return "size from values"
    return name if name in READS else None


def _why_copy_waits(args: tuple[Any, ...], kwargs: dict[str, Any], host: list[Tensor]) -> str | None:
    if not host:
        return None
    if args[0] is host[0]:
        return "copy to the host"
    non_blocking = kwargs.get("non_blocking", len(args) > 2 and args[2])
    pinned = all(getattr(tensor, "pretended_pin", False) for tensor in host)
    return None if non_blocking and pinned else "copy to the device"


def _name(func: torch._ops.OpOverload) -> str:
    return func._schema.name.removeprefix("aten::")


def _calling_place() -> str:
    frame = sys._getframe(1)
    while frame is not None:
        file = frame.f_code.co_filename
        if not any(part in file for part in _SKIPPED):
            return f"{file}:{frame.f_lineno}"
        frame = frame.f_back
    return "the backward pass"
