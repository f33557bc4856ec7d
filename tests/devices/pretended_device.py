"""A GPU that is not there: `torch.device("pretended")`, whose kernels are the host's.

It proves on a CPU that a program would run on a GPU. Tensors on it have the host's values to the last bit.
But as on CUDA they do not mix with tensors in main memory, do not become NumPy arrays, and make the host wait
when it reads them (`host_waits`).

It is made of torch's private interface for backends written in Python (`PrivateUse1`), which may change with
any version. What it does not pretend: streams, several devices, the order of atomic additions, generators of
its own, torch.compile.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor
from torch.optim import optimizer as torch_optimizer
from torch.utils import _foreach_utils
from torch.utils import backend_registration as registration
from torch.utils._mode_utils import no_dispatch

from tests.devices.host_waits import COPIES, INDEXING, note_operation, note_wait, why_host_waits

NAME = "pretended"
_DEVICE = f"{NAME}:0"
_UNBOUNDED = 2**60
"""Bytes of every shell's storage, which is not there: torch checks views against it."""
_TAKE_HOST_SCALARS = frozenset(
    f"aten::{name}" for name in ("fill", "fill_", "masked_fill", "masked_fill_", "where")
)
"""Operations besides pointwise ones that CUDA lets have a tensor of no dimensions in main memory."""
_AUTOCAST_LOWER = (
    *("conv1d", "conv2d", "conv3d", "conv_transpose2d.input", "matmul", "mm", "bmm", "addmm", "baddbmm"),
    *("linear", "scaled_dot_product_attention"),
)
_AUTOCAST_FLOAT32 = (
    *("softmax.int", "log_softmax.int", "layer_norm", "group_norm", "exp", "log", "pow.Tensor_Scalar"),
    *("sum", "sum.dim_IntList", "cdist"),
)

Recorder = Callable[[torch._ops.OpOverload, tuple[Any, ...], dict[str, Any]], Any]
"""Runs an operation on host tensors, and keeps it (see `recorded_graphs`)."""


class MixedDevicesError(RuntimeError):
    """Tensors in main memory meet tensors on the device."""


class PretendedTensor(Tensor):
    """A tensor on the device: a shell without memory around a host tensor that has the values."""

    __torch_function__ = torch._C._disabled_torch_function_impl
    host: Tensor

    @staticmethod
    def __new__(cls, host: Tensor) -> "PretendedTensor":
        with torch.inference_mode(host.is_inference()):
            shell = Tensor._make_wrapper_subclass(
                cls,
                host.shape,
                host.stride(),
                host.storage_offset(),
                dtype=host.dtype,
                device=_DEVICE,
                storage_size=_UNBOUNDED,
            )
        shell.host = host
        return shell

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return _dispatch(func, args, kwargs or {})

    @property
    def data(self) -> Tensor:
        return Tensor.data.__get__(self)

    @data.setter
    def data(self, value: Tensor) -> None:
        # torch swaps what it knows of a tensor, and does not know of the values.
        Tensor.data.__set__(self, value)
        self.host = value.host

    def untyped_storage(self):
        return self.host.untyped_storage()

    def tolist(self):
        return self.cpu().tolist()

    def numpy(self, *, force: bool = False):
        if not force:
            raise TypeError(f"can't convert a tensor on {self.device} to NumPy; use Tensor.cpu() first")
        return self.detach().cpu().numpy()

    def __array__(self, *_: object, **__: object):
        return self.numpy()

    def __deepcopy__(self, memo):
        if id(self) not in memo:
            memo[id(self)] = copy = self.detach().clone().requires_grad_(self.requires_grad)
            copy._is_param = getattr(self, "_is_param", False)
        return memo[id(self)]

    def __repr__(self, **_):
        return f"{self.host!r:.200} on {self.device}"


def _dispatch(func: torch._ops.OpOverload, args: Sequence[Any], kwargs: dict[str, Any]) -> Any:
    """Run an operation on the host; refuse what CUDA would, and note what would make the host wait."""
    if func._can_decompose():
        # In inference mode composite operations arrive whole; what they are made of is what counts.
        return func.decompose(*args, **kwargs)
    tensors: list[Tensor] = []
    _map_tensors(tensors.append, (args, kwargs))
    host = [tensor for tensor in tensors if not isinstance(tensor, PretendedTensor)]
    _refuse_mixtures(func, args, kwargs, tensors, host)
    if why := why_host_waits(func, tuple(args), kwargs, host):
        note_wait(why)
    note_operation(func)
    goes_to = kwargs.get("device")
    stays = goes_to is None or torch.device(goes_to).type == NAME
    shells = {id(tensor.host): tensor for tensor in tensors if isinstance(tensor, PretendedTensor)}
    args, kwargs = _map_tensors(lambda tensor: getattr(tensor, "host", tensor), (tuple(args), kwargs))
    if goes_to is not None:
        kwargs["device"] = "cpu" if stays else goes_to
    kwargs.pop("pin_memory", None)
    made = _backend.recorder(func, args, kwargs) if _backend.recorder else func(*args, **kwargs)
    for shell in shells.values():
        _follow_shape(shell)
    # What an operation gives back of its arguments is these very objects; the rest is new on the device.
    known = {id(tensor): tensor for tensor in host} | shells
    wrap = PretendedTensor if stays else (lambda tensor: tensor)
    return _map_tensors(lambda tensor: known[id(tensor)] if id(tensor) in known else wrap(tensor), made)


def _map_tensors(function: Callable[[Tensor], Any], value: Any) -> Any:
    """Return what an operation takes or gives with a function applied to its tensors."""
    if isinstance(value, Tensor):
        return function(value)
    if isinstance(value, (list, tuple)):
        return type(value)([_map_tensors(function, each) for each in value])
    if isinstance(value, dict):
        return {name: _map_tensors(function, each) for name, each in value.items()}
    return value


def _refuse_mixtures(
    func: torch._ops.OpOverload,
    args: Sequence[Any],
    kwargs: dict[str, Any],
    tensors: list[Tensor],
    host: list[Tensor],
) -> None:
    """Raise MixedDevicesError where CUDA would raise because tensors are in different places."""
    generator = kwargs.get("generator")
    if generator is not None and generator.device.type != NAME:
        raise MixedDevicesError(f"{func}: a generator of {generator.device} for a tensor of {NAME}")
    if not host or func in COPIES or _host_scalars_only(func, args, host) or _only_indices(func, args, host):
        return
    places = [(tuple(tensor.shape), str(tensor.device)) for tensor in tensors]
    raise MixedDevicesError(f"{func}: expected all tensors on one device, found {places}")


def _host_scalars_only(func: torch._ops.OpOverload, args: Sequence[Any], host: list[Tensor]) -> bool:
    """Return whether what is in main memory is numbers that an operation takes along."""
    writes_to_host = func._schema.is_mutable and args[0] is host[0]
    takes_them = torch.Tag.pointwise in func.tags or func._schema.name in _TAKE_HOST_SCALARS
    numbers = all(tensor.ndim == 0 for tensor in host) and not isinstance(args[0], (list, tuple))
    return takes_them and numbers and not writes_to_host


def _only_indices(func: torch._ops.OpOverload, args: Sequence[Any], host: list[Tensor]) -> bool:
    """Return whether what is in main memory is indices, or one number that is written."""
    if func not in INDEXING or not isinstance(args[0], PretendedTensor):
        return False
    value = args[2] if len(args) > 2 else None
    return value is None or value.ndim == 0 or isinstance(value, PretendedTensor)


def _follow_shape(shell: PretendedTensor) -> None:
    """Give a shell the shape that an operation in place gave its values."""
    host = shell.host
    if shell.shape == host.shape and shell.stride() == host.stride():
        return
    before = torch._C._meta_in_tls_dispatch_include()
    torch._C._set_meta_in_tls_dispatch_include(True)
    try:
        with no_dispatch():
            shell.as_strided_(host.shape, host.stride(), host.storage_offset())
    finally:
        torch._C._set_meta_in_tls_dispatch_include(before)


class _Module(registration._DummyBackendModule):
    """What torch asks of `torch.pretended`."""

    def get_amp_supported_dtype(self) -> list[torch.dtype]:
        return [torch.bfloat16, torch.float16]


class _Backend:
    """The device's registration with torch, which cannot be taken back, and who records what it does."""

    def __init__(self) -> None:
        self.recorder: Recorder | None = None
        self._libraries: list[torch.library.Library] = []

    def register(self) -> None:
        """Make the device known to torch, once a process."""
        if self._libraries:
            return
        registration._setup_privateuseone_for_python_backend(NAME, _Module())
        library, rest = torch.library.Library("aten", "IMPL"), torch.library.Library("_", "IMPL")
        self._libraries += [library, rest]
        operators = dict(_aten_operators())
        for name, operator in operators.items():
            if _is_factory(operator):
                library.impl(name, _factory(operator), "PrivateUse1")
        # torch.tensor(..., device=) does not go through __torch_dispatch__ either.
        library.impl("_copy_from", _copy_from, "PrivateUse1")
        rest.fallback(torch.library.fallthrough_kernel, "AutocastPrivateUse1")
        for names, dtype in ((_AUTOCAST_LOWER, None), (_AUTOCAST_FLOAT32, torch.float32)):
            for name in names:
                library.impl(name, _casting(operators[name], dtype), "AutocastPrivateUse1")


_backend = _Backend()


def _aten_operators() -> Iterator[tuple[str, torch._ops.OpOverload]]:
    for full in torch._C._dispatch_get_all_op_names():
        namespace, _, name = full.partition("::")
        packet, _, kind = name.partition(".")
        # torch.ops does not show every operation that the dispatcher has.
        overloads = getattr(torch.ops.aten, packet, None) if namespace == "aten" else None
        if hasattr(overloads, kind or "default"):
            yield name, getattr(overloads, kind or "default")


def _is_factory(operator: torch._ops.OpOverload) -> bool:
    """Return whether an operation makes a tensor of no other, so that only its `device` says where."""
    schema = operator._schema
    placed = [str(a.type) for a in schema.arguments if a.name == "device" or "Tensor" in str(a.type)]
    return placed == ["Optional[Device]"] and [str(value.type) for value in schema.returns] == ["Tensor"]


def _factory(operator: torch._ops.OpOverload) -> Callable[..., Tensor]:
    return lambda *args, **kwargs: _dispatch(operator, args, kwargs)


def _copy_from(source: Tensor, target: Tensor, non_blocking: bool = False) -> Tensor:
    return _dispatch(torch.ops.aten.copy_.default, (target, source, non_blocking), {})


def _casting(operator: torch._ops.OpOverload, dtype: torch.dtype | None) -> Callable[..., Any]:
    """Return an operation under autocast, in a dtype; None: in the one that autocast is set to."""
    only = torch._C.DispatchKeySet(torch._C.DispatchKey.AutocastPrivateUse1)

    def cast(*args: Any, **kwargs: Any) -> Any:
        wanted = dtype or torch.get_autocast_dtype(NAME)
        with torch._C._ExcludeDispatchKeyGuard(only):
            args, kwargs = _map_tensors(
                lambda tensor: tensor.to(wanted) if tensor.is_floating_point() else tensor, (args, kwargs)
            )
            return operator(*args, **kwargs)

    return cast


@contextmanager
def recorded_by(recorder: Recorder) -> Iterator[None]:
    """Have a recorder run what the device is given in a block."""
    before, _backend.recorder = _backend.recorder, recorder
    try:
        yield
    finally:
        _backend.recorder = before


@contextmanager
def pretended_device() -> Iterator[torch.device]:
    """Give torch the device for a block: modules move to it as to CUDA, memory can be pinned for it.

    What stays of it after the block changes nothing for tensors that are not on it.
    """
    _backend.register()
    pin_memory, swap = Tensor.pin_memory, torch.__future__.get_swap_module_params_on_conversion()
    supported = (torch_optimizer._foreach_supported_types, _foreach_utils._foreach_supported_types)
    Tensor.pin_memory = _pin
    # As with CUDA parameters stay the same objects when a module moves, and optimisers take lists of them.
    torch.__future__.set_swap_module_params_on_conversion(True)
    for types in {id(types): types for types in supported}.values():
        types.append(PretendedTensor)
    try:
        yield torch.device(_DEVICE)
    finally:
        Tensor.pin_memory = pin_memory
        torch.__future__.set_swap_module_params_on_conversion(swap)
        for types in {id(types): types for types in supported}.values():
            types.remove(PretendedTensor)


def _pin(tensor: Tensor, device: object = None) -> Tensor:
    pinned = tensor.clone()
    pinned.pretended_pin = True
    return pinned
