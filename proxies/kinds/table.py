"""The kinds of proxies: a new one is a file beside this one, and its lines here."""

import importlib
from collections.abc import Callable
from typing import Literal

from datagen.data.meshes import Mesh
from proxies.meshing.solid import Solid

ProxyKind = Literal["box", "ellipsoid", "hull", "lowpoly", "wrap", "blocks", "noise"]
"""All of them. `noise` is no fit: it moves the vertices of the true meshes (proxies/meshing/noise.py)."""

Fitter = Callable[[tuple[Solid, ...], tuple[float, ...]], tuple[Mesh, ...]]


def _together(file: str, name: str) -> Fitter:
    """Calls a function for all objects at once, such as one that starts another program for them."""

    def fit(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
        return getattr(importlib.import_module(f"proxies.kinds.{file}"), name)(solids, paddings)

    return fit


def _one_by_one(file: str, name: str) -> Fitter:
    """Calls a function for each object: `name(solid, padding=...)`."""

    def fit(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
        fit_one = getattr(importlib.import_module(f"proxies.kinds.{file}"), name)
        return tuple(fit_one(solid, padding=padding) for solid, padding in zip(solids, paddings, strict=True))

    return fit


FITTERS: dict[ProxyKind, Fitter] = {
    "box": _one_by_one("box", "fit_box"),
    "ellipsoid": _one_by_one("ellipsoid", "fit_ellipsoid"),
    "hull": _together("hull", "fit_hulls"),
    "lowpoly": _together("wrap", "fit_lowpolys"),
    "wrap": _together("wrap", "fit_wraps"),
    "blocks": _together("blocks", "fit_blocks"),
}
"""`FITTERS[kind](solids, paddings)` are closed, outward meshes with a uv of its own for every surface point.

Each encloses its solid and stands off by its padding in metres. A kind's file is imported when it is first fitted.
"""
