"""Tasks and results as bytes, and how a worker runs a task that came so.

Torch would pass tensors through shared memory, of which a farm's containers have little, and which goes when
the process that made it is killed. The bytes are NumPy's: torch packs every tensor as an archive of its own,
of which a frame and its cameras have dozens.
"""

import io
import pickle
from contextvars import ContextVar
from typing import Any

import numba
import torch

from dsar.errors import RenderError

stop_flag: ContextVar[Any] = ContextVar("stop_flag")
"""In a worker process: a shared number that is not zero once no further task is to be begun."""


def run_packed(packed_work: bytes, packed_task: bytes) -> bytes:
    """Return the pickled result of work on a task, in a process of this or another machine."""
    stop = stop_flag.get(None)
    if stop is not None and stop.value:
        return b""  # nobody waits for it any more
    use_one_thread()
    try:
        work, task = unpack(packed_work), unpack(packed_task)
        return pack(work(task))
    except Exception as error:
        if _survives_pickling(error):
            raise
        raise RenderError(f"{type(error).__name__}: {error}") from error


def pack(value: object) -> bytes:
    """Return a value pickled."""
    buffer = io.BytesIO()
    _TensorPickler(buffer, pickle.HIGHEST_PROTOCOL).dump(value)
    return buffer.getvalue()


def unpack(packed: bytes) -> Any:
    """Return the value that was pickled: of our own processes only."""
    return pickle.loads(packed)


def use_one_thread() -> None:
    """Compute in the calling thread alone: there is a worker for every core."""
    torch.set_num_threads(1)
    numba.set_num_threads(1)


class _TensorPickler(pickle.Pickler):
    """Packs a tensor in main memory as the array that it is."""

    def reducer_override(self, obj: Any) -> Any:
        if type(obj) is torch.Tensor and obj.device.type == "cpu" and not obj.requires_grad:
            return torch.from_numpy, (obj.numpy(),)
        return NotImplemented


def _survives_pickling(error: Exception) -> bool:
    """Return whether an error can come out of a worker; one that cannot would look like a worker's death."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:
        return False
    return True
