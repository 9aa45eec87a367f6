"""Where torch computes; settings of the C libraries beneath it and Numba that keep training fast and repeatable."""

import contextlib
import ctypes
import os
import warnings
from collections.abc import Iterator
from typing import TYPE_CHECKING, get_args

from datagen.disk.errors import HyalineError
from datagen.terminal.command import choose
from model.settings import Device

if TYPE_CHECKING:
    import torch

M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_MAX = -1, -2, -4


def keep_freed_memory() -> None:
    """Tells glibc to keep freed blocks for the next step; does nothing where there is no glibc.

    By default glibc returns every large tensor to the kernel when it is freed, and the next step pays a page fault for
    each 4 KiB again (measured: Linear 2.6 times, LeakyReLU 4.2 times slower).
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_MMAP_MAX, 0)
        mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        mallopt(M_TOP_PAD, 256 << 20)


def wait_briefly() -> None:
    """Lets torch's idle threads sleep after some ten microseconds; call it before torch is imported.

    By default they spin for milliseconds while they wait for each other. As soon as another process wants the cores as
    well, that eats them up: measured on two cores shared with two renderers, a training step took 4 times longer. Where
    they sleep at once, each operation has to wake them: a frame of 262,144 pixels took a tenth longer, alone or not.
    """
    if not os.environ.keys() & {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}:
        os.environ |= {"OMP_WAIT_POLICY": "PASSIVE", "GOMP_SPINCOUNT": "5000"}


def sum_in_order_on_gpus() -> None:
    """Makes torch use CUDA algorithms that repeat bit by bit, where it has them; call it before CUDA is used.

    By default gradients of texels are summed in whatever order a GPU's threads finish. Where no algorithm
    repeats (for the reflected borders of DeepVoxels), the usual one is used without a warning.
    """
    import torch

    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # cuBLAS asks for it.
    warnings.filterwarnings("ignore", message=".*does not have a deterministic implementation")
    torch.use_deterministic_algorithms(True, warn_only=True)
    # Else each `empty` costs a launch.
    torch.utils.deterministic.fill_uninitialized_memory = False  # pyright: ignore[reportAttributeAccessIssue]


def start_numba_threads() -> None:
    """Starts as many of Numba's threads as torch has.

    Both share one OpenMP, whose number of threads Numba sets to that of all cores as soon as its first loop runs: torch
    would go on with another number than it was told, and sums over pixels would round in another way.
    """
    import numba
    import torch

    threads = torch.get_num_threads()
    numba.set_num_threads(min(threads, numba.get_num_threads()))
    torch.set_num_threads(threads)


PIXELS_A_THREAD = 8192
"""Least pixels of an update for each thread. Measured on two cores that others also used: the steps of `light-path`
(512 pixels an update) took two and a half times the processor time with two threads, those of `paper` (8,192) 1.7
times, and both took longer."""


def use_few_threads(pixels: int) -> None:
    """Limits torch's and Numba's threads to those that an update of this many pixels keeps busy.

    OMP_NUM_THREADS in the environment overrules this.
    """
    import torch

    if "OMP_NUM_THREADS" not in os.environ:
        torch.set_num_threads(max(1, min(torch.get_num_threads(), pixels // PIXELS_A_THREAD)))
        start_numba_threads()


@contextlib.contextmanager
def leaving_settings() -> Iterator[None]:
    """Leaves the process as it was: numbers of torch's and Numba's threads, and torch's deterministic mode."""
    import numba
    import torch

    threads, loops = torch.get_num_threads(), numba.get_num_threads()
    in_order, warns = (
        torch.are_deterministic_algorithms_enabled(),
        torch.is_deterministic_algorithms_warn_only_enabled(),
    )
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(in_order, warn_only=warns)
        numba.set_num_threads(loops)
        torch.set_num_threads(threads)


def choose_device(name: Device) -> "torch.device":
    """The device that `--device` means.

    Raises:
        HyalineError: there is no GPU, but one was asked for; or another name.
    """
    import torch

    choose("device", name, get_args(Device))
    if name == "cuda" and not torch.cuda.is_available():
        raise HyalineError("device: torch finds no CUDA device; use --device cpu")
    return torch.device("cuda" if name != "cpu" and torch.cuda.is_available() else "cpu")
