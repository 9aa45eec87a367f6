"""The compiled layers of per-pixel networks: builds `mlp_kernels.cpp` if there is a compiler, and calls it.

They are optional: without them, torch's operations compute the same, up to rounding.
"""

import ctypes
import functools
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float32, Int16, Int32, UInt8
from torch import Tensor, nn

from datagen.disk.storage import is_intact, make_private, sha256, user_cache, write_hashed
from datagen.terminal.command import say

SWITCH = "HYALINE_KERNELS"
"""Environment variable; `off` leaves everything to torch."""

SOURCE = Path(__file__).with_name("mlp_kernels.cpp")

FLAGS = ("-O3", "-march=native", "-std=c++17", "-fopenmp", "-shared", "-fPIC")

PADDING = 16
"""Rows of the library's arrays are zero-padded to a multiple of this."""

_POINTER, _LONG, _FLOAT, _INT = ctypes.c_void_p, ctypes.c_long, ctypes.c_float, ctypes.c_int


class _Made(ctypes.Structure):
    _fields_ = (("y", _POINTER), ("numbers", _POINTER), ("slope", _FLOAT), ("has_norm", _INT))


class _Norm(ctypes.Structure):
    _fields_ = (
        ("weight", _POINTER), ("bias", _POINTER), ("running_mean", _POINTER), ("running_variance", _POINTER),
        ("epsilon", _FLOAT), ("momentum", _FLOAT),
    )  # fmt: skip


class _Input(ctypes.Structure):
    _fields_ = (("x", _POINTER), ("made", ctypes.POINTER(_Made)), ("skip", ctypes.POINTER(_Made)))


NUM_NUMBERS = 6
"""Rows of `Made.numbers`."""


class Made:
    """A layer's output for a batch, and the norm and activation after it: leaky(scale * y + shift)."""

    def __init__(self, num_pixels: int, width: int, slope: float, *, has_norm: bool) -> None:
        self.has_norm = has_norm
        self.y = torch.empty(num_pixels, padded(width))
        self.numbers = torch.empty(NUM_NUMBERS, padded(width))
        """Scale and shift, and intermediate results for the backward pass."""
        self.record = _Made(self.y.data_ptr(), self.numbers.data_ptr(), slope, has_norm)


@dataclass(frozen=True, kw_only=True, eq=False)
class Source:
    """A layer's input: the network's input, or another layer's output, plus optionally that of a third one."""

    x: Float32[Tensor, "pixel c"] | None = None
    made: Made | None = None
    skip: Made | None = None

    def as_input(self) -> _Input:
        if self.made is None:
            assert self.x is not None
            return _Input(self.x.data_ptr(), None, None)
        skip = None if self.skip is None else ctypes.pointer(self.skip.record)
        return _Input(None, ctypes.pointer(self.made.record), skip)


@dataclass(frozen=True, kw_only=True, eq=False)
class Gradients:
    """The gradients of a layer."""

    source: Float32[Tensor, "pixel c_padded"] | None
    weight: Float32[Tensor, "c_out c_in"]
    bias: Float32[Tensor, " c_out"]
    norm: tuple[Float32[Tensor, " c_in"], Float32[Tensor, " c_in"]] | None
    """Gradients of weight and bias of the batch norm after the source; None without one."""


class _FoldedLayer(ctypes.Structure):
    _fields_ = (
        ("inputs", _LONG), ("outputs", _LONG), ("weight", _POINTER), ("bias", _POINTER), ("slope", _FLOAT),
        ("adds", _INT),
    )  # fmt: skip


class _Stacks(ctypes.Structure):
    _fields_ = (
        ("uv", _POINTER), ("object_id", _POINTER), ("pixel_step", _LONG), ("layer_step", _LONG), ("layers", _LONG),
        ("features", _LONG),
        ("texels", _POINTER), ("places", _POINTER), ("positions", _POINTER), ("position_places", _POINTER),
        ("camera", _POINTER), ("objects", _LONG), ("pixels_per_view", _LONG),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True, eq=False)
class FoldedLayer:
    """A layer of a trained network, with its batch norm folded in."""

    weight: Float32[Tensor, "c_out c_in"]
    bias: Float32[Tensor, " c_out"]
    slope: float = 1.0
    """Slope of the LeakyReLU below zero; 1 without one."""
    adds: bool = False
    """Add the output of the layer two before to this layer's."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Stacks:
    """The stored layers of pixels, and the renderer's tables."""

    uv: Int16[Tensor, "pixel layer 2"]
    """The bits of uint16."""
    object_id: UInt8[Tensor, "pixel layer"]
    texels: Float32[Tensor, "texel c"]
    places: Int32[np.ndarray, "3 object"]
    """First row, size and stride of each object's texture."""
    positions: Float32[Tensor, "place 3"] | None
    """World positions on the surfaces, for view vectors after the features; None without view vectors."""
    position_places: Int32[np.ndarray, "3 object"] | None
    p_camera: Float32[Tensor, "view 3"]
    pixels_per_view: int


class Network:
    """Folded layers as the library reads them."""

    def __init__(self, layers: Sequence[FoldedLayer]) -> None:
        self.inputs, self.outputs = layers[0].weight.shape[1], layers[-1].weight.shape[0]
        # Keeps the memory alive that the structures point to.
        self._weights = [_packed(layer) for layer in layers]
        self._biases = [pad(layer.bias.numpy()) for layer in layers]
        self.array = (_FoldedLayer * len(layers))(
            *(
                _FoldedLayer(*layer.weight.shape[::-1], weight.data_ptr(), _address(bias), layer.slope, layer.adds)
                for layer, weight, bias in zip(layers, self._weights, self._biases, strict=True)
            )
        )


class Kernels:
    """The compiled library."""

    def __init__(self, library: ctypes.CDLL) -> None:
        self._forward = library.mlp_layer_forward
        self._forward.argtypes = [_LONG, _LONG, _LONG, *[_POINTER] * 5, _INT]
        self._forward.restype = None
        self._backward = library.mlp_layer_backward
        self._backward.argtypes = [_LONG, _LONG, _LONG, *[_POINTER] * 10, _INT]
        self._backward.restype = None
        self._draw = library.mlp_draw
        self._draw_stacks = library.mlp_draw_stacks
        for function in (self._draw, self._draw_stacks):
            function.argtypes = [_LONG, _POINTER, _POINTER, _LONG, _POINTER, _INT]
            function.restype = None

    def forward(self, source: Source, linear: nn.Linear, norm: nn.BatchNorm1d | None, slope: float) -> Made:
        """A linear layer of a batch; updates the running statistics of the batch norm after it."""
        given = source.x if source.made is None else source.made.y
        assert given is not None
        made = Made(len(given), linear.out_features, slope, has_norm=norm is not None)
        record = None
        if norm is not None:
            assert norm.running_mean is not None
            assert norm.running_var is not None
            assert norm.momentum is not None
            record = ctypes.byref(
                _Norm(
                    norm.weight.data_ptr(),
                    norm.bias.data_ptr(),
                    norm.running_mean.data_ptr(),
                    norm.running_var.data_ptr(),
                    norm.eps,
                    norm.momentum,
                )
            )
        self._forward(
            len(given), linear.in_features, linear.out_features, ctypes.byref(source.as_input()),
            linear.weight.data_ptr(), linear.bias.data_ptr(), record, ctypes.byref(made.record),
            torch.get_num_threads(),
        )  # fmt: skip
        return made

    def backward(
        self,
        source: Source,
        linear: nn.Linear,
        made: Made | None,
        upstream: Tensor,
        *,
        needs_source: bool,
        further: Tensor | None,
    ) -> Gradients:
        """The gradients of a layer's source (with `further` added), weight and bias.

        Args:
            made: the layer's output, with `upstream` the gradient after norm and activation; None for a layer without
                them, with `upstream` the gradient of its output, (pixel, c_out).
        """
        outputs, inputs = linear.weight.shape
        gradients = Gradients(
            source=torch.empty(len(upstream), padded(inputs)) if needs_source else None,
            weight=torch.empty(outputs, inputs),
            bias=torch.empty(outputs),
            norm=(torch.empty(inputs), torch.empty(inputs)) if source.made and source.made.has_norm else None,
        )
        of_norm = (None, None) if gradients.norm is None else [tensor.data_ptr() for tensor in gradients.norm]
        self._backward(
            len(upstream), inputs, outputs, ctypes.byref(source.as_input()), linear.weight.data_ptr(),
            None if made is None else ctypes.byref(made.record), upstream.data_ptr(),
            None if gradients.source is None else gradients.source.data_ptr(),
            None if further is None else further.data_ptr(), gradients.weight.data_ptr(), gradients.bias.data_ptr(),
            *of_norm, torch.get_num_threads(),
        )  # fmt: skip
        return gradients

    def draw(self, network: Network, x: Float32[Tensor, "pixel c_in"]) -> Float32[Tensor, "pixel c_out"]:
        """The output of a network."""
        assert x.shape[1] == network.inputs
        x, made = x.contiguous(), torch.empty(len(x), network.outputs)
        self._draw(len(x), x.data_ptr(), network.array, len(network.array), made.data_ptr(), torch.get_num_threads())
        return made

    def draw_stacks(self, network: Network, stacks: Stacks) -> Float32[Tensor, "pixel 3"]:
        """The colours of a network with three outputs for stacked layers, whose features it looks up.

        If the network has more inputs than the stacks have channels, the rest are zeros (an empty layer).
        """
        num_pixels, num_layers = stacks.object_id.shape
        features = stacks.texels.shape[1]
        channels = features + (0 if stacks.positions is None else 3)
        uv, object_id = stacks.uv, stacks.object_id
        pixel_step, layer_step = object_id.stride()
        if uv.stride() != (2 * pixel_step, 2 * layer_step, 1):
            uv, object_id, pixel_step, layer_step = uv.contiguous(), object_id.contiguous(), num_layers, 1
        assert num_layers * channels <= network.inputs and network.outputs == 3
        assert stacks.texels.is_contiguous() and stacks.p_camera.is_contiguous()
        array = _Stacks(
            uv.data_ptr(), object_id.data_ptr(), pixel_step, layer_step, num_layers, features,
            stacks.texels.data_ptr(), _address(stacks.places),
            None if stacks.positions is None else stacks.positions.data_ptr(), _address(stacks.position_places),
            stacks.p_camera.data_ptr(), stacks.places.shape[1], stacks.pixels_per_view,
        )  # fmt: skip
        colors = torch.empty(num_pixels, 3)
        self._draw_stacks(
            num_pixels,
            ctypes.byref(array),
            network.array,
            len(network.array),
            colors.data_ptr(),
            torch.get_num_threads(),
        )
        return colors


def _packed(layer: FoldedLayer) -> Float32[Tensor, "c_in c_out_padded"]:
    """A weight in the library's layout."""
    outputs, inputs = layer.weight.shape
    packed = torch.zeros(inputs, padded(outputs))
    packed[:, :outputs] = layer.weight.T
    return packed


def padded(width: int) -> int:
    """The width of a row of the library's arrays."""
    return -(-width // PADDING) * PADDING


def pad(values: np.ndarray) -> Float32[np.ndarray, " c_padded"]:
    """Values of all channels, zero-padded for the library."""
    result = np.zeros(padded(len(values)), np.float32)
    result[: len(values)] = values
    return result


@functools.cache
def find_kernels() -> Kernels | None:
    """The compiled layers, built at their first use on a machine; None if they are not available."""
    if os.environ.get(SWITCH) == "off" or platform.system() != "Linux" or platform.machine() != "x86_64":
        return None
    compiler = os.environ.get("CXX") or shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        return None
    try:
        version = subprocess.run([compiler, "--version"], capture_output=True, text=True, timeout=60, check=True).stdout
        key = sha256(repr((SOURCE.read_text(), version, FLAGS, _processor())).encode())[:32]
        return Kernels(_load(compiler, user_cache("kernels"), key))
    except (OSError, subprocess.SubprocessError, AttributeError) as error:
        words = (getattr(error, "stderr", None) or str(error)).strip().partition("\n")[0]
        say(f"the compiled layers cannot be built, so torch runs the networks: {words}; {SWITCH}=off hides this")
        return None


def _load(compiler: str, cache: Path, key: str) -> ctypes.CDLL:
    """The library from the cache, built if it is missing or cannot be trusted.

    A truncated library kills the process with a bus error, and any library runs as code. So it is only loaded if this
    user wrote it, to a folder that no other user can write to, and if its checksum matches.
    """
    if (wrong := make_private(cache)) is not None:
        say(f"{wrong}; the compiled layers are built for this run only")
        with tempfile.TemporaryDirectory() as folder:  # A library that is loaded needs its file no longer.
            return ctypes.CDLL(str(_build(compiler, Path(folder) / f"{key}.so")))
    path = cache / f"mlp-{key}.so"
    if not is_intact(path):
        if path.exists():
            say(f"{path}: damaged, or not written by this user; building the compiled layers again")
        with tempfile.TemporaryDirectory() as folder:
            write_hashed(path, _build(compiler, Path(folder) / path.name).read_bytes())
    return ctypes.CDLL(str(path))


def _build(compiler: str, path: Path) -> Path:
    subprocess.run(
        [compiler, *FLAGS, str(SOURCE), "-o", str(path)], capture_output=True, text=True, timeout=300, check=True
    )
    return path


def _processor() -> str:
    """The processor's features, because different machines may share a cache."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    return next((line for line in lines if line.startswith("flags")), "")


def _address(values: np.ndarray | None) -> int | None:
    return None if values is None else values.ctypes.data
