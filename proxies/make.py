"""Making proxies: fits one to every object of a dataset, commits them, checks them."""

from dataclasses import dataclass

import numpy as np

from datagen.build.build import peel_dataset
from datagen.build.build_variant import peel_variants
from datagen.data.dataset import Dataset
from datagen.data.geometries import ProxyStatistics, read_assignment, read_meshes, read_proxy_records, write_proxies
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH, geometry_root
from datagen.disk.errors import HyalineError
from datagen.disk.heads import keep_head
from datagen.disk.ownership import PROXIES, holding, refuse_others
from datagen.disk.promises import check_files
from datagen.disk.storage import load_sealed
from datagen.terminal.command import say
from proxies.kinds.table import FITTERS
from proxies.meshing.measure import enclosure, proxy_statistics
from proxies.meshing.meshlab import meshlab_problem
from proxies.meshing.noise import noise_problem, noisy_mesh
from proxies.meshing.solid import Solid, make_solids
from proxies.spec import MixedSpec, ProxySpec, parse_part

PADDING = 2e-6
"""Step between the paddings of two proxies, in parts of the scene's extent."""


@dataclass(frozen=True, kw_only=True)
class ProxyReport:
    """One row of the table."""

    object: str
    kind: str
    triangles: int
    statistics: ProxyStatistics
    inside_share: float | None
    """Share of the object's vertices inside the proxy; None where it need not enclose anything (noise, the truth)."""
    problem: str | None
    """What is wrong with the proxy, in a few words."""


def make_and_peel(
    dataset: Dataset, spec: ProxySpec | MixedSpec, *, num_layers: int, workers: int = 1, overwrite: bool = False
) -> tuple[ProxyReport, ...]:
    """Fits a proxy to every object and peels all of them for every view; existing proxies and layers are kept.

    Args:
        num_layers: layers kept per ray.
        workers: parallel processes that peel.
        overwrite: replace existing proxies and layers.

    Raises:
        HyalineError: see `make_proxies` and `peel_dataset`.
    """
    say(f"{dataset.root}: makes {spec.geometry} proxies of {len(dataset.objects)} objects")
    if not make_proxies(dataset, spec, overwrite=overwrite):
        say(f"{dataset.root}: keeps its {spec.geometry} proxies; --overwrite makes them anew")
    reports = read_reports(dataset, spec.geometry)
    peel_dataset(dataset, spec.geometry, num_layers=num_layers, overwrite=overwrite, workers=workers)
    peel_variants(dataset, workers=workers)
    return reports


def make_proxies(dataset: Dataset, spec: ProxySpec | MixedSpec, *, overwrite: bool) -> bool:
    """Fits a proxy to every object and commits them; keeps those that stand there and verify.

    Returns:
        True when they were made, False when they were kept.

    Raises:
        HyalineError: a damaged scene, proxies of another dataset or another mixture, another process that writes there,
            or an object for which proxies of this kind cannot be made.
    """
    if dataset.edit is not None:
        # Its proxies are those of the base, moved as their objects were: fitted anew, they would have other texels.
        raise HyalineError(f"{dataset.root}: is an edit; make proxies of the dataset around it, which edits them along")
    root = geometry_root(dataset.root, spec.geometry)
    truths = read_meshes(dataset, TRUTH)
    assignment = spec.assignment if isinstance(spec, MixedSpec) else None
    with holding(root, PROXIES, within=dataset.root):
        if not overwrite and _stand(dataset, spec.geometry):
            _check_same_assignment(dataset, spec.geometry, assignment)
            keep_head(dataset.root, root / PROXIES.head)  # A kill may have come between the head and its copy.
            return False
        if (problem := meshlab_problem()) is not None:
            say(f"{problem}; SciPy and NumPy do its work")
        own = {PROXIES.head, *(f"meshes/{item.name}.ply" for item in dataset.objects)}
        refuse_others(root, PROXIES, but=lambda path: path in own)
        solids = make_solids(truths)
        parts = (spec,) * len(truths) if isinstance(spec, ProxySpec) else spec.parts
        meshes = fit_parts(truths, solids, parts)
        for item, part, mesh, truth in zip(dataset.objects, parts, meshes, truths, strict=True):
            _, problem = _soundness(part, mesh, truth)
            # Not only our own work: pymeshlab and xatlas have their part in it.
            if part is not None and problem is not None:
                raise HyalineError(f"{root}: the {part.kind} of {item.name} {problem}; make another kind")
        statistics = proxy_statistics(meshes, truths, solids)
        write_proxies(dataset, spec.geometry, meshes, statistics, assignment=assignment)
    return True


def fit_parts(
    truths: tuple[Mesh, ...], solids: tuple[Solid, ...], parts: tuple[ProxySpec | None, ...]
) -> tuple[Mesh, ...]:
    """What stands for each object: its true mesh, that mesh with noise, or a proxy.

    The paddings are those of a dataset whose objects all have proxies: an object gets the same box in any mixture.
    """
    meshes = dict(enumerate(truths))
    all_paddings = paddings(solids)
    for kind, fit in FITTERS.items():
        places = [place for place, part in enumerate(parts) if part is not None and part.kind == kind]
        if places:
            fitted = fit(tuple(solids[place] for place in places), tuple(all_paddings[place] for place in places))
            meshes.update(zip(places, fitted, strict=True))
    for place, part in enumerate(parts):
        if part is not None and part.amount is not None:
            meshes[place] = noisy_mesh(truths[place], part.amount, place=place)
    return tuple(meshes.values())


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


def read_reports(dataset: Dataset, geometry: str) -> tuple[ProxyReport, ...]:
    """The table of the proxies on disk, their enclosure checked anew.

    Raises:
        HyalineError: not made, damaged, or made for another dataset.
    """
    records = read_proxy_records(dataset, geometry)
    meshes, truths = read_meshes(dataset, geometry), read_meshes(dataset, TRUTH)
    kinds = read_assignment(dataset, geometry) or (geometry,) * len(records)
    reports = []
    for record, kind, mesh, truth in zip(records, kinds, meshes, truths, strict=True):
        inside_share, problem = _soundness(parse_part(kind), mesh, truth)
        reports.append(
            ProxyReport(
                object=record.object,
                kind=kind,
                triangles=len(mesh.faces),
                statistics=record.statistics,
                inside_share=inside_share,
                problem=problem,
            )
        )
    return tuple(reports)


def _soundness(part: ProxySpec | None, mesh: Mesh, truth: Mesh) -> tuple[float | None, str | None]:
    """`ProxyReport`'s share inside and problem."""
    if part is None:
        is_same = np.array_equal(mesh.vertices, truth.vertices) and np.array_equal(mesh.faces, truth.faces)
        return None, None if is_same else "is not the object's own mesh"
    if part.kind == "noise":
        return None, noise_problem(mesh, truth)
    found = enclosure(mesh, truth)
    return found.inside_share, found.problem


def _check_same_assignment(dataset: Dataset, geometry: str, assignment: tuple[str, ...] | None) -> None:
    """Refuses to keep a mixture that is not the one asked for."""
    before = read_assignment(dataset, geometry)
    if assignment is None or before is None:
        return
    for item, old, new in zip(dataset.objects, before, assignment, strict=True):
        if old != new:
            raise HyalineError(
                f"{geometry_root(dataset.root, geometry)}: has a {old} for {item.name}, not {new}; pass --overwrite, "
                "or another --name"
            )


def _stand(dataset: Dataset, geometry: str) -> bool:
    """True when proxies of this dataset stand there and verify; damaged ones are made again.

    Raises:
        HyalineError: they are of another dataset or format.
    """
    path = geometry_root(dataset.root, geometry) / "proxies.json"
    if not path.is_file():
        return False
    try:
        load_sealed(path)
    except HyalineError as error:
        say(f"{error}; makes them again")
        return False
    records = read_proxy_records(dataset, geometry)
    try:
        check_files(path.parent, {record.file: record.sha256 for record in records})
    except HyalineError as error:
        say(f"{error}; makes them again")
        return False
    return True
