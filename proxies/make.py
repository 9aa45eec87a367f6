"""Making proxies: fits one to every object of a dataset, commits them, checks them."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import numpy as np

from datagen.builder.build import peel_dataset
from datagen.builder.variants import peel_variants
from datagen.data.dataset import Dataset
from datagen.data.geometries import ProxyStatistics, read_assignment, read_meshes, read_proxy_records, write_proxies
from datagen.data.meshes import Mesh
from datagen.data.paths import MIXED, PROXY_KINDS, TRUTH, ProxyKind, geometry_root, is_fitted
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import PROXIES, holding, refuse_others
from datagen.disk.storage import check_files
from datagen.terminal.command import choose, say
from proxies.kinds.box import fit_box
from proxies.kinds.ellipsoid import fit_ellipsoid
from proxies.kinds.hull import fit_hulls
from proxies.kinds.wrap import fit_wraps
from proxies.solid import Solid, enclosure, make_solid, proxy_statistics

PADDING = 2e-6
"""Step between the paddings of two proxies, relative to the scene's extent."""

Fitter = Callable[[tuple[Solid, ...], tuple[float, ...]], tuple[Mesh, ...]]


def one_by_one(fit: Callable[..., Mesh]) -> Fitter:
    """A fitter that calls `fit(solid, padding=...)` for each object."""
    return lambda solids, paddings: tuple(
        fit(solid, padding=padding) for solid, padding in zip(solids, paddings, strict=True)
    )


FITTERS: dict[ProxyKind, Fitter] = {
    "box": one_by_one(fit_box),
    "ellipsoid": one_by_one(fit_ellipsoid),
    "hull": fit_hulls,
    "wrap": fit_wraps,
}
"""`FITTERS[kind](solids, paddings)` gives closed, outward meshes with a unique uv for every surface point.

Each encloses its solid at the distance of its padding in metres.
"""


@dataclass(frozen=True, kw_only=True)
class ProxyReport:
    """One row of the table."""

    object: str
    kind: str
    triangles: int
    statistics: ProxyStatistics
    inside_share: float | None
    """Share of the object's vertices inside the proxy; None for truth and fitted glass, which need not."""
    problem: str | None
    """The proxy's problem in a few words; None if it is sound."""


def assign_kinds(objects: Sequence[str], assignments: Sequence[str]) -> tuple[str, ...]:
    """The kind of each object's proxy, such as ellipsoids for plants and boxes for shelves; `truth` is its own mesh.

    Args:
        objects: names, in object order.
        assignments: each `OBJECT=KIND`, where OBJECT is a name or a pattern such as `fern*`; the last one counts.
            Objects without one keep their own mesh.

    Source: paper section 5.2 and Figure 8.
    """
    kinds = dict.fromkeys(objects, TRUTH)
    for assignment in assignments:
        pattern, equals, kind = assignment.partition("=")
        if not (pattern and equals and kind):
            raise HyalineError(f"assign {assignment!r}: expected OBJECT=KIND, such as fern=ellipsoid")
        choose("kind", kind, [TRUTH, *PROXY_KINDS])
        named = [name for name in objects if fnmatchcase(name, pattern)] or [choose("object", pattern, objects)]
        kinds |= dict.fromkeys(named, kind)
    return tuple(kinds.values())


def make_and_peel(
    dataset: Dataset,
    geometry: str,
    kinds: tuple[str, ...] | None = None,
    *,
    num_layers: int,
    workers: int = 1,
    overwrite: bool = False,
) -> tuple[ProxyReport, ...]:
    """Fits a proxy to every object and peels all of them for every view; existing proxies and layers are kept.

    Args:
        geometry: a kind of proxy, or the name of a mixture.
        kinds: for a mixture, the kind of each object's proxy, in object order.
        num_layers: layers kept per ray.
        workers: parallel processes that peel.
        overwrite: replace existing proxies and layers.
    """
    say(f"{dataset.root}: making {geometry} proxies of {len(dataset.objects)} objects")
    if not make_proxies(dataset, geometry, kinds, overwrite=overwrite):
        say(f"{dataset.root}: keeps its {geometry} proxies; --overwrite makes them again")
    reports = read_reports(dataset, geometry)
    peel_dataset(dataset, geometry, num_layers=num_layers, overwrite=overwrite, workers=workers)
    peel_variants(dataset, workers=workers)
    return reports


def make_proxies(
    dataset: Dataset, geometry: str, kinds: tuple[str, ...] | None = None, *, overwrite: bool = False
) -> bool:
    """Fits a proxy to every object and commits them; keeps existing ones that verify.

    Returns:
        True if they were made, False if they were kept.
    """
    if dataset.variant is not None:
        # An edit's proxies are those of the base, moved like their objects: new fits would have different texels.
        raise HyalineError(f"{dataset.root}: is a variant; make proxies of the dataset around it, which it shares")
    if kinds is not None and not re.fullmatch(rf"{MIXED}(-[A-Za-z0-9_]+)*", geometry):
        raise HyalineError(f"name {geometry!r}: expected {MIXED}, or {MIXED}- and letters or digits")
    root = geometry_root(dataset.root, geometry)
    truths = read_meshes(dataset, TRUTH)
    with holding(root, PROXIES, within=dataset.root):
        if not overwrite and _has_intact(dataset, geometry, kinds):
            return False
        refuse_others(root, PROXIES)
        solids = tuple(make_solid(truth) for truth in truths)
        each = (geometry,) * len(truths) if kinds is None else kinds
        meshes = fit_each(truths, solids, each)
        for item, kind, mesh, truth in zip(dataset.objects, each, meshes, truths, strict=True):
            # Also checks the results of pymeshlab and xatlas.
            if (problem := _soundness(kind, mesh, truth)[1]) is not None:
                raise HyalineError(f"{root}: the {kind} of {item.name} {problem}; make another kind")
        statistics = tuple(map(proxy_statistics, meshes, truths, solids))
        write_proxies(dataset, geometry, meshes, statistics, assignment=kinds)
    return True


def fit_each(truths: tuple[Mesh, ...], solids: tuple[Solid, ...], kinds: tuple[str, ...]) -> tuple[Mesh, ...]:
    """The mesh for each object: its true mesh, or a proxy.

    Paddings are as if all objects had proxies, so that an object gets the same box in any mixture.
    """
    meshes = dict(enumerate(truths))
    all_paddings = paddings(solids)
    for kind, fit in FITTERS.items():
        places = [place for place, own in enumerate(kinds) if own == kind]
        if places:
            fitted = fit(tuple(solids[place] for place in places), tuple(all_paddings[place] for place in places))
            meshes.update(zip(places, fitted, strict=True))
    return tuple(meshes.values())


def paddings(solids: tuple[Solid, ...]) -> tuple[float, ...]:
    """The distance in metres by which each proxy grows beyond its object.

    If two objects have sides in one plane (everything on a floor), their boxes would, too, and a ray only finds one of
    two coincident faces: a layer would be lost. Different paddings separate such faces, including faces in contact. The
    thinnest object gets the smallest padding, because it costs most there; equal ones are ordered by place.
    """
    low = np.min([solid.points.min(axis=0) for solid in solids], axis=0)
    high = np.max([solid.points.max(axis=0) for solid in solids], axis=0)
    thicknesses = np.array([solid.thickness for solid in solids])
    # A step is larger than float32 resolution at the scene's largest coordinate.
    step = max(PADDING * float((high - low).max()), 32 * 2.0**-24 * float(np.abs([low, high]).max()))
    rank = np.empty(len(solids), int)
    rank[np.argsort(thicknesses, kind="stable")] = np.arange(len(solids))
    return tuple(float(step * (1 + place)) for place in rank)


def read_reports(dataset: Dataset, geometry: str) -> tuple[ProxyReport, ...]:
    """The table of the proxies on disk, with their enclosure checked again."""
    records = read_proxy_records(dataset, geometry)
    meshes, truths = read_meshes(dataset, geometry), read_meshes(dataset, TRUTH)
    kinds = read_assignment(dataset, geometry) or (geometry,) * len(records)
    reports = []
    for record, kind, mesh, truth in zip(records, kinds, meshes, truths, strict=True):
        inside_share, problem = _soundness(kind, mesh, truth)
        reports.append(
            ProxyReport(
                object=record.object,
                kind=kind,
                triangles=len(mesh.faces),
                # Fitted glass is measured when it is asked for.
                statistics=record.statistics or proxy_statistics(mesh, truth, make_solid(truth)),
                inside_share=inside_share,
                problem=problem,
            )
        )
    return tuple(reports)


def _soundness(kind: str, mesh: Mesh, truth: Mesh) -> tuple[float | None, str | None]:
    """`ProxyReport`'s share inside and problem."""
    if kind == TRUTH:
        is_same = np.array_equal(mesh.vertices, truth.vertices) and np.array_equal(mesh.faces, truth.faces)
        return None, None if is_same else "is not the object's own mesh"
    if is_fitted(kind):
        return None, enclosure(mesh, None).problem
    found = enclosure(mesh, truth)
    return found.inside_share, found.problem


def _has_intact(dataset: Dataset, geometry: str, kinds: tuple[str, ...] | None) -> bool:
    """True if proxies of this dataset exist and verify; damaged meshes are made again.

    Raises a HyalineError if they are another mixture.
    """
    root = geometry_root(dataset.root, geometry)
    if not (root / PROXIES.head).is_file():
        return False
    records = read_proxy_records(dataset, geometry)
    for item, old, new in zip(dataset.objects, read_assignment(dataset, geometry) or (), kinds or ()):
        if old != new:
            raise HyalineError(f"{root}: has a {old} for {item.name}, not {new}; pass --overwrite, or another --name")
    try:
        check_files(root, {record.file: record.sha256 for record in records})
    except HyalineError as error:
        say(f"{error}; making them again")
        return False
    return True
