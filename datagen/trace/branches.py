"""The kernel that follows the branches of light paths, one surface at a time (datagen/trace/light_path.py).

A ray has one branch at a time and a queue of starts of further ones. Each step of the loop meets the next surface of
the branch, records a vertex, puts the surface's mirror image into the queue, and goes on behind the surface; where the
branch ends, the first start in the queue comes next.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportOperatorIssue=false, reportIndexIssue=false
# pyright: reportAttributeAccessIssue=false

from typing import TYPE_CHECKING, NamedTuple

from datagen.scene.contact import skipped_length
from datagen.scene.media import medium_of, no_solids
from datagen.trace.surface_hits import Bounce, Hit, Kernel, Sides, bounce_of, meet, sides_of, uv_slope
from datagen.trace.surface_tables import OPAQUE, Limits, SurfaceTables

if TYPE_CHECKING:
    import mitsuba as mi

SPARE_STEPS = 16
"""Trace steps beyond the vertices of all branches, for hits that do not count: faces met again, surfaces of solids
inside others."""

MOST_GAIN = 1.25
"""Largest factor by which the light of the branches that are followed makes up for that of the others."""

FIRST_MIRROR = 16.0
"""Weight in the queue of branches beyond any throughput, so that the first surface's mirror comes next."""


class _Start(NamedTuple):
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


class _State(NamedTuple):
    """What the steps of the loop hand on, a branch's segment and its place among the outputs."""

    o: "mi.Point3f"
    d: "mi.Vector3f"
    beta: "mi.Color3f"
    solids: "mi.UInt32"
    way: "mi.Float"
    """Metres inside glass or liquid since the last vertex."""
    last_face: "mi.Int32"
    branch: "mi.UInt32"
    vertex: "mi.UInt32"
    step: "mi.UInt32"
    queue: "tuple[_Start, ...]"
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


def follow_branches(scene, tables, media, o, d, rows, shift, count, limits: Limits, kept: Kept | None):
    """One kernel for all branches of `count` rays from `o` along `d`.

    Args:
        rows: two numbers in [0, 1) for each ray. If those of consecutive rays, which belong to one pixel, are an R2
            sequence, the rays share the facets of a rough surface evenly.
        shift: seed of the shifts of `rows` from step to step.
        kept: what is kept besides the ends of branches; None for all vertices.

    Returns:
        Flat arrays: those of `_Outputs`, by the field names of `TracedPaths`; or those of `_EndOutputs`.
    """
    import drjit as dr

    limits = Limits(*limits)
    kernel = Kernel(scene, SurfaceTables(*tables), media, limits, rows, shift)
    disperses = kernel.tables.disperses
    if kept is None:
        outputs = _Outputs(count, limits, disperses=disperses)
    else:
        outputs = _EndOutputs(count, limits, Kept(*kept), disperses=disperses)

    # Dr.Jit's loops take plain tuples.
    def is_tracing(*state):
        return state[-1]

    def advance(*state):
        return tuple(_advance(kernel, outputs, _State(*state)))

    last = dr.while_loop(tuple(_first_state(kernel, o, d, count)), is_tracing, advance, label="light_path")
    if limits.makes_up:
        outputs.arrays["gain"] = _gain(_State(*last))
    return outputs.arrays


def _first_state(kernel: Kernel, o, d, count: int) -> _State:
    import drjit as dr
    import mitsuba as mi

    return _State(
        o=o,
        d=d,
        beta=dr.full(mi.Color3f, 1, count),
        solids=dr.full(mi.UInt32, no_solids(kernel.media), count),
        way=dr.zeros(mi.Float, count),
        last_face=dr.full(mi.Int32, -1, count),
        branch=dr.zeros(mi.UInt32, count),
        vertex=dr.zeros(mi.UInt32, count),
        step=dr.zeros(mi.UInt32, count),
        queue=tuple(tuple(_no_start(kernel, count)) for _ in range(kernel.limits.max_branches - 1)),
        ended=dr.zeros(mi.Color3f, count),
        waiting=dr.zeros(mi.Color3f, count),
        active=dr.full(mi.Bool, True, count),
    )


def _no_start(kernel: Kernel, count: int) -> _Start:
    import drjit as dr
    import mitsuba as mi

    return _Start(
        weight=dr.zeros(mi.Float, count),
        o=dr.zeros(mi.Point3f, count),
        d=dr.zeros(mi.Vector3f, count),
        beta=dr.zeros(mi.Color3f, count),
        last_face=dr.full(mi.Int32, -1, count),
        solids=dr.full(mi.UInt32, no_solids(kernel.media), count),
    )


def _advance(kernel: Kernel, outputs: "_Outputs | _EndOutputs", state: _State) -> _State:
    """One step: the next surface, what it records, and where the ray goes on."""
    hit = meet(kernel, state.o, state.d, state.last_face, state.active)
    sides = sides_of(kernel, hit, state.solids)
    state = _absorb(kernel, hit, state)
    outputs.record(hit, sides, state)
    if kernel.tables.disperses:
        outputs.record_dispersion(kernel, sides)
    bounce = bounce_of(kernel, hit, sides, state.d, state.step)
    state = _with_mirror(kernel, hit, sides, bounce, state)
    return _turn(kernel, *_go_on(kernel, hit, sides, bounce, state))


def _absorb(kernel: Kernel, hit: Hit, state: _State) -> _State:
    """Absorption by Beer and Lambert along the segment that ends here."""
    import drjit as dr
    import mitsuba as mi

    medium = medium_of(kernel.media, state.solids)
    in_glass = hit.found & (medium < mi.UInt32(len(kernel.media.ior) - 1))
    sigma = mi.Color3f(*(dr.gather(mi.Float, table, medium, in_glass) for table in kernel.tables.absorption))
    length = dr.norm(hit.p - state.o) + skipped_length(hit.offset, dr.dot(state.d, hit.n_face))
    length = dr.select(in_glass & hit.counts, length, 0)
    beta = dr.select(in_glass, state.beta * dr.exp(-sigma * length), state.beta)
    return state._replace(beta=beta, way=state.way + length)


def _with_mirror(kernel: Kernel, hit: Hit, sides: Sides, bounce: Bounce, state: _State) -> _State:
    """Queues a further branch, where light also comes by reflection. The queue is sorted; its last one falls out."""
    import drjit as dr

    beta = state.beta * bounce.mirror_share
    weight = dr.max(beta)
    mirrors = hit.counts & ~sides.is_void & (sides.kind != OPAQUE) & ~bounce.total
    starts = mirrors & (weight > kernel.limits.min_throughput)
    weight = dr.select((state.branch == 0) & (state.vertex == 0), FIRST_MIRROR, weight)
    p = hit.p + hit.outward * hit.offset
    start = (dr.select(starts, weight, 0), p, bounce.mirrored, beta, hit.face, state.solids)
    sorted_queue = []
    for other in state.queue:
        is_better = start[0] > other[0]
        sorted_queue.append(_choose(is_better, start, other))
        start = _choose(is_better, other, start)
    state = state._replace(queue=tuple(sorted_queue))
    if not kernel.limits.makes_up:
        return state
    return state._replace(waiting=state.waiting + dr.select(mirrors, _in_air(kernel, beta, state.solids), 0))


def _in_air(kernel: Kernel, beta, solids):
    """The throughput of a branch that is in these solids, as if it were in air: radiance grows with n squared."""
    import drjit as dr
    import mitsuba as mi

    return beta * dr.square(dr.gather(mi.Float, kernel.tables.medium_ior, medium_of(kernel.media, solids)))


def _choose(condition, these, others) -> tuple:
    import drjit as dr

    return tuple(dr.select(condition, this, other) for this, other in zip(these, others, strict=True))


def _go_on(kernel: Kernel, hit: Hit, sides: Sides, bounce: Bounce, state: _State) -> "tuple[_State, mi.Bool]":
    """The next segment of this branch, and whether the branch is over instead."""
    import drjit as dr

    real = hit.counts & ~sides.is_void
    again = hit.found & ~hit.counts
    missed = state.active & ~hit.found
    passes = sides.is_thin | sides.is_glass
    goes_through = passes & ~bounce.total
    o = dr.select(passes, hit.p + dr.select(goes_through, -hit.outward, hit.outward) * hit.offset, state.o)
    vertex = dr.select(real, state.vertex + 1, state.vertex)
    has_ended = missed | (hit.counts & ~passes)
    on = state._replace(
        o=dr.select(again, o + state.d * (hit.t * (1 + 2.4e-7) + 1e-7), o),
        d=dr.select(passes, bounce.next_d, state.d),
        beta=dr.select(passes & ~sides.is_void, state.beta * bounce.next_share, state.beta),
        solids=dr.select(goes_through, sides.beyond, state.solids),
        way=dr.select(real, 0, state.way),
        last_face=dr.select(hit.counts, hit.face, state.last_face),
        vertex=vertex,
        step=state.step + 1,
    )
    if kernel.limits.makes_up:
        on = on._replace(ended=state.ended + dr.select(has_ended, _in_air(kernel, state.beta, state.solids), 0))
    is_over = has_ended | (real & (vertex == kernel.limits.max_depth))
    if kernel.tables.has_rough_glass:
        # A refracted ray that does not leave its facet on the other side is lost.
        is_over |= real & (dr.max(on.beta) == 0)
    return on, is_over


def _turn(kernel: Kernel, state: _State, is_over) -> _State:
    """Starts the next branch, if there is one, where a branch is over."""
    import drjit as dr

    limits, queue = kernel.limits, state.queue
    turns = is_over & (state.branch + 1 < limits.max_branches)
    if queue:
        turns &= queue[0][0] > 0
        first, behind = _Start(*queue[0]), [*queue[1:], _no_start(kernel, 1)]
        state = state._replace(
            o=dr.select(turns, first.o, state.o),
            d=dr.select(turns, first.d, state.d),
            beta=dr.select(turns, first.beta, state.beta),
            last_face=dr.select(turns, first.last_face, state.last_face),
            solids=dr.select(turns, first.solids, state.solids),
            queue=tuple(_choose(turns, after, this) for this, after in zip(queue, behind, strict=True)),
        )
        if limits.makes_up:
            followed = dr.select(turns, _in_air(kernel, first.beta, first.solids), 0)
            state = state._replace(waiting=state.waiting - followed)
    max_steps = limits.max_branches * limits.max_depth + SPARE_STEPS
    return state._replace(
        way=dr.select(turns, 0, state.way),
        vertex=dr.select(turns, 0, state.vertex),
        branch=dr.select(turns, state.branch + 1, state.branch),
        active=state.active & (~is_over | turns) & (state.step < max_steps),
    )


def _gain(last: _State):
    """By what the light of each ray's ends has to be multiplied to make up for branches that were not followed."""
    import drjit as dr

    gain = dr.select(last.ended > 0, 1 + last.waiting / last.ended, 1)
    return dr.ravel(dr.clip(gain, 1, MOST_GAIN))


class _Arrays:
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


class _Outputs(_Arrays):
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
            "medium_length": dr.zeros(mi.Float, places),
            "has_left": dr.zeros(mi.UInt32, ends),
            "end_direction": dr.zeros(mi.Float, 3 * ends),
            "end_throughput": dr.zeros(mi.Float, 3 * ends),
        }

    def record(self, hit: Hit, sides: Sides, state: _State) -> None:
        """Records a vertex, or the end outside the scene. Later vertices replace the one in the last place."""
        import drjit as dr
        import mitsuba as mi

        real = hit.counts & ~sides.is_void
        last = self._limits.max_vertices - 1
        slot = (state.branch * (last + 1) + dr.minimum(state.vertex, last)) * self._count + self._ray
        vertex = {
            "object_id": [hit.shape + 1],
            "medium_length": [state.way],
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


class _EndOutputs(_Arrays):
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

    def record(self, hit: Hit, sides: Sides, state: _State) -> None:
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
