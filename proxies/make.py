"""Owns the making of proxies: fits one to every object of a dataset, commits them, checks them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from datagen.command import say
from datagen.dataset import Dataset, check_files
from datagen.errors import HyalineError
from datagen.geometry import TRUTH, ProxyStatistics, geometry_root, read_meshes, read_proxy_records, write_proxies
from datagen.meshes import Mesh
from datagen.storage import load_sealed, one_writer, remove_temporaries
from proxies.box import fit_box
from proxies.ellipsoid import fit_ellipsoid
from proxies.measure import Enclosure, enclosure, proxy_statistics
from proxies.meshlab import meshlab_problem
from proxies.solid import Solid, make_solids

ProxyKind = Literal["box", "ellipsoid"]

FITTERS: dict[ProxyKind, Callable[..., Mesh]] = {"box": fit_box, "ellipsoid": fit_ellipsoid}
"""`FITTERS[kind](solid, padding=metres)` is a closed, outward mesh with a uv of its own for every surface point."""

PADDING = 2e-6
"""Step between the paddings of two proxies, in parts of the scene's extent."""


@dataclass(frozen=True, kw_only=True)
class ProxyReport:
    """One row of the table."""

    object: str
    triangles: int
    statistics: ProxyStatistics
    enclosure: Enclosure


def make_proxies(dataset: Dataset, kind: ProxyKind, *, overwrite: bool) -> bool:
    """Fits a proxy to every object and commits them; keeps those that stand there and verify.

    Returns:
        True when they were made, False when they were kept.

    Raises:
        HyalineError: a damaged scene, proxies of another dataset, or another process that writes there.
    """
    root = geometry_root(dataset.root, kind)
    truths = read_meshes(dataset, TRUTH)
    with one_writer(root):
        remove_temporaries(root)
        if not overwrite and _stand(dataset, kind):
            return False
        if (problem := meshlab_problem()) is not None:
            say(f"{problem}; SciPy and NumPy do its work")
        solids = make_solids(truths)
        meshes = fit_proxies(solids, kind)
        for item, mesh, truth in zip(dataset.objects, meshes, truths, strict=True):
            problem = enclosure(mesh, truth).problem
            assert problem is None, f"{kind} of {item.name} {problem}"
        write_proxies(dataset, kind, meshes, proxy_statistics(meshes, truths, solids))
    return True


def fit_proxies(solids: tuple[Solid, ...], kind: ProxyKind) -> tuple[Mesh, ...]:
    """One proxy a solid, no two of which have faces in the same plane."""
    fit = FITTERS[kind]
    return tuple(fit(solid, padding=padding) for solid, padding in zip(solids, paddings(solids), strict=True))


def paddings(solids: tuple[Solid, ...]) -> tuple[float, ...]:
    """How far each proxy grows beyond its object, in metres.

    Where two objects have sides in one plane (all that stands on a floor), so would their boxes, and of two coincident
    faces a ray finds only one: a layer is lost. Paddings that all differ by a step part such faces, those that face
    each other too. The thinnest object gets the smallest padding, since there it costs most; equal ones go by place.
    """
    low = np.min([solid.points.min(axis=0) for solid in solids], axis=0)
    high = np.max([solid.points.max(axis=0) for solid in solids], axis=0)
    thicknesses = np.array([solid.thickness for solid in solids])
    # A step stays above what float32 resolves at the scene's largest coordinate.
    step = max(PADDING * float((high - low).max()), 32 * 2.0**-24 * float(np.abs([low, high]).max()))
    rank = np.empty(len(solids), int)
    rank[np.argsort(thicknesses, kind="stable")] = np.arange(len(solids))
    return tuple(float(step * (1 + place)) for place in rank)


def read_reports(dataset: Dataset, kind: ProxyKind) -> tuple[ProxyReport, ...]:
    """The table of the proxies on disk, their enclosure checked anew.

    Raises:
        HyalineError: not made, damaged, or made for another dataset.
    """
    records = read_proxy_records(dataset, kind)
    meshes, truths = read_meshes(dataset, kind), read_meshes(dataset, TRUTH)
    return tuple(
        ProxyReport(
            object=record.object,
            triangles=len(mesh.faces),
            statistics=record.statistics,
            enclosure=enclosure(mesh, truth),
        )
        for record, mesh, truth in zip(records, meshes, truths, strict=True)
    )


def _stand(dataset: Dataset, kind: ProxyKind) -> bool:
    """True when proxies of this dataset stand there and verify; damaged ones are made again.

    Raises:
        HyalineError: they are of another dataset or format.
    """
    path = geometry_root(dataset.root, kind) / "proxies.json"
    if not path.is_file():
        return False
    try:
        load_sealed(path)
    except HyalineError as error:
        say(f"{error}; makes them again")
        return False
    records = read_proxy_records(dataset, kind)
    try:
        check_files(path.parent, {record.file: record.sha256 for record in records})
    except HyalineError as error:
        say(f"{error}; makes them again")
        return False
    return True
