"""A GPU that is only pretended: tensors that say they are on cuda:0, are computed on the CPU, and are counted.

What torch would launch, copy and wait for on a GPU follows from its operations, which need no GPU to be seen:

- a launch is an operation that computes on the GPU: one each, where torch may take several kernels. Views, and memory
  that is left uninitialised, take none;
- a wait stops Python until the GPU is done: a copy to or from pageable memory, a number that is read (`.item()`), an
  operation whose result's size depends on its values (`nonzero`, masks as indices);
- tensors of both devices in one operation are an error, as on a GPU.

To torch's own C++ these tensors are on the CPU, which has a device guard and an autograd engine in every build.
"""

import collections
import contextlib
import sys
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import return_and_correct_aliasing
from torch.utils._pytree import tree_leaves, tree_map

CUDA, CPU = torch.device("cuda:0"), torch.device("cpu")
ROOT = Path(__file__).resolve().parents[2]

aten = torch.ops.aten
WAITS = {
    aten._local_scalar_dense,
    aten.nonzero,
    aten.masked_select,
    aten.equal,
    aten.is_nonzero,
    aten._unique2,
    aten.unique_dim,
    aten.unique_consecutive,
    aten.repeat_interleave,
    aten.bincount,
}
"""Operations whose result Python or the allocator must know before anything goes on."""
OF_BOTH = {aten.index, aten.index_put, aten.index_put_, aten._index_put_impl_}
"""Operations that take indices from the other device, which they copy first."""
UNWRITTEN = {aten.empty, aten.empty_like, aten.empty_strided, aten.new_empty, aten.new_empty_strided, aten.detach}
"""Memory without content, or without a kernel."""
FROM_DATA = {torch.tensor, torch.as_tensor, torch.asarray, Tensor.new_tensor}


@dataclass(kw_only=True)
class Counts:
    """What a GPU would have been asked for, by the line of the program that asked."""

    launches: collections.Counter[str] = field(default_factory=collections.Counter)
    waits: collections.Counter[str] = field(default_factory=collections.Counter)
    copied: collections.Counter[str] = field(default_factory=collections.Counter)
    """Bytes to and from the CPU."""

    def copy(self, num_bytes: int, what: str, *, waits: bool = True) -> None:
        """Counts a copy between the devices."""
        where = f"{_line()} {what}"
        self.waits[where] += waits
        self.copied[where] += num_bytes

    def totals(self) -> tuple[int, int, int]:
        """Launches, waits, and bytes copied."""
        return self.launches.total(), self.waits.total(), self.copied.total()

    def __str__(self) -> str:
        """The lines that ask for most."""
        kinds = {"launches": self.launches, "waits": self.waits, "bytes": self.copied}
        return "\n".join(
            f"{count:9,} {kind:8} {line}" for kind, of in kinds.items() for line, count in of.most_common(15)
        )


class PretendTensor(Tensor):
    """A tensor that says it is on cuda:0; `inner` has its values, on the CPU."""

    inner: Tensor
    counts: Counts

    @staticmethod
    def __new__(cls, inner: Tensor, counts: Counts) -> "PretendTensor":
        make = Tensor._make_wrapper_subclass  # pyright: ignore[reportAttributeAccessIssue]
        return make(cls, inner.size(), strides=inner.stride(), storage_offset=inner.storage_offset(), dtype=inner.dtype)

    def __init__(self, inner: Tensor, counts: Counts) -> None:
        self.inner, self.counts = inner, counts

    @property
    def device(self) -> torch.device:
        return CUDA

    @property
    def is_cuda(self) -> bool:
        return True

    def __repr__(self, *, tensor_contents: object = None) -> str:
        return f"PretendTensor({self.inner!r})"

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        counts = next(leaf.counts for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, PretendTensor))
        return _compute(func, args, kwargs or {}, counts)

    __torch_function__ = torch._C._disabled_torch_function_impl


def _compute(func: Any, args: Any, kwargs: dict[str, Any], counts: Counts) -> Any:
    """Computes an operation on the CPU, and counts what it would do on the GPU."""
    packet = func.overloadpacket
    plain = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, Tensor) and not _is_ours(leaf)]
    node = torch._C._current_autograd_node()
    # Autograd's C++ makes zeros for parts of an `unbind` that have no gradient, on the device that it knows: the CPU.
    is_filled = node is not None and node.name() == "UnbindBackward0"
    foreign = [] if is_filled else [leaf for leaf in plain if leaf.dim() > 0]
    if foreign and packet is aten.copy_:
        counts.copy(foreign[0].nbytes, "copy_")
    elif foreign and packet in OF_BOTH:
        counts.copy(sum(leaf.nbytes for leaf in foreign), "indices on the CPU")
    elif foreign:
        raise RuntimeError(f"{func} at {_line()}: tensors on cuda:0 and on the CPU")
    masks = [leaf for leaf in tree_leaves(args[1:2]) if isinstance(leaf, Tensor) and leaf.dtype == torch.bool]
    if packet in WAITS or (packet in OF_BOTH and masks):
        counts.copy(8, str(packet))
    if not func.is_view and packet not in UNWRITTEN:
        counts.launches[f"{_line()} {packet}"] += 1
    inner_args, inner_kwargs = tree_map(lambda leaf: leaf.inner if _is_ours(leaf) else leaf, (args, kwargs))
    found = func(*inner_args, **inner_kwargs)
    if packet is aten.copy_ and not _is_ours(args[0]):
        return found
    wrapped = tree_map(lambda leaf: PretendTensor(leaf, counts) if isinstance(leaf, Tensor) else leaf, found)
    return return_and_correct_aliasing(func, args, kwargs, wrapped)


def _is_ours(leaf: object) -> bool:
    return isinstance(leaf, PretendTensor)


class _Pretending(TorchFunctionMode):
    """Takes cuda:0 for a device wherever the program names one."""

    def __init__(self, counts: Counts) -> None:
        super().__init__()
        self.counts = counts

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(func, "__name__", "")
        if args and isinstance(args[0], Tensor) and name in ("to", "cpu", "cuda", "tolist", "numpy", "pin_memory"):
            return self._move(func, name, args, kwargs)
        if func is functional.embedding_bag and args[0].dim() == 2 and _is_ours(args[0]):
            # Its Python makes offsets on the device, unseen by this mode.
            self.counts.launches[f"{_line()} arange"] += 1
            kwargs["offsets"] = self._wrap(torch.arange(0, args[0].numel(), args[0].shape[1]))
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
        if func in FROM_DATA:
            self.counts.copy(made.nbytes, name)
        elif name != "empty":
            self.counts.launches[f"{_line()} {name}"] += 1
        return self._wrap(made)

    def _move(self, func: Any, name: str, args: Any, kwargs: dict[str, Any]) -> Any:
        tensor, device, dtype = args[0], None, None
        if name == "to":
            if isinstance(args[1] if len(args) > 1 else None, Tensor):
                device, dtype = args[1].device, args[1].dtype
            else:
                device, dtype, _, _ = torch._C._nn._parse_to(*args[1:], **kwargs)
        elif name == "cuda":
            device = CUDA
        elif name == "pin_memory":
            tensor.was_pinned = True
            return tensor
        elif not _is_ours(tensor):
            return func(*args, **kwargs)
        elif name == "numpy":
            raise TypeError(f"{_line()}: can't convert cuda:0 device type tensor to numpy")
        else:
            device = CPU
        is_ours = _is_ours(tensor)
        if device is None or (device.type == "cuda") == is_ours:
            return tensor if dtype is None else tensor.to(dtype)
        if is_ours:
            self.counts.copy(tensor.nbytes, name)
            there = tensor.inner.detach()
            return there.tolist() if name == "tolist" else there if dtype is None else there.to(dtype)
        is_pinned = getattr(tensor, "was_pinned", False) and kwargs.get("non_blocking", False)
        self.counts.copy(tensor.nbytes, name, waits=not is_pinned)
        here = self._wrap(tensor.detach().clone())
        return here if dtype is None else here.to(dtype)

    def _wrap(self, inner: Tensor) -> Tensor:
        requires_grad, inner = inner.requires_grad, inner.detach()
        return PretendTensor(inner, self.counts).requires_grad_(requires_grad)


def _line() -> str:
    """The line of the program that asked; of a gradient, the operation that it belongs to."""
    node = torch._C._current_autograd_node()
    frame = sys._getframe(1)
    while frame is not None:
        name = frame.f_code.co_filename
        if name.startswith(str(ROOT)) and "/tests/" not in name and "/.venv/" not in name:
            line = f"{name[len(str(ROOT)) + 1 :]}:{frame.f_lineno}"
            return line if node is None else f"{line} gradient, {node.name()}"
        frame = frame.f_back
    return "outside of the program"


@contextlib.contextmanager
def pretended_cuda() -> Iterator[Counts]:
    """Lets tensors be on cuda:0 within the block, on machines without a GPU, and counts what they do there."""
    counts = Counts()
    kept = torch._C._InferenceMode, torch.random.fork_rng, ThreadPoolExecutor.submit

    def submit(pool: ThreadPoolExecutor, call: Any, *args: Any, **more: Any) -> Future[Any]:
        """Modes belong to threads: another one pretends by itself."""

        def run() -> Any:
            with _Pretending(counts):
                return call(*args, **more)

        return kept[2](pool, run)

    ThreadPoolExecutor.submit = submit
    # Subclasses of tensors cannot change in inference mode.
    torch._C._InferenceMode = lambda mode: torch.no_grad() if mode else contextlib.nullcontext()
    torch.random.fork_rng = lambda devices=(), **more: kept[1](devices=[], **more)
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    try:
        with _Pretending(counts):
            yield counts
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(False)
        torch._C._InferenceMode, torch.random.fork_rng, ThreadPoolExecutor.submit = kept
        torch.use_deterministic_algorithms(False)  # Training on a GPU asks for them.
