"""Code for a GPU that may be captured in a CUDA graph: nothing in it waits for the device or copies to or from it."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

OPERATIONS = {
    "_local_scalar_dense", "item", "is_nonzero", "equal", "allclose", "nonzero", "nonzero_numpy", "argwhere",
    "masked_select", "_unique", "_unique2", "unique_dim", "unique_consecutive", "unique_dim_consecutive",
    "bincount", "_coalesce",
}  # fmt: skip
"""Operations whose result, or its size, the host has to know."""
CALLS = {
    "item", "tolist", "numpy", "cpu", "__bool__", "__float__", "__int__", "__index__", "__array__", "__contains__",
    "tensor", "as_tensor", "from_numpy", "new_tensor",
}  # fmt: skip
"""What Python calls for that, or to bring values of the host to the device. On a CPU some of it is no operation."""


class HostQuestion(AssertionError):
    """Code that should leave the device alone would wait for it."""


@contextmanager
def no_host_questions() -> Iterator[None]:
    """Raise :class:`HostQuestion` at whatever would wait for a GPU, in backward passes too; it works on a CPU as well.

    Launches by other libraries, and what they do with a tensor's address, are not seen.
    """
    with _Calls(), _Operations():
        yield


class _Calls(TorchFunctionMode):
    def __torch_function__(self, func, types, args=(), kwargs=None):
        name = getattr(func, "__name__", "")
        if name in CALLS:
            raise HostQuestion(f"{name}: the host reads from the device or writes to it")
        return func(*args, **(kwargs or {}))


class _Operations(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        name = func._schema.name.removeprefix("aten::")
        if name.rstrip("_") in {operation.rstrip("_") for operation in OPERATIONS}:
            raise HostQuestion(f"{name}: the host has to know the result or its size")
        if name == "repeat_interleave" and func._overloadname == "Tensor" and kwargs.get("output_size") is None:
            raise HostQuestion("repeat_interleave: the size of the result is not known; give output_size")
        if name.rstrip("_") in ("index", "index_put", "_index_put_impl", "_unsafe_index") and _by_mask(args):
            raise HostQuestion(f"{name} by a mask: the host has to count its entries")
        if name in ("copy_", "_to_copy"):
            devices = {x.device.type for x in args if isinstance(x, torch.Tensor)}
            if kwargs.get("device") is not None:
                devices.add(torch.device(kwargs["device"]).type)
            if len(devices) > 1:
                raise HostQuestion(f"{name} between {' and '.join(sorted(devices))}")
        return func(*args, **kwargs)


def _by_mask(args) -> bool:
    """Whether entries are picked by masks; a mask with one value for all of them needs no counting."""
    masks = [x for x in args[1] if isinstance(x, torch.Tensor) and x.dtype in (torch.bool, torch.uint8)]
    filled = len(args) > 2 and args[2].numel() == 1 and len(masks) == 1 == len([x for x in args[1] if x is not None])
    return bool(masks) and not filled
