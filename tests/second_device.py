"""A second device: the GPU where there is one, and otherwise one that is pretended on the CPU.

The name of the pretended one is "meta", torch's device of tensors without values; but within `second_device` they have
values, on the CPU. What CUDA refuses is refused: an operation on tensors of both devices, unless the one on the CPU has
no axes, indexes the other, or is copied from or to it.
"""

import warnings
from contextlib import contextmanager
from functools import cache

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode, return_and_correct_aliasing
from torch.utils._pytree import tree_map

GPU = torch.cuda.is_available()
DEVICE = torch.device("cuda", 0) if GPU else torch.device("meta")

aten = torch.ops.aten
COPIES = (aten._to_copy.default, aten.copy_.default)
INDEXED = (aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._index_put_impl_.default)


@contextmanager
def second_device():
    """Within it, `policy.to(DEVICE)` moves a policy to the second device."""
    if GPU:
        yield
        return
    with warnings.catch_warnings(), _Creation(), _Operations():
        warnings.filterwarnings("ignore", ".*copying from a non-meta parameter")  # which would have no values
        yield


class Remote(Tensor):
    """A tensor on the second device."""

    local: Tensor  # its values

    @staticmethod
    def __new__(cls, values):
        like = {"strides": values.stride(), "dtype": values.dtype, "device": DEVICE}
        made = Tensor._make_wrapper_subclass(cls, values.shape, **like)
        made.local = values
        return made

    __torch_function__ = torch._C._disabled_torch_function_impl  # type: ignore[assignment]

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):  # type: ignore[override]
        return operate(function, args, kwargs or {})


class _Creation(TorchFunctionMode):
    """Tensors of Python numbers, which torch would create on "meta" without values."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        given = kwargs or {}
        if function is Tensor.new_tensor and isinstance(args[0], Remote):
            return torch.tensor(args[1], dtype=given.get("dtype", args[0].dtype)).to(DEVICE)
        if function in (torch.tensor, torch.as_tensor) and given.get("device") == DEVICE:
            return function(*args, **{**given, "device": None}).to(DEVICE)
        if function in (Tensor.__getitem__, Tensor.__setitem__):
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            listed = (torch.tensor(each, dtype=torch.long) if isinstance(each, list) else each for each in index)
            return function(args[0], tuple(listed), *args[2:])
        return function(*args, **given)


class _Operations(TorchDispatchMode):
    """All operations, also on no tensor."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return operate(function, args, kwargs or {})


def operate(function, args, kwargs):
    """The result of an operation, on the device where CUDA's would be; raises RuntimeError where CUDA would."""
    tensors = []

    def plain(given):
        if isinstance(given, Tensor):
            tensors.append(given)
            return given.local if isinstance(given, Remote) else given
        return type(given)(map(plain, given)) if isinstance(given, list | tuple) else given

    own, options = [plain(each) for each in args], {key: plain(value) for key, value in kwargs.items()}
    if any(each.device == DEVICE and not isinstance(each, Remote) for each in tensors):
        raise NotImplementedError(f"{function}: on a tensor that torch created without values")
    if function in INDEXED and isinstance(args[0], Remote):
        tensors = tensors[:1]
    remote = any(isinstance(each, Remote) for each in tensors)
    if remote and function not in COPIES and any(each.dim() and not isinstance(each, Remote) for each in tensors):
        shapes = ", ".join(f"{tuple(each.shape)} on {each.device}" for each in tensors)
        raise RuntimeError(f"{function}: tensors on two devices: {shapes}")
    if options.get("device") is not None:
        remote, options["device"] = options["device"] == DEVICE, torch.device("cpu")
    elif function in COPIES:
        remote = isinstance(args[0], Remote)
    out = function(*own, **options)
    if not remote:
        return out
    wrapped = Remote(out) if isinstance(out, Tensor) else tree_map(_remote, out)
    return return_and_correct_aliasing(function, args, kwargs, wrapped) if _aliases(function) else wrapped


def _remote(each):
    return Remote(each) if isinstance(each, Tensor) else each


@cache
def _aliases(function):
    """Whether what it returns is, or shares its memory with, what it is given."""
    return any(returned.alias_info is not None for returned in function._schema.returns)
