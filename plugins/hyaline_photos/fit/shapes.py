"""Glass of revolution as a few numbers, and its mesh. Vertex and face counts are constant, for updates in place."""

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from jaxtyping import Float, Float64

from datagen.data.meshes import Mesh, mesh_from
from datagen.scene.materials import Dielectric, Material, RoughDielectric

OUTSIDE, RIM, INSIDE, CORNER = 120, 6, 64, 12
"""Points of the outside, of a vessel's rim, of its inner wall, and of the corner above its floor."""
POINTS = OUTSIDE + RIM - 1 + INSIDE + CORNER + 1
"""Points of a whole section."""
MOST_FLOOR = 0.95
"""Highest floor of a hollow, in parts of the height."""
DRINK_REACH = 0.3
"""How far a drink reaches into its glass, in parts of the thinnest wall."""
SPECK = 1e-3
"""Radius of the mesh that holds the place of a drink, in parts of the glass's height."""
WATER = 1.33
"""First guess of a drink's index."""
USUAL_WALL = 0.05
"""Thickness of a usual vessel's wall, in parts of the largest radius."""
FOOT = 0.04
"""First guess of a foot's rounding, in parts of the largest radius."""

Body = tuple[Mesh, Material]
SEGMENTS = 96
"""Around the axis; 64 lose 1 dB on a tumbler of the true shape."""
CREASE_COS = np.cos(np.radians(35))
"""Edges of an outline that turn by more are shaded as edges."""
TURNS = 0.05
"""A turn by one radian gets as many points as this share of the outside's length: else a thin foot loses its edge."""

Outline = Float64[np.ndarray, "_ 2"]
"""Points (radius, height along the axis) in metres, from the axis at the bottom and back to it."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Axis:
    """A line in space."""

    point: Float64[np.ndarray, "3"]
    direction: Float64[np.ndarray, "3"]

    def moved(self, tilt: Float[np.ndarray, "2"], shift: Float[np.ndarray, "2"]) -> "Axis":
        """Shifted across (metres) and tilted by small amounts (radians) along two directions perpendicular to it."""
        frame = perpendicular(self.direction)
        direction = self.direction + tilt @ frame
        return Axis(point=self.point + shift @ frame, direction=direction / np.linalg.norm(direction))


@dataclass(frozen=True, kw_only=True, eq=False)
class Glass:
    """A fitted object: its numbers and tints; derived records add the shape."""

    numbers: Mapping[str, float] = field(default_factory=lambda: {"ior": 1.5})
    """What a search changes, as far as it applies: roughness of frosted glass, wall of vessels, ... (`NUMBERS`)."""
    absorption: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """1/m, by colour channel."""
    drink_absorption: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The same of what a vessel holds."""

    @property
    def kind(self) -> str:
        raise NotImplementedError

    def bodies(self, object_ids: Sequence[int]) -> dict[int, Body]:
        """Mesh and material of the object and, given a second id, of the drink that it may hold."""
        return {object_ids[0]: (self.mesh(), self.material())}

    def mesh(self) -> Mesh:
        """A closed mesh; vertex and face counts are independent of the parameters."""
        raise NotImplementedError

    def having(self, **numbers: float) -> Self:
        """The same with some other numbers."""
        return dataclasses.replace(self, numbers={**self.numbers, **numbers})

    def without(self, name: str) -> Self:
        """The same where a number doesn't apply."""
        return dataclasses.replace(self, numbers={key: each for key, each in self.numbers.items() if key != name})

    @property
    def hollow(self) -> tuple[float, float] | None:
        """Wall and floor in metres; None: solid."""
        return (self.numbers["wall"], self.numbers["floor"]) if "wall" in self.numbers else None

    def material(self) -> Material:
        ior, roughness = self.numbers["ior"], self.numbers.get("roughness")
        if roughness is None:
            return Dielectric(ior=ior, absorption=self.absorption)
        return RoughDielectric(ior=ior, absorption=self.absorption, roughness=roughness)


@dataclass(frozen=True, kw_only=True, eq=False)
class Revolution(Glass):
    """A glass of revolution: solid, or a vessel whose hollow is its outside moved inwards and cut by a floor."""

    axis: Axis
    outside: Outline
    """From the axis at the bottom to the axis, or a vessel's rim, at the top."""
    solid: Outline | None = None
    """The same of solid glass, whose ends may be rounded; it ends on the axis. None: closed by a flat end."""

    @property
    def kind(self) -> str:
        from_middle = self.outside - [0, self.outside[[0, -1], 1].mean()]
        return "ball" if np.ptp(np.linalg.norm(from_middle, axis=1)) < 1e-6 else "revolution"

    @property
    def height(self) -> float:
        return float(np.ptp(self.outside[:, 1]))

    @property
    def is_closed(self) -> bool:
        """The outside ends on the axis: it has no rim, and so no hollow."""
        return bool(self.outside[-1, 0] < 1e-6)

    @property
    def has_flat_top(self) -> bool:
        """Its solid has one, which may be an opening."""
        return self.solid is not None and bool(self.solid[-2, 1] > self.solid[-1, 1] - 1e-9)

    def hollowed(self, wall: float, floor: float, corner: float) -> "Revolution":
        """A vessel with this outside.

        Args:
            wall: in parts of the largest radius.
            floor: in parts of the height.
        """
        radius = float(self.outside[:, 0].max())
        return self.having(wall=wall * radius, taper=1.0, floor=floor * self.height, corner=corner, foot=FOOT * radius)

    def outline(self) -> Outline:
        """The whole section."""
        numbers = self.numbers
        if self.hollow is None:
            if self.solid is not None:
                return self.solid
            if self.is_closed:
                return evenly(self.outside, POINTS)
            top = np.linspace(self.outside[-1], (0.0, self.outside[-1, 1]), POINTS - OUTSIDE + 1)[1:]
            return np.concatenate([self.outside, top])
        wall, floor = self.hollow
        at_rim = wall * numbers["taper"]
        # The rim is a half circle, below which the outside ends.
        side = _with_foot(_cut(self.outside, self.outside[-1, 1] - at_rim / 2), numbers["foot"])
        inside = _hollow(side, wall, at_rim, floor, numbers["corner"])
        return np.concatenate([side, inside])

    def mesh(self) -> Mesh:
        return revolved(self.axis, self.outline())

    def bodies(self, object_ids: Sequence[int]) -> dict[int, Body]:
        # Where the drink reaches into the wall, its lower priority lets the glass win.
        drink = Dielectric(ior=self.numbers.get("drink_ior", WATER), absorption=self.drink_absorption, priority=-1)
        drinks = {each: (revolved(self.axis, self.drink_outline()), drink) for each in object_ids[1:]}
        return {**super().bodies(object_ids), **drinks}

    def drink_outline(self) -> Outline:
        """The section of the drink; it extends slightly into floor and wall. Without a level: a speck in glass."""
        if self.hollow is None or "level" not in self.numbers:
            middle = self.outside[0, 1] + SPECK * self.height * 10
            angles = np.linspace(-np.pi / 2, np.pi / 2, INSIDE + CORNER + 2)
            return SPECK * self.height * np.stack([np.cos(angles).round(9), np.sin(angles)], axis=1) + [0, middle]
        inside = self.outline()[OUTSIDE + RIM - 1 :][::-1]
        low, high = inside[0, 1], inside[-1, 1]
        surface = float(
            np.clip(self.outside[:, 1].min() + self.numbers["level"], low + 0.02 * (high - low), high - 1e-6)
        )
        inside = _cut(inside, surface)
        outward = -_leftward(inside)
        wall, floor = self.hollow
        line = inside + DRINK_REACH * min(wall, wall * self.numbers["taper"], floor) * outward
        line[0, 0], line[-1, 1] = 0.0, surface
        line[:, 1] = np.minimum(line[:, 1], surface)
        return np.concatenate([line, [(0.0, surface)]])


def _hollow(outside: Outline, wall: float, at_rim: float, floor: float, corner: float) -> Outline:
    """The inside of a vessel from its rim down to the axis."""
    inward = _leftward(outside)
    bottom = outside[:, 1].min() + min(floor, MOST_FLOOR * float(np.ptp(outside[:, 1])))
    height = np.clip((outside[:, 1] - bottom) / (outside[-1, 1] - bottom), 0, 1)
    inner = outside + (wall + height * (at_rim - wall))[:, None] * inward
    # As a function of height, from the floor up: what lies below, or would fold over the axis, is cut.
    above = (inner[:, 1] > bottom) & (inner[:, 0] > 0)
    first = len(inner) - int(np.argmin(above[::-1])) if not above.all() else 0
    first = min(first, len(inner) - 2)
    line = inner[first:]
    if first > 0 and inner[first - 1, 1] < bottom < line[0, 1]:
        share = (bottom - inner[first - 1, 1]) / (line[0, 1] - inner[first - 1, 1])
        lowest = inner[first - 1] + share * (line[0] - inner[first - 1])
    else:
        lowest = np.array([line[0, 0], bottom])
    lowest[0] = max(lowest[0], 1e-4)
    middle, arm = (outside[-1] + inner[-1]) / 2, (outside[-1] - inner[-1]) / 2
    up = np.array([-arm[1], arm[0]])
    up = up if up @ [inward[-1, 1], -inward[-1, 0]] > 0 else -up
    angles = np.linspace(0, np.pi, RIM + 1)[1:-1, None]
    rim = middle + np.cos(angles) * arm + np.sin(angles) * up
    side = evenly(np.concatenate([line[::-1], lowest[None]]), INSIDE)
    return np.concatenate([rim, _with_corner(side, np.array([0.0, bottom]), reach=float(corner * lowest[0]))])


def _leftward(line: Outline) -> Outline:
    """Unit vectors to the left of a line, at its points."""
    tangents = np.gradient(line, axis=0)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
    return np.stack([-tangents[:, 1], tangents[:, 0]], axis=1)


def _with_foot(line: Outline, reach: float) -> Outline:
    """The line, the corner between its flat bottom and its side rounded by an arc; the point count is unchanged."""
    side = line[int(np.flatnonzero(line[:, 1] > line[0, 1] + 1e-6)[0]) - 1 :]  # Beside the flat bottom.
    way = lengths_of(side)
    reach = min(reach, 0.9 * float(side[0, 0]), 0.5 * float(way[-1]))
    if reach <= 0:
        return line
    start = np.array([side[0, 0] - reach, line[0, 1]])
    arc = _arc(start, side[0], point_at(side, reach))
    return spread(np.concatenate([line[:1], start[None], arc, side[way > reach]]), len(line))


def _with_corner(line: Outline, end: Float64[np.ndarray, "2"], *, reach: float) -> Outline:
    """The line and a straight way on to `end`, their corner rounded from `reach` before it to as far behind."""
    way = lengths_of(line)
    reach = min(reach, 0.5 * float(way[-1]), 0.95 * float(np.linalg.norm(line[-1] - end)))
    start = point_at(line, way[-1] - reach)
    kept = evenly(np.concatenate([line[way < way[-1] - reach], start[None]]), INSIDE)
    stop = line[-1] + reach * (end - line[-1]) / np.linalg.norm(end - line[-1])
    return np.concatenate([kept, _arc(start, line[-1], stop), end[None]])


def _arc(start: Float64[np.ndarray, "2"], corner: Float64[np.ndarray, "2"], stop: Float64[np.ndarray, "2"]) -> Outline:
    """Points of the curve that leaves `start` towards `corner` and reaches `stop` from there; without `start`."""
    t = np.linspace(0, 1, CORNER + 1)[1:, None]
    # A rational quadratic: a circle where both legs are as long.
    back, forth = start - corner, stop - corner
    cosine = np.clip(back @ forth / (np.linalg.norm(back) * np.linalg.norm(forth)), -1, 1)
    a, b, c = (1 - t) ** 2, 2 * np.sqrt((1 - cosine) / 2) * t * (1 - t), t**2
    return (a * start + b * corner + c * stop) / (a + b + c)


def _cut(line: Outline, height: float) -> Outline:
    """The line up to a height; the point count is unchanged."""
    above = int(np.flatnonzero(line[:, 1] < height)[-1])
    share = (height - line[above, 1]) / (line[above + 1, 1] - line[above, 1])
    end = line[above] + share * (line[above + 1] - line[above])
    return spread(np.concatenate([line[: above + 1], end[None]]), len(line))


# Lines, and the meshes that they sweep around an axis


def perpendicular(direction: Float64[np.ndarray, "3"]) -> Float64[np.ndarray, "2 3"]:
    """Two unit vectors perpendicular to a direction and to each other; right-handed, the direction being third."""
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(direction, first)])


def revolved(axis: Axis, outline: Outline) -> Mesh:
    """The solid that an outline sweeps around an axis; u goes around, v along the outline, edge by edge."""
    edges = np.diff(outline, axis=0)
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    # Each edge has two rings of its own, which share the normals of its neighbours unless there is a crease.
    starts, ends = normals.copy(), normals.copy()
    smooth = np.einsum("ec,ec->e", normals[:-1], normals[1:]) > CREASE_COS
    mean = normals[:-1] + normals[1:]
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    ends[:-1][smooth], starts[1:][smooth] = mean[smooth], mean[smooth]
    rings = np.stack([outline[:-1], outline[1:]], axis=1).reshape(-1, 2)
    ring_normals = np.stack([starts, ends], axis=1).reshape(-1, 2)
    u, v = perpendicular(axis.direction)
    angles = (np.arange(SEGMENTS + 1) % SEGMENTS * (2 * np.pi / SEGMENTS))[:, None]  # The last repeats the first.
    outward = np.cos(angles) * u + np.sin(angles) * v
    swept, turned = (
        values[:, :1, None] * outward + values[:, None, 1:] * axis.direction for values in (rings, ring_normals)
    )
    index = np.arange(len(rings) * (SEGMENTS + 1)).reshape(-1, SEGMENTS + 1)
    low, high = index[0::2], index[1::2]
    lower = np.stack([low[:, :-1], low[:, 1:], high[:, 1:]], axis=-1)
    upper = np.stack([low[:, :-1], high[:, 1:], high[:, :-1]], axis=-1)
    # At the axis a quadrangle is one triangle.
    faces = np.concatenate([lower[1:].reshape(-1, 3), upper[:-1].reshape(-1, 3)])
    along = np.repeat(np.arange(len(outline)), 2)[1:-1] / (len(outline) - 1)
    uv = np.stack(np.broadcast_arrays(np.linspace(0, 1, SEGMENTS + 1), along[:, None]), axis=-1)
    return mesh_from((axis.point + swept).reshape(-1, 3), faces, turned.reshape(-1, 3), uv.reshape(-1, 2))


def spread(line: Outline, count: int) -> Outline:
    """Points along a line, the closer the more it turns."""
    ways = np.linalg.norm(np.diff(line, axis=0), axis=1)
    tangents = np.diff(line, axis=0) / np.maximum(ways, 1e-12)[:, None]
    turns = np.arccos(np.clip((tangents[1:] * tangents[:-1]).sum(axis=1), -1, 1))
    lengths = ways + TURNS * ways.sum() * (np.append(turns, 0) + np.insert(turns, 0, 0)) / 2
    return _at_shares(line, np.insert(np.cumsum(lengths), 0, 0), count)


def evenly(line: Outline, count: int) -> Outline:
    """Points along a line at even distances."""
    return _at_shares(line, lengths_of(line), count)


def _at_shares(line: Outline, lengths: Float64[np.ndarray, " point"], count: int) -> Outline:
    """Points along a line at even steps of a length that grows along it."""
    steps = np.linspace(0, lengths[-1], count)
    return np.stack([np.interp(steps, lengths, line[:, axis]) for axis in range(2)], axis=1)


def point_at(line: Outline, reach: float) -> Float64[np.ndarray, "2"]:
    """The point of a line this far along it."""
    return np.array([np.interp(reach, lengths_of(line), line[:, axis]) for axis in range(2)])


def lengths_of(line: Outline) -> Float64[np.ndarray, " point"]:
    """How far along the line each point is."""
    return np.insert(np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1)), 0, 0)
