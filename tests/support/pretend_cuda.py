"""A GPU that is only pretended: tensors that say they are on cuda:0, and are computed on the CPU.

Tensors of both devices in one operation are an error, as on a GPU. To torch's own C++ these tensors are on the CPU,
which has a device guard and an autograd engine in every build.
"""

import contextlib
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

CUDA, CPU = torch.device("cuda:0"), torch.device("cpu")

aten = torch.ops.aten
OF_BOTH = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
"""Operations that take indices from the other device, which they copy first."""
FROM_DATA = {torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor}


class PretendTensor(Tensor):
    """A tensor that says it is on cuda:0; `inner` has its values, on the CPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> "PretendTensor":
        make = Tensor._make_wrapper_subclass  # pyright: ignore[reportAttributeAccessIssue]
        return make(cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype)

    def __init__(self, inner: Tensor) -> None:
        self.inner = inner

    @property
    def device(self) -> torch.device:
        return CUDA

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _compute(func, args, kwargs or {})

    __torch_function__ = torch._C._disabled_torch_function_impl


def _compute(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Computes an operation on the CPU, unless tensors of both devices meet in it."""
    packet = func.overloadpacket
    node = torch._C._current_autograd_node()
    # Autograd's C++ makes zeros for parts of an `unbind` that have no gradient, on the device that it knows: the CPU.
    is_filled = node is not None and node.name() == "UnbindBackward0"
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor) and leaf.dim() > 0]
    is_mixed = not is_filled and not all(map(_is_ours, tensors))
    if is_mixed and packet is not aten.copy_ and packet not in OF_BOTH:
        raise RuntimeError(f"{func}: tensors on cuda:0 and on the CPU")
    inner_args, inner_kwargs = tree_map(lambda leaf: leaf.inner if _is_ours(leaf) else leaf, (args, kwargs))
    found = func(*inner_args, **inner_kwargs)
    if packet is aten.copy_ and not _is_ours(args[0]):
        return found
    wrapped = tree_map(lambda leaf: PretendTensor(leaf) if isinstance(leaf, Tensor) else leaf, found)
    return return_and_correct_aliasing(func, args, kwargs, wrapped)


def _is_ours(leaf: object) -> bool:
    return isinstance(leaf, PretendTensor)


class _Pretending(TorchFunctionMode):
    """Takes cuda:0 for a device wherever the program names one."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        if args and isinstance(args[0], Tensor) and name in ("to", "cpu", "tolist", "numpy", "pin_memory"):
            return self._move(func, name, args, kwargs)
        if func is functional.embedding_bag and args[0].dim() == 2 and _is_ours(args[0]):
            # Its Python makes offsets on the device, unseen by this mode.
            kwargs["offsets"] = _wrap(torch.arange(0, args[0].numel(), args[0].shape[1]))
            kwargs["per_sample_weights"] = kwargs["per_sample_weights"].reshape(-1)
            return func(args[0].reshape(-1), *args[1:], **kwargs)
        device = kwargs.get("device")
        is_named = device is not None and torch.device(device).type == "cuda"
        is_new = func is Tensor.new_tensor and _is_ours(args[0])
        if not (is_named or is_new):
            return func(*args, **kwargs)
        if args and _is_ours(args[0]) and func not in FROM_DATA:
            del kwargs["device"]
            return func(*args, **kwargs)
        data = args[1] if is_new else args[0] if args else None
        if func in FROM_DATA and _is_ours(data):
            return data
        kwargs = {**kwargs, **({"device": CPU} if is_named else {})}
        made = func(*((torch.empty(0, dtype=args[0].dtype), *args[1:]) if is_new else args), **kwargs)
        return _wrap(made)

    def _move(self, func: Any, name: str, args: Any, kwargs: dict[str, Any]) -> Any:
        tensor, device, dtype = args[0], None, None
        if name == "to":
            if isinstance(args[1] if len(args) > 1 else None, Tensor):
                device, dtype = args[1].device, args[1].dtype
            else:
                device, dtype, _, _ = torch._C._nn._parse_to(*args[1:], **kwargs)
        elif name == "pin_memory":
            return tensor
        elif not _is_ours(tensor):
            return func(*args, **kwargs)
        elif name == "numpy":
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        else:
            device = CPU
        is_ours = _is_ours(tensor)
        if device is None or (device.type == "cuda") == is_ours:
            return tensor if dtype is None else tensor.to(dtype)
        if is_ours:
            there = tensor.inner.detach()
            return there.tolist() if name == "tolist" else there if dtype is None else there.to(dtype)
        here = _wrap(tensor.detach().clone())
        return here if dtype is None else here.to(dtype)


def _wrap(inner: Tensor) -> Tensor:
    requires_grad, inner = inner.requires_grad, inner.detach()
    return PretendTensor(inner).requires_grad_(requires_grad)


@contextlib.contextmanager
def pretended_cuda() -> Iterator[None]:
    """Lets tensors be on cuda:0 within the block, on machines without a GPU."""
    kept = torch._C._InferenceMode, torch.random.fork_rng, ThreadPoolExecutor.submit

    def submit(pool: ThreadPoolExecutor, call: Any, *args: Any, **more: Any) -> Future[Any]:
        """Modes belong to threads: another one pretends by itself."""

        def run() -> Any:
            with _Pretending():
                return call(*args, **more)

        return kept[2](pool, run)

    ThreadPoolExecutor.submit = submit
    # Subclasses of tensors cannot change in inference mode.
    torch._C._InferenceMode = lambda mode: torch.no_grad() if mode else contextlib.nullcontext()
    torch.random.fork_rng = lambda devices=(), **more: kept[1](devices=[], **more)
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    try:
        with _Pretending():
            yield
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(False)
        torch._C._InferenceMode, torch.random.fork_rng, ThreadPoolExecutor.submit = kept
        torch.use_deterministic_algorithms(False)  # Training on a GPU asks for them.
