"""The kernel that follows the branches of light paths, one surface at a time (datagen/trace/light_path.py).

A ray has one branch at a time and a queue of starts of further ones; at its end comes the first of them.
"""

from typing import TYPE_CHECKING

from datagen.scene.media import medium_of, no_solids, skipped_length
from datagen.trace.branch_outputs import EndOutputs, Kept, Outputs, Start, State
from datagen.trace.surface_hits import Bounce, Hit, Kernel, Sides, bounce_of, meet, sides_of
from datagen.trace.surface_tables import OPAQUE, Limits, SurfaceTables

if TYPE_CHECKING:
    import mitsuba as mi

SPARE_STEPS = 16
"""Trace steps beyond the vertices of all branches, for hits that do not count: faces met again, solids in others."""

MOST_GAIN = 1.25
"""Upper limit of the factor that makes up for missing branches."""

FIRST_MIRROR = 16.0
"""Weight in the queue of branches beyond any throughput, so that the first surface's mirror comes next."""


def follow_branches(scene, tables, media, o, d, rows, shift, count, limits: Limits, kept: Kept | None):
    """One kernel for all branches of `count` rays from `o` along `d`.

    Args:
        rows: two numbers in [0, 1) for each ray. If those of consecutive rays, which belong to one pixel, are an R2
            sequence, the rays share the facets of a rough surface evenly.
        shift: seed of the shifts of `rows` from step to step.
        kept: what is kept besides the ends of branches; None for all vertices.

    Returns:
        Flat arrays: those of `Outputs`, by the field names of `TracedPaths`; or those of `EndOutputs`.
    """
    import drjit as dr

    limits = Limits(*limits)
    kernel = Kernel(scene, SurfaceTables(*tables), media, limits, rows, shift)
    disperses = kernel.tables.disperses
    if kept is None:
        outputs = Outputs(count, limits, disperses=disperses)
    else:
        outputs = EndOutputs(count, limits, Kept(*kept), disperses=disperses)

    # Dr.Jit's loops take plain tuples.
    def is_tracing(*state):
        return state[-1]

    def advance(*state):
        return tuple(_advance(kernel, outputs, State(*state)))

    last = dr.while_loop(tuple(_first_state(kernel, o, d, count)), is_tracing, advance, label="light_path")
    if limits.makes_up and kept is not None:
        # Factors that make up for missing branches: flat, the colour channels of each ray together.
        end = State(*last)
        gain = dr.clip(dr.select(end.ended > 0, 1 + end.waiting / end.ended, 1), 1, MOST_GAIN)
        outputs.arrays["throughput"] *= dr.tile(dr.ravel(gain), limits.max_branches)
    return outputs.arrays


def _first_state(kernel: Kernel, o, d, count: int) -> State:
    import drjit as dr
    import mitsuba as mi

    return State(
        o=o,
        d=d,
        beta=dr.full(mi.Color3f, 1, count),
        solids=dr.full(mi.UInt32, no_solids(kernel.media), count),
        last_face=dr.full(mi.Int32, -1, count),
        branch=dr.zeros(mi.UInt32, count),
        vertex=dr.zeros(mi.UInt32, count),
        step=dr.zeros(mi.UInt32, count),
        queue=tuple(tuple(_no_start(kernel, count)) for _ in range(kernel.limits.max_branches - 1)),
        ended=dr.zeros(mi.Color3f, count),
        waiting=dr.zeros(mi.Color3f, count),
        active=dr.full(mi.Bool, True, count),
    )


def _no_start(kernel: Kernel, count: int) -> Start:
    import drjit as dr
    import mitsuba as mi

    return Start(
        weight=dr.zeros(mi.Float, count),
        o=dr.zeros(mi.Point3f, count),
        d=dr.zeros(mi.Vector3f, count),
        beta=dr.zeros(mi.Color3f, count),
        last_face=dr.full(mi.Int32, -1, count),
        solids=dr.full(mi.UInt32, no_solids(kernel.media), count),
    )


def _advance(kernel: Kernel, outputs: "Outputs | EndOutputs", state: State) -> State:
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


def _absorb(kernel: Kernel, hit: Hit, state: State) -> State:
    """Absorption by Beer and Lambert along the segment that ends here."""
    import drjit as dr
    import mitsuba as mi

    medium = medium_of(kernel.media, state.solids)
    in_glass = hit.found & (medium < mi.UInt32(len(kernel.media.ior) - 1))
    sigma = mi.Color3f(*(dr.gather(mi.Float, table, medium, in_glass) for table in kernel.tables.absorption))
    length = dr.norm(hit.p - state.o) + skipped_length(hit.offset, dr.dot(state.d, hit.n_face))
    length = dr.select(in_glass & hit.counts, length, 0)
    beta = dr.select(in_glass, state.beta * dr.exp(-sigma * length), state.beta)
    return state._replace(beta=beta)


def _with_mirror(kernel: Kernel, hit: Hit, sides: Sides, bounce: Bounce, state: State) -> State:
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


def _go_on(kernel: Kernel, hit: Hit, sides: Sides, bounce: Bounce, state: State) -> "tuple[State, mi.Bool]":
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


def _turn(kernel: Kernel, state: State, is_over) -> State:
    """Starts the next branch, if there is one, where a branch is over."""
    import drjit as dr

    limits, queue = kernel.limits, state.queue
    turns = is_over & (state.branch + 1 < limits.max_branches)
    if queue:
        turns &= queue[0][0] > 0
        first, behind = Start(*queue[0]), [*queue[1:], _no_start(kernel, 1)]
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
        vertex=dr.select(turns, 0, state.vertex),
        branch=dr.select(turns, state.branch + 1, state.branch),
        active=state.active & (~is_over | turns) & (state.step < max_steps),
    )
