"""The best this machine can do at what the renderers need, as torch reaches it."""

import mmap

import torch
from torch.nn.functional import linear

from benchmarks.harness import BenchReport, Ceiling, best_seconds, machine_ceilings, measure

FAULTED = 64 << 20
"""Bytes of the block that is written with and without page faults."""


def all_ceilings() -> tuple[Ceiling, ...]:
    """Those that any bench prints, and torch's: matrix products in both precisions, and what page faults cost."""
    return (
        *machine_ceilings(),
        Ceiling(name="float32 matrix product, torch, all cores", value=_product(torch.float32), unit="GFLOP/s"),
        Ceiling(name="bfloat16 matrix product, torch, all cores", value=_product(torch.bfloat16), unit="GFLOP/s"),
        Ceiling(name="float32 layer of the network, all cores", value=_layer(torch.float32), unit="GFLOP/s"),
        Ceiling(name="bfloat16 layer of the network, all cores", value=_layer(torch.bfloat16), unit="GFLOP/s"),
        Ceiling(name="writing fresh memory, page faults included", value=_faults(), unit="times as long"),
    )


def bench_ceilings() -> BenchReport:
    """The ceilings alone."""
    settings = {"threads": torch.get_num_threads(), "torch": torch.__version__}
    return measure("ceilings", [], ceilings=all_ceilings(), settings=settings)


@torch.inference_mode()
def _product(dtype: torch.dtype) -> float:
    size = 1536
    a, b = torch.ones(2, size, size, dtype=dtype)
    return 2 * size**3 / best_seconds(lambda: a @ b) * 1e-9


@torch.inference_mode()
def _layer(dtype: torch.dtype) -> float:
    pixels, inputs, outputs = 65_536, 96, 88
    x, weight = torch.ones(pixels, inputs, dtype=dtype), torch.ones(outputs, inputs, dtype=dtype)
    bias = torch.zeros(outputs, dtype=dtype)
    return 2 * pixels * inputs * outputs / best_seconds(lambda: linear(x, weight, bias)) * 1e-9


def _faults() -> float:
    """How much longer a block takes to write when each of its pages must first be fetched from the kernel."""
    ones = torch.ones(FAULTED, dtype=torch.uint8)
    kept = torch.zeros_like(ones)

    def write_fresh() -> None:
        torch.frombuffer(mmap.mmap(-1, FAULTED), dtype=torch.uint8).copy_(ones)

    return best_seconds(write_fresh) / best_seconds(lambda: kept.copy_(ones))
