"""What the kernel of branches.py hands on from step to step, the arrays that it fills, and the ends picked from them.

Ends are picked where they were traced: few of all possible branches exist, so a GPU has little to hand over.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from datagen.scene.media import medium_of
from datagen.trace.surface_hits import Hit, Kernel, Sides, uv_slope
from datagen.trace.surface_tables import Limits

if TYPE_CHECKING:
    import mitsuba as mi


class Start(NamedTuple):
    """Where a branch starts."""

    weight: "mi.Float"
    """Weight in the queue; 0 for no start."""
    o: "mi.Point3f"
    d: "mi.Vector3f"
    beta: "mi.Color3f"
    """Throughput so far."""
    last_face: "mi.Int32"
    """The face that it leaves; -1 for none."""
    solids: "mi.UInt32"
    """The solids that it starts in (datagen/scene/media.py)."""


class State(NamedTuple):
    """What the steps of the loop hand on, a branch's segment and its place among the outputs."""

    o: "mi.Point3f"
    d: "mi.Vector3f"
    beta: "mi.Color3f"
    solids: "mi.UInt32"
    last_face: "mi.Int32"
    branch: "mi.UInt32"
    vertex: "mi.UInt32"
    step: "mi.UInt32"
    queue: "tuple[Start, ...]"
    """Sorted by weight."""
    ended: "mi.Color3f"
    """Share of the camera's light that comes along the branches that have ended."""
    waiting: "mi.Color3f"
    """The same of branches that are not followed, or not yet."""
    active: "mi.Bool"


class Kept(NamedTuple):
    """What is kept of branches, where only their ends matter."""

    stacked: tuple[int, ...]
    """Number of first vertices kept of each of the first branches."""
    has_details: bool
    """Whether ends have a position, a mirrored direction and a slope of uv."""


EXIT = 256
"""Marks the end of a branch that leaves the scene; at other ends is one more than the shape's index."""


class Arrays:
    """Flat arrays that the steps fill."""

    arrays: "dict[str, mi.Float | mi.UInt32]"

    def __init__(self, count: int, limits: Limits, *, disperses: bool) -> None:
        import drjit as dr
        import mitsuba as mi

        self._count, self._limits = count, limits
        self._ray = dr.arange(mi.UInt32, count)
        self.arrays = {"disperses": dr.zeros(mi.UInt32, count)} if disperses else {}

    def record_dispersion(self, kernel: Kernel, sides: Sides) -> None:
        """Records that the ray hits glass that disperses."""
        import drjit as dr
        import mitsuba as mi

        borders = sides.is_glass & ~sides.is_void
        media = (medium_of(kernel.media, side) for side in (sides.here, sides.beyond))
        parts = [dr.gather(mi.Bool, kernel.tables.parts_colors, medium, borders) for medium in media]
        self._store("disperses", [mi.UInt32(1)], self._ray, borders & (parts[0] | parts[1]))

    def _store(self, name: str, values, index, mask) -> None:
        import drjit as dr

        components = list(values)  # Interleaved as NumPy needs them, which saves a copy of the whole.
        for component, value in enumerate(components):
            dr.scatter(self.arrays[name], value, index * len(components) + component, mask)


class Outputs(Arrays):
    """All places of all branches."""

    def __init__(self, count: int, limits: Limits, *, disperses: bool) -> None:
        import drjit as dr
        import mitsuba as mi

        super().__init__(count, limits, disperses=disperses)
        ends = limits.max_branches * count
        places = ends * limits.max_vertices
        self.arrays |= {
            "object_id": dr.zeros(mi.UInt32, places),
            "uv": dr.zeros(mi.Float, 2 * places),
            "uv_slope": dr.zeros(mi.Float, 2 * places),
            "direction": dr.zeros(mi.Float, 3 * places),
            "position": dr.zeros(mi.Float, 3 * places),
            "normal": dr.zeros(mi.Float, 3 * places),
            "throughput": dr.zeros(mi.Float, 3 * places),
            "has_left": dr.zeros(mi.UInt32, ends),
            "end_direction": dr.zeros(mi.Float, 3 * ends),
            "end_throughput": dr.zeros(mi.Float, 3 * ends),
        }

    def record(self, hit: Hit, sides: Sides, state: State) -> None:
        """Records a vertex, or the end outside the scene. Later vertices replace the one in the last place."""
        import drjit as dr
        import mitsuba as mi

        real = hit.counts & ~sides.is_void
        last = self._limits.max_vertices - 1
        slot = (state.branch * (last + 1) + dr.minimum(state.vertex, last)) * self._count + self._ray
        vertex = {
            "object_id": [hit.shape + 1],
            "uv": hit.uv,
            "uv_slope": uv_slope(hit, state.d),
            "direction": state.d,
            "position": hit.p,
            "normal": hit.facing,
            "throughput": state.beta,
        }
        for name, values in vertex.items():
            self._store(name, values, slot, real)
        missed = state.active & ~hit.found
        end = state.branch * self._count + self._ray
        for name, values in {
            "has_left": [mi.UInt32(1)],
            "end_direction": state.d,
            "end_throughput": state.beta,
        }.items():
            self._store(name, values, end, missed)


class EndOutputs(Arrays):
    """The ends of all branches, on a surface that lets no light pass or outside the scene, and a few first vertices."""

    def __init__(self, count: int, limits: Limits, kept: Kept, *, disperses: bool) -> None:
        import drjit as dr
        import mitsuba as mi

        super().__init__(count, limits, disperses=disperses)
        self._kept = kept
        ends, slots = limits.max_branches * count, sum(kept.stacked) * count
        self.arrays |= {
            "end": dr.zeros(mi.UInt32, ends),
            "place": dr.empty(mi.Float, 3 * ends),
            "throughput": dr.empty(mi.Float, 3 * ends),
        }
        if kept.has_details:
            self.arrays |= {
                "position": dr.empty(mi.Float, 3 * ends),
                "reflected": dr.empty(mi.Float, 3 * ends),
                "uv_slope": dr.empty(mi.Float, 2 * ends),
            }
        if slots:
            self.arrays |= {
                "stack_shape": dr.zeros(mi.UInt32, slots),
                "stack_uv": dr.zeros(mi.Float, 2 * slots),
                "stack_throughput": dr.zeros(mi.Float, slots),
                "stack_cosine": dr.zeros(mi.Float, slots),
            }

    def record(self, hit: Hit, sides: Sides, state: State) -> None:
        """Records the end of a branch: on a surface uv and cosine, outside the scene the direction; and a vertex."""
        import drjit as dr
        import mitsuba as mi

        real = hit.counts & ~sides.is_void
        missed = state.active & ~hit.found
        stops = real & ~sides.is_glass & ~sides.is_thin
        end = state.branch * self._count + self._ray
        arriving = -dr.dot(state.d, hit.facing)
        cosine = dr.clip(arriving, 0, 1)
        on_surface = mi.Vector3f(hit.uv.x, hit.uv.y, cosine)
        self._store("end", [dr.select(missed, EXIT, hit.shape + 1)], end, stops | missed)
        self._store("place", dr.select(missed, state.d, on_surface), end, stops | missed)
        self._store("throughput", state.beta, end, stops | missed)
        if self._kept.has_details:
            self._store("position", hit.p, end, stops)
            self._store("reflected", state.d + 2 * arriving * hit.facing, end, stops)
            self._store("uv_slope", uv_slope(hit, state.d), end, stops)
        first, slots = 0, sum(self._kept.stacked)
        for branch, number in enumerate(self._kept.stacked):
            is_kept = real & (state.branch == branch) & (state.vertex < number)
            slot = self._ray * slots + first + state.vertex
            self._store("stack_shape", [hit.shape + 1], slot, is_kept)
            self._store("stack_uv", hit.uv, slot, is_kept)
            self._store("stack_throughput", [dr.mean(state.beta)], slot, is_kept)
            self._store("stack_cosine", [cosine], slot, is_kept)
            first += number


# The ends, listed ray by ray


Filled = Mapping[str, Any]
"""Flat Dr.Jit arrays by name, as `EndOutputs` fills them: branch by branch, and in each ray by ray."""

Ends = dict[str, np.ndarray]


@dataclass(frozen=True, kw_only=True, eq=False)
class FirstVertices:
    """The first vertices of some branches of each ray, branch by branch."""

    object_id: UInt8[np.ndarray, "ray slot"]
    """0 where there is no vertex."""
    uv: Float32[np.ndarray, "ray slot 2"]
    throughput: Float32[np.ndarray, "ray slot"]
    """Mean over the colour channels."""
    cosine: Float32[np.ndarray, "ray slot"]
    """As in `PathEnds`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PathEnds:
    """Where the branches of a bundle of rays end, ray by ray, and their first vertices."""

    ray: Int64[np.ndarray, " end"]
    """Index of the ray; a ray has one end for each branch that ends on a surface that lets no light pass."""
    object_id: UInt8[np.ndarray, " end"]
    uv: Float32[np.ndarray, "end 2"]
    cosine: Float32[np.ndarray, " end"]
    """Cosine of the angle between the arriving ray and the surface normal, 0 to 1."""
    throughput: Float32[np.ndarray, "end 3"]
    """As in `TracedPaths`; where `Limits.makes_up`, with a share of the branches that were not followed."""
    position: Float32[np.ndarray, "end 3"] | None = None
    reflected: Float32[np.ndarray, "end 3"] | None = None
    """The arriving direction, mirrored at the surface."""
    uv_slope: Float32[np.ndarray, "end 2"] | None = None
    """As in `TracedPaths`."""
    exit_ray: Int64[np.ndarray, " exit"]
    """Index of the ray; a ray has one for each branch that leaves the scene."""
    exit_direction: Float32[np.ndarray, "exit 3"]
    exit_throughput: Float32[np.ndarray, "exit 3"]
    stack: FirstVertices | None
    """None if no vertices were asked for."""


def pack_ends(
    outputs: Filled,
    branches: int,
    rays: Int64[np.ndarray, " ray"],
    object_id: UInt8[np.ndarray, " shape"],
    weight: Float32[np.ndarray, "traced 3"] | None,
) -> Ends:
    """The ends of a bundle as fields of `PathEnds`.

    Args:
        rays: what to call each of the first traced rays; others, which pad a bundle, are left out.
        object_id: by one more than a shape's index.
        weight: a factor on each traced ray's throughput.
    """
    import drjit as dr
    import mitsuba as mi

    num_slots = dr.width(outputs["end"])
    num_traced = num_slots // branches
    # Opaque, because each literal would need a kernel of its own.
    traced, named = (dr.opaque(mi.UInt32, count) for count in (num_traced, len(rays)))
    slot = dr.arange(mi.UInt32, num_slots)
    ray, branch = slot // branches, slot % branches
    place = branch * traced + ray
    end = dr.gather(mi.UInt32, outputs["end"], place)
    is_exit = (end == EXIT) & (ray < named)
    is_surface = (end > 0) & (end != EXIT) & (ray < named)
    dr.eval(place, is_exit, is_surface)
    kinds = {1: mi.UInt32, 2: mi.Point2f, 3: mi.Point3f}

    def rows(chosen: "mi.Bool", *names: str) -> Ends:
        listed = dr.compress(chosen)
        components = {name: dr.width(outputs[name]) // num_slots for name in names}
        if not dr.width(listed):  # Dr.Jit 1.5 cannot gather with an empty index.
            empty = {name: np.zeros((0, count), np.float32) for name, count in components.items()}
            return {**empty, "end": np.zeros((0, 1), np.uint32), "ray": rays[:0]}
        index = dr.gather(mi.UInt32, place, listed)
        found = {name: dr.ravel(dr.gather(kinds[count], outputs[name], index)) for name, count in components.items()}
        dr.eval(index, found)
        # Copies: a view would keep Dr.Jit's array. Where another thread frees that, it waits for Dr.Jit's lock with the
        # GIL held, and the thread that traces holds the lock and waits for the GIL: neither goes on.
        arrays = {name: np.array(values).reshape(-1, components[name]) for name, values in found.items()}
        traced_ray = np.array(index) % num_traced
        if weight is not None:
            arrays["throughput"] = arrays["throughput"] * weight[traced_ray]
        return {**arrays, "ray": rays[traced_ray]}

    details = [name for name in ("position", "reflected", "uv_slope") if name in outputs]
    surfaces, exits = rows(is_surface, "end", "place", "throughput", *details), rows(is_exit, "place", "throughput")
    return {
        "ray": surfaces["ray"],
        "object_id": object_id[surfaces["end"][:, 0]],
        "uv": surfaces["place"][:, :2],
        "cosine": surfaces["place"][:, 2],
        "throughput": surfaces["throughput"],
        **{name: surfaces[name] for name in details},
        "exit_ray": exits["ray"],
        "exit_direction": exits["place"],
        "exit_throughput": exits["throughput"],
    }


def join_ends(parts: list[Ends]) -> Ends:
    """The ends of several bundles, ray by ray."""
    if len(parts) == 1:
        return parts[0]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    orders = {name: np.argsort(joined[name], kind="stable") for name in ("ray", "exit_ray")}
    return {name: values[orders["exit_ray" if name.startswith("exit_") else "ray"]] for name, values in joined.items()}
