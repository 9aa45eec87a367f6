"""The ends of light paths, picked from a tracer's outputs and listed ray by ray (datagen/trace/light_path.py).

They are picked where they were traced: few of all possible branches exist, so a GPU has little to hand over.
"""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false, reportCallIssue=false, reportAttributeAccessIssue=false

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int64, UInt8

from datagen.trace.branch_outputs import EXIT

Outputs = Mapping[str, Any]
"""Flat Dr.Jit arrays by name, as `EndOutputs` fills them: branch by branch, and in each ray by ray."""

Arrays = dict[str, np.ndarray]


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
    outputs: Outputs,
    branches: int,
    rays: Int64[np.ndarray, " ray"],
    object_id: UInt8[np.ndarray, " shape"],
    weight: Float32[np.ndarray, "traced 3"] | None,
) -> Arrays:
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

    def rows(chosen: "mi.Bool", *names: str) -> Arrays:
        listed = dr.compress(chosen)
        components = {name: dr.width(outputs[name]) // num_slots for name in names}
        if not dr.width(listed):  # Dr.Jit 1.5 cannot gather with an empty index.
            empty = {name: np.zeros((0, count), np.float32) for name, count in components.items()}
            return {**empty, "end": np.zeros((0, 1), np.uint32), "ray": rays[:0]}
        index = dr.gather(mi.UInt32, place, listed)
        found = {name: dr.ravel(dr.gather(kinds[count], outputs[name], index)) for name, count in components.items()}
        dr.eval(index, found)
        arrays = {name: values.numpy().reshape(-1, components[name]) for name, values in found.items()}
        traced_ray = index.numpy() % num_traced
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


def join_ends(parts: list[Arrays]) -> Arrays:
    """The ends of several bundles, ray by ray."""
    if len(parts) == 1:
        return parts[0]
    joined = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    orders = {name: np.argsort(joined[name], kind="stable") for name in ("ray", "exit_ray")}
    return {name: values[orders["exit_ray" if name.startswith("exit_") else "ray"]] for name, values in joined.items()}
