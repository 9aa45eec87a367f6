"""Which proxies to make: one kind for all objects, or a mixture that names a kind for each object."""

import importlib
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import cast

from datagen.data.meshes import Mesh
from datagen.data.paths import MIXED, PROXY_KINDS, TRUTH, ProxyKind
from datagen.disk.errors import HyalineError
from datagen.terminal.command import choose
from proxies.meshing.noise import check_amount
from proxies.meshing.solid import Solid

Fitter = Callable[[tuple[Solid, ...], tuple[float, ...]], tuple[Mesh, ...]]


def _together(file: str, name: str) -> Fitter:
    """A fitter that handles all objects in one call, for example to start another program for them."""

    def fit(solids: tuple[Solid, ...], paddings: tuple[float, ...]) -> tuple[Mesh, ...]:
        return getattr(importlib.import_module(f"proxies.kinds.{file}"), name)(solids, paddings)

    return fit


def _one_by_one(file: str, name: str) -> Fitter:
    """A fitter that calls a function for each object: `name(solid, padding=...)`."""

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
"""`FITTERS[kind](solids, paddings)` gives closed, outward meshes with a unique uv for every surface point.

Each encloses its solid at the distance of its padding in metres. A kind's file is imported at its first use.
"""

AMOUNT = 0.01
"""Default amount of `noise`."""


@dataclass(frozen=True, kw_only=True)
class ProxySpec:
    """One kind of proxy."""

    kind: ProxyKind
    amount: float | None = None
    """Standard deviation relative to each object's bounding-box diagonal; only for `noise`, and required there."""

    def __post_init__(self) -> None:
        if self.kind == "noise":
            assert self.amount is not None
            check_amount(self.amount)
        elif self.amount is not None:
            raise HyalineError(f"amount {self.amount:g}: {self.kind} has no noise; use it with `--kind noise`")

    @property
    def geometry(self) -> str:
        """Their name in the dataset, such as `box` or `noise-0.01`; each amount is a geometry of its own."""
        return self.kind if self.amount is None else f"{self.kind}-{self.amount:g}"


@dataclass(frozen=True, kw_only=True)
class MixedSpec:
    """A kind for each object, such as ellipsoids for plants and boxes for shelves.

    Source: paper section 5.2 and Figure 8.
    """

    geometry: str
    """Their name in the dataset: `mixed`, or `mixed-` and a suffix."""
    parts: tuple[ProxySpec | None, ...]
    """The proxy of each object, in object order; None for its true mesh."""

    def __post_init__(self) -> None:
        if not re.fullmatch(rf"{MIXED}(-[A-Za-z0-9_]+)*", self.geometry):
            raise HyalineError(f"name {self.geometry!r}: expected {MIXED}, or {MIXED}- and letters or digits")

    @property
    def assignment(self) -> tuple[str, ...]:
        """The name of each object's part: truth, box, noise-0.01, ..."""
        return tuple(TRUTH if part is None else part.geometry for part in self.parts)


def parse_part(text: str) -> ProxySpec | None:
    """Parses `truth`, a kind such as `box`, or `noise-0.02`; `noise` has the amount `AMOUNT`."""
    if text == TRUTH:
        return None
    kind, dash, amount = text.partition("-")
    if kind != "noise" or not dash:
        chosen = cast(ProxyKind, choose("kind", text, [TRUTH, *PROXY_KINDS]))
        return ProxySpec(kind=chosen, amount=AMOUNT if chosen == "noise" else None)
    try:
        return ProxySpec(kind="noise", amount=float(amount))
    except ValueError:
        raise HyalineError(f"kind {text!r}: {amount!r} is not a number; expected noise-{AMOUNT} or similar") from None


def assign_parts(objects: Sequence[str], assignments: Sequence[str], rest: str) -> tuple[ProxySpec | None, ...]:
    """The proxy of each object; None for its true mesh.

    Args:
        objects: names, in object order.
        assignments: each `OBJECT=KIND`, where OBJECT is a name or a pattern such as `fern*`.
        rest: the kind of the objects that no assignment names.
    """
    by_rest = parse_part(rest)
    given: dict[str, str] = {}
    for assignment in assignments:
        pattern, equals, kind = assignment.partition("=")
        if not (pattern and equals and kind):
            raise HyalineError(f"assign {assignment!r}: expected OBJECT=KIND, such as fern=ellipsoid")
        parse_part(kind)
        named = [name for name in objects if fnmatchcase(name, pattern)] or [choose("object", pattern, objects)]
        for name in named:
            if given.setdefault(name, kind) != kind:
                raise HyalineError(f"assign {assignment!r}: {name} already has {given[name]}; expected one kind each")
    return tuple(parse_part(given[name]) if name in given else by_rest for name in objects)
