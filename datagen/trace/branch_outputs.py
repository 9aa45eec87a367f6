"""What the kernel of branches.py hands on from step to step, and the arrays that it fills."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportAttributeAccessIssue=false

from typing import TYPE_CHECKING, NamedTuple

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
