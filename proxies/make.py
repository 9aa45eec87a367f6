"""Making proxies: fits one to every object of a dataset, commits them, checks them."""

from dataclasses import dataclass

import numpy as np

from datagen.builder.build import peel_dataset
from datagen.builder.variants import peel_variants
from datagen.data.dataset import Dataset
from datagen.data.geometries import ProxyStatistics, read_assignment, read_meshes, read_proxy_records, write_proxies
from datagen.data.meshes import Mesh
from datagen.data.paths import TRUTH, geometry_root, is_fitted
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import PROXIES, holding, refuse_others
from datagen.disk.storage import check_files, load_sealed
from datagen.terminal.command import say
from proxies.meshing.measure import enclosure, proxy_statistics
from proxies.meshing.meshlab import meshlab_problem
from proxies.meshing.noise import noise_problem, noisy_mesh
from proxies.meshing.solid import Solid, make_solids
from proxies.spec import FITTERS, MixedSpec, ProxySpec, parse_part

PADDING = 2e-6
"""Step between the paddings of two proxies, relative to the scene's extent."""


@dataclass(frozen=True, kw_only=True)
class ProxyReport:
    """One row of the table."""

    object: str
    kind: str
    triangles: int
    statistics: ProxyStatistics
    inside_share: float | None
    """Share of the object's vertices inside the proxy; None for noise, truth and fitted glass, which need not enclose
    anything."""
    problem: str | None
    """The proxy's problem in a few words; None if it is sound."""


def make_and_peel(
    dataset: Dataset, spec: ProxySpec | MixedSpec, *, num_layers: int, workers: int = 1, overwrite: bool = False
) -> tuple[ProxyReport, ...]:
    """Fits a proxy to every object and peels all of them for every view; existing proxies and layers are kept.

    Args:
        num_layers: layers kept per ray.
        workers: parallel processes that peel.
        overwrite: replace existing proxies and layers.
    """
    say(f"{dataset.root}: making {spec.geometry} proxies of {len(dataset.objects)} objects")
    if not make_proxies(dataset, spec, overwrite=overwrite):
        say(f"{dataset.root}: keeps its {spec.geometry} proxies; --overwrite makes them again")
    reports = read_reports(dataset, spec.geometry)
    peel_dataset(dataset, spec.geometry, num_layers=num_layers, overwrite=overwrite, workers=workers)
    peel_variants(dataset, workers=workers)
    return reports


def make_proxies(dataset: Dataset, spec: ProxySpec | MixedSpec, *, overwrite: bool) -> bool:
    """Fits a proxy to every object and commits them; keeps existing ones that verify.

    Returns:
        True if they were made, False if they were kept.
    """
    if dataset.variant is not None:
        # An edit's proxies are those of the base, moved like their objects: new fits would have different texels.
        raise HyalineError(f"{dataset.root}: is a variant; make proxies of the dataset around it, which it shares")
    root = geometry_root(dataset.root, spec.geometry)
    truths = read_meshes(dataset, TRUTH)
    assignment = spec.assignment if isinstance(spec, MixedSpec) else None
    with holding(root, PROXIES, within=dataset.root):
        if not overwrite and _has_intact(dataset, spec.geometry):
            _check_same_assignment(dataset, spec.geometry, assignment)
            return False
        if (problem := meshlab_problem()) is not None:
            say(f"{problem}; using SciPy and NumPy instead")
        refuse_others(root, PROXIES)
        solids = make_solids(truths)
        parts = (spec,) * len(truths) if isinstance(spec, ProxySpec) else spec.parts
        meshes = fit_parts(truths, solids, parts)
        for item, part, mesh, truth in zip(dataset.objects, parts, meshes, truths, strict=True):
            _, problem = _soundness(TRUTH if part is None else part.geometry, mesh, truth)
            # Also checks the results of pymeshlab and xatlas.
            if part is not None and problem is not None:
                raise HyalineError(f"{root}: the {part.kind} of {item.name} {problem}; make another kind")
        statistics = proxy_statistics(meshes, truths, solids)
        write_proxies(dataset, spec.geometry, meshes, statistics, assignment=assignment)
    return True


def fit_parts(
    truths: tuple[Mesh, ...], solids: tuple[Solid, ...], parts: tuple[ProxySpec | None, ...]
) -> tuple[Mesh, ...]:
    """The mesh for each object: its true mesh, that mesh with noise, or a proxy.

    Paddings are as if all objects had proxies, so that an object gets the same box in any mixture.
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
    stored = [record.statistics for record in records if record.statistics is not None]
    # Fitted glass is measured when it is asked for.
    measured = stored if len(stored) == len(records) else proxy_statistics(meshes, truths, make_solids(truths))
    reports = []
    for record, numbers, kind, mesh, truth in zip(records, measured, kinds, meshes, truths, strict=True):
        inside_share, problem = _soundness(kind, mesh, truth)
        reports.append(
            ProxyReport(
                object=record.object,
                kind=kind,
                triangles=len(mesh.faces),
                statistics=numbers,
                inside_share=inside_share,
                problem=problem,
            )
        )
    return tuple(reports)


def _soundness(kind: str, mesh: Mesh, truth: Mesh) -> tuple[float | None, str | None]:
    """`ProxyReport`'s share inside and problem."""
    if is_fitted(kind):
        return None, enclosure(mesh, None).problem
    part = parse_part(kind)
    if part is None:
        is_same = np.array_equal(mesh.vertices, truth.vertices) and np.array_equal(mesh.faces, truth.faces)
        return None, None if is_same else "is not the object's own mesh"
    if part.kind == "noise":
        return None, noise_problem(mesh, truth)
    found = enclosure(mesh, truth)
    return found.inside_share, found.problem


def _check_same_assignment(dataset: Dataset, geometry: str, assignment: tuple[str, ...] | None) -> None:
    """Raises a HyalineError if the stored mixture is not the requested one."""
    before = read_assignment(dataset, geometry)
    if assignment is None or before is None:
        return
    for item, old, new in zip(dataset.objects, before, assignment, strict=True):
        if old != new:
            raise HyalineError(
                f"{geometry_root(dataset.root, geometry)}: has a {old} for {item.name}, not {new}; pass --overwrite, "
                "or another --name"
            )


def _has_intact(dataset: Dataset, geometry: str) -> bool:
    """True if proxies of this dataset exist and verify; damaged ones are made again."""
    path = geometry_root(dataset.root, geometry) / "proxies.json"
    if not path.is_file():
        return False
    try:
        load_sealed(path)
    except HyalineError as error:
        say(f"{error}; making them again")
        return False
    records = read_proxy_records(dataset, geometry)
    try:
        check_files(path.parent, {record.file: record.sha256 for record in records})
    except HyalineError as error:
        say(f"{error}; making them again")
        return False
    return True
