"""Fits in the report: what `model fit` found of each object beside the truth, and how far its mesh is off."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64

from datagen.data.dataset import Dataset
from datagen.data.geometries import list_geometries, read_meshes
from datagen.data.images import read_png
from datagen.data.meshes import Mesh, SurfacePoints, face_corners, is_there, normals_of, points_on
from datagen.data.paths import TRUTH
from datagen.data.queries import crossings, nearest_points
from datagen.disk.errors import HyalineError, shown
from datagen.disk.ownership import FolderKind
from datagen.disk.records import Json, from_json, load_sealed, to_json
from datagen.scene.folder import open_scene
from eval.tables.grids import MISSING, Column, Grid, format_number
from eval.tables.plugins import FoundPart, PartPage, ReportPart
from eval.tables.results import Stored
from hyaline_photos.commands import SCALE
from hyaline_photos.fit.shapes import perpendicular

FIT = FolderKind(what="fit", head="fit.json")
FIT_VERSION = 3
CAPTURE = "capture"
"""Layout of datasets of photographs, whose scene has stand-ins for glass."""
BESIDE_AXIS = 1e-4
"""Metres from the axis where the floor is measured: on it, edges meet."""
CHANNELS = ("absorption_red", "absorption_green", "absorption_blue")
COVERED = 0.9
"""Share of the intervals that should hold the truth."""


@dataclass(frozen=True, kw_only=True)
class FitObject:
    """One object of a fit.json, as far as a report reads it."""

    name: str
    kind: str
    axis: dict[str, tuple[float, float, float]] | None = None
    """`point` and `direction` of the axis of a round one."""
    numbers: dict[str, dict[str, float] | None]
    """`value`, `low` and `high` by name: ior, wall, floor, ...; None: does not apply."""
    overruled: tuple[str, ...] = ()
    """Pictures whose masks lack parts of it that the others show."""


def find_fits(
    datasets: Sequence[Dataset], folders: Sequence[Path], errors: list[HyalineError]
) -> list[FoundPart | None]:
    """The finished fits of each dataset."""
    data: list[dict[str, Json]] = [{} for _ in datasets]
    pages: list[list[PartPage]] = [[] for _ in datasets]
    for folder in folders:
        try:
            content = load_sealed(folder / FIT.head)
            for place, dataset in enumerate(datasets):
                if content.get("dataset") == dataset.seal and "objects" in content:
                    stored, page = _read_fit(folder, content, dataset)
                    data[place][folder.name] = stored
                    pages[place].append(page)
        except HyalineError as error:
            errors.append(error)
    return [FoundPart(data=found, pages=tuple(page)) if found else None for found, page in zip(data, pages)]


def _read_fit(folder: Path, content: dict[str, Json], dataset: Dataset) -> tuple[dict[str, Json], PartPage]:
    """A fit for results.json, and its page."""
    where = str(folder / FIT.head)
    if content.get("version") != FIT_VERSION:
        raise HyalineError(f"{where}: format version {shown(content.get('version'))}; this program reads {FIT_VERSION}")
    geometry = from_json(str, content.get("geometry"), where=f"{where}: geometry")
    names, listed = {field.name for field in fields(FitObject)}, content["objects"]
    if isinstance(listed, list):
        listed: Json = [{key: each[key] for key in each if key in names} for each in listed if isinstance(each, dict)]
    objects = from_json(tuple[FitObject, ...], listed, where=f"{where}: objects")
    stored: dict[str, Json] = {
        item.name: {"kind": item.kind, "numbers": to_json(item.numbers), "measured": measured}
        for item, measured in zip(objects, measure(dataset, geometry, objects), strict=True)
    }
    note = f"Runs on what was found: `--geometry {geometry}`."
    for item in objects:
        if item.overruled:
            note += f" Left out for {item.name}, since other pictures show more of it: {', '.join(item.overruled)}."
    if not knows_truth(dataset):
        scale = [line for line in (dataset.imported.remarks if dataset.imported else ()) if line.startswith(SCALE)]
        note = " ".join([note, "The true glass is unknown.", *scale])
    page = PartPage(
        title=folder.name,
        note=note,
        grids=tuple(scene_grids(dataset.name, {folder.name: stored})),
        pictures={path.stem: functools.partial(read_png, path) for path in sorted(folder.glob("*.png"))},
    )
    return stored, page


def measure(dataset: Dataset, geometry: str, objects: Sequence[FitObject]) -> list[Json]:
    """How each object of a fit compares with the truth: the errors of its mesh, and the true object's numbers."""
    if not knows_truth(dataset):
        return [{"errors": None, "true": {}} for _ in objects]
    truths = _meshes(dataset, TRUTH)
    meshes = _meshes(dataset, geometry) if geometry in list_geometries(dataset) else {}
    materials = {item.name: item.material for item in open_scene(dataset).objects}
    measured: list[Json] = []
    for item in objects:
        truth, mesh, true = truths.get(item.name), meshes.get(item.name), dict[str, float]()
        errors = None if truth is None or mesh is None else shape_errors(mesh, truth)
        if (material := materials.get(item.name)) is not None:
            true = {"ior": material.surface().ior, "roughness": material.surface().roughness}
            if (medium := material.medium) is not None:
                true |= dict(zip(CHANNELS, medium.absorption, strict=True))
        if errors is not None and errors.true_thickness is not None:
            true["wall"] = errors.true_thickness
        if truth is not None and item.axis is not None:
            true |= true_floor(truth, np.array(item.axis["point"]), np.array(item.axis["direction"]))
        measured.append({"errors": to_json(errors), "true": to_json(true)})
    return measured


def knows_truth(dataset: Dataset) -> bool:
    """True if the scene's meshes are what was seen."""
    return dataset.imported is None or (bool(dataset.objects) and dataset.imported.layout != CAPTURE)


def _meshes(dataset: Dataset, geometry: str) -> dict[str, Mesh]:
    """The meshes of a geometry that are there, by name."""
    meshes = read_meshes(dataset, geometry)
    return {item.name: mesh for item, mesh in zip(dataset.objects, meshes, strict=True) if is_there(mesh)}


def true_floor(truth: Mesh, point: np.ndarray, up: np.ndarray) -> dict[str, float]:
    """Height of the lowest point of the hollow above that of the outside; nothing if the axis misses the mesh."""
    import trimesh

    across, aside = perpendicular(up)
    shape = trimesh.Trimesh(truth.vertices, truth.faces, process=False)
    cut = np.asarray(trimesh.intersections.mesh_plane(shape, aside, point)).reshape(-1, 2, 3)
    ends = (cut - point) @ np.stack([across, up], axis=-1) - [BESIDE_AXIS, 0]
    ends = ends[ends[:, 0, 0] * ends[:, 1, 0] < 0]
    (low, low_height), (high, high_height) = np.moveaxis(ends, (0, 1, 2), (2, 0, 1))
    heights = np.sort(low_height - low * (high_height - low_height) / (high - low))
    lowest = ((truth.vertices - point) @ up).min()
    return {"floor": float(heights[1] - lowest)} if len(heights) > 1 else {}


# Distances, normals, and the thickness of walls

SAMPLES = 4096
"""Points on each mesh where distances and normals are compared."""
WALL_SAMPLES = 2048
"""Points on each mesh where thickness is measured."""


@dataclass(frozen=True, kw_only=True)
class ShapeErrors:
    """How far a mesh is from the true one; lengths in metres."""

    chamfer: float
    """Chamfer distance: the mean distance from each surface to the other, averaged over both directions."""
    normal_deg: float
    """Median angle in degrees between shading normals, on points of the mesh and the nearest true ones."""
    thickness: float | None
    """Median thickness of the mesh, measured from its outside; None if it is open."""
    true_thickness: float | None
    """Median thickness of the true mesh."""


def shape_errors(mesh: Mesh, truth: Mesh) -> ShapeErrors:
    """Compares two surfaces on points of both, the same ones every time."""
    found, back = points_on(mesh, SAMPLES), points_on(truth, SAMPLES)
    forth, near = nearest_points(found.position, face_corners(truth).astype(np.float64))
    back, _ = nearest_points(back.position, face_corners(mesh).astype(np.float64))
    cosines = np.einsum("pc,pc->p", shading_normals(mesh, found), shading_normals(truth, near))
    return ShapeErrors(
        chamfer=float(forth.mean() + back.mean()) / 2,
        normal_deg=float(np.degrees(np.arccos(np.clip(np.median(cosines), -1, 1)))),
        thickness=_median(measure_walls(mesh)),
        true_thickness=_median(measure_walls(truth)),
    )


def shading_normals(mesh: Mesh, points: SurfacePoints) -> Float64[np.ndarray, "point 3"]:
    """Unit normals as light sees them, interpolated between the corners of each point's face."""
    from trimesh.triangles import points_to_barycentric

    weights = points_to_barycentric(face_corners(mesh)[points.face].astype(np.float64), points.position)
    normals = np.einsum("pk,pkc->pc", weights, mesh.normals[mesh.faces[points.face]].astype(np.float64))
    return normals / np.linalg.norm(normals, axis=-1, keepdims=True)


def measure_walls(mesh: Mesh, count: int = WALL_SAMPLES) -> Float64[np.ndarray, " point"]:
    """Distances in metres along the face's normal, inwards, to the next surface, from points of the outside.

    The outside is where the normal meets the mesh nowhere else; points with no surface opposite are left out.
    """
    corners, found = face_corners(mesh), points_on(mesh, count)
    directions = normals_of(corners)[found.face]
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    tolerance = 1e-6 * float(np.linalg.norm(np.ptp(mesh.vertices, axis=0)))
    thickness = np.full(count, np.inf)
    for line, _, along in crossings(corners, found.position, directions):
        np.minimum.at(thickness, line, np.where(along < -tolerance, -along, np.inf))
        thickness[line[along > tolerance]] = -np.inf  # Not outside; the minimum keeps it so.
    return thickness[np.isfinite(thickness)]


def _median(values: Float[np.ndarray, " _"]) -> float | None:
    return float(np.median(values)) if len(values) else None


# Tables, all of them from results.json


def _grid(title: str, texts: Sequence[str], numbers: Sequence[str], rows: list[tuple[str, ...]], note: str) -> Grid:
    """A table whose first columns are texts."""
    columns = [*(Column(group=text, is_number=False) for text in texts), *(Column(group=text) for text in numbers)]
    return Grid(title=title, columns=tuple(columns), rows=tuple(rows), notes=(note,))


def scene_grids(scene: str, fits: Stored) -> list[Grid]:
    """What `model fit` found of each object, beside the truth in brackets."""
    every = [(fit, name, item) for fit, objects in fits.items() for name, item in objects.items()]
    if not any(item["measured"]["true"] for *_, item in every):
        rows = [(fit, name, item["kind"], *_interval_cells(item["numbers"])) for fit, name, item in every]
        note = "In brackets, intervals. The wall is that above the floor; floor and level are heights above the bottom."
        columns = ("wall mm", "floor mm", "level mm", "index", "absorption 1/m", "roughness")
        return [_grid(f"{scene}: glass found from masks and pictures", ("fit", "object", "kind"), columns, rows, note)]
    columns = ("surface mm ↓", "normals ° ↓", "wall mm", "index", "absorption 1/m", "roughness")
    rows = [(fit, name, item["kind"], *_fit_cells(item["numbers"], item["measured"])) for fit, name, item in every]
    note = (
        "True values in brackets. Surface: Chamfer distance of the whole surface, insides too, from the true one: "
        "the mean of both directions. Normals: median error. Wall: median thickness."
    )
    return [_grid(f"{scene}: glass found from masks and pictures", ("fit", "object", "kind"), columns, rows, note)]


def _interval_cells(numbers: Stored) -> tuple[str, ...]:
    """Wall, floor, level, index, absorption and roughness of one object, with their intervals."""

    def found(key: str, decimals: int, unit: float = 1.0) -> str:
        if (number := numbers.get(key)) is None:
            return MISSING
        value, low, high = (format_number(number[each] / unit, decimals) for each in ("value", "low", "high"))
        return f"{value} ({low} to {high})"

    tints = [found(channel, 0) for channel in CHANNELS if channel in numbers]
    lengths = [found(key, 2, unit=1e-3) for key in ("wall", "floor", "level")]
    return *lengths, found("ior", 3), ", ".join(tints) or MISSING, found("roughness", 2)


def _fit_cells(numbers: Stored, measured: Stored) -> tuple[str, ...]:
    """Surface, normals, wall, index, absorption and roughness of one object."""
    errors, true = measured["errors"] or {}, measured["true"]

    def found(key: str, decimals: int) -> str:
        if numbers.get(key) is None:
            return MISSING
        value = format_number(numbers[key]["value"], decimals)
        return value if true.get(key) is None else f"{value} ({format_number(true[key], decimals)})"

    def millimetres(key: str) -> str:
        return format_number(None if errors.get(key) is None else 1000 * errors[key], 2)

    has_wall = numbers.get("wall") is not None
    tints = [found(channel, 1) for channel in CHANNELS]
    return (
        millimetres("chamfer"),
        format_number(errors.get("normal_deg"), 1),
        f"{millimetres('thickness')} ({millimetres('true_thickness')})" if has_wall else MISSING,
        found("ior", 3),
        MISSING if MISSING in tints else ", ".join(tints),
        found("roughness", 2),
    )


def coverage_grids(scenes: dict[str, Stored]) -> list[Grid]:
    """How many intervals of fits hold the truth, by dataset and kind of number; nothing where no truth is known."""
    misses: dict[str, dict[str, list[float]]] = {}
    for scene, fits in scenes.items():
        for objects in fits.values():
            for item in objects.values():
                for key, found in item["numbers"].items():
                    if (true := item["measured"]["true"].get(key)) is not None:
                        of_scene = misses.setdefault(scene, {})
                        of_scene.setdefault(key.split("_")[0], []).append(_miss(found, true))
    if not misses:
        return []
    keys = list(dict.fromkeys(key for of_scene in misses.values() for key in of_scene))
    pooled = {key: [each for of_scene in misses.values() for each in of_scene.get(key, [])] for key in keys}
    rows = []
    for scene, found in [*misses.items(), ("all", pooled)]:
        cells = [found.get(key, []) for key in keys]
        rows.append(
            (scene, *(f"{sum(each <= 1 for each in cell)} of {len(cell)}" if cell else MISSING for cell in cells))
        )
    wider = [float(np.quantile(pooled[key], COVERED, method="higher")) for key in keys]
    rows.append((f"factor for {100 * COVERED:.0f} %", *(format_number(each, 1) for each in wider)))
    note = (
        "Absorption: each colour channel by itself. Factor: by how much intervals would have to be wider for "
        f"{100 * COVERED:.0f} % of all to contain the true value."
    )
    titles = ["index" if key == "ior" else key for key in keys]
    return [_grid("intervals of fits that contain the true value", ("dataset",), titles, rows, note)]


def _miss(found: Stored, true: float) -> float:
    """Distance of the truth from a value, relative to the interval's width on that side; 1 at its end."""
    value = found["value"]
    side = found["high"] - value if true > value else value - found["low"]
    return abs(true - value) / side if side > 0 else (0.0 if true == value else math.inf)


FITS = ReportPart(head=FIT.head, find=find_fits, scene_grids=scene_grids, all_grids=coverage_grids)
"""The entry point `fits` of `hyaline.report_parts`."""
