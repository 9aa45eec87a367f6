"""Reads the results of `model fit`, and compares them with the truth.

RUNS/SCENE/NAME/fit.json   sealed: dataset (digest), geometry, and in the end objects and pictures (names of PNGs)
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from datagen.data.dataset import Dataset
from datagen.data.geometries import list_geometries, read_meshes
from datagen.data.meshes import Mesh, is_there, points_on, signed_volume, vertex_normals
from datagen.data.paths import TRUTH
from datagen.data.shape_errors import ShapeErrors, compare_surfaces, shape_errors
from datagen.disk.errors import HyalineError
from datagen.disk.names import check_name
from datagen.disk.records import Json, from_json, shown, to_json
from datagen.disk.storage import load_sealed
from datagen.scene.folder import open_scene
from eval.score.runs import is_number, list_run_folders

FIT, FIT_VERSION = "fit.json", 1
CAPTURE = "capture"
"""Layout of datasets of photographs, whose scene has stand-ins for glass."""
BESIDE_AXIS = 1e-4
"""Metres from the axis where the floor is measured: on it, edges meet."""
ABSORPTIONS = ("absorption_red", "absorption_green", "absorption_blue")
Section = Float[np.ndarray, "segment 2 2"]
"""Ends of line segments: distance from the axis and height, in metres."""


@dataclass(frozen=True, kw_only=True)
class FitObject:
    """One object as it was found; what does not apply to it is None."""

    name: str
    kind: str
    axis: dict[str, tuple[float, float, float]] | None = None
    """`point` and `direction` of the axis of a round one."""
    hull_outline: tuple[tuple[float, float], ...] | None = None
    """Distance from the axis and height in metres of the first outside, from masks alone."""
    numbers: dict[str, dict[str, float] | None] = field(default_factory=dict)
    """`value`, `low` and `high` by name: ior, wall, floor, ..."""
    history: tuple[dict[str, float], ...] = ()
    """The numbers of each step."""
    grid: tuple[dict[str, float], ...] = ()
    """Wall, floor, corner and loss of each cell, the best first."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Fit:
    """A finished fit of a dataset's glass."""

    folder: Path
    dataset: str
    """Digest."""
    geometry: str
    objects: tuple[FitObject, ...]
    pictures: tuple[str, ...]


def read_fits(root: Path, errors: list[HyalineError], *, besides: Path) -> list[Fit]:
    """The finished fits among the folders of runs.

    Args:
        errors: takes why a fit could not be read.
        besides: the report's own folder.
    """
    fits = []
    for folder in list_run_folders(root, besides=besides):
        try:
            if (folder / FIT).is_file() and "objects" in (content := load_sealed(folder / FIT)):
                fits.append(_fit(folder, content))
        except HyalineError as error:
            errors.append(error)
    return fits


def _fit(folder: Path, content: dict[str, Json]) -> Fit:
    where = str(folder / FIT)
    if content.get("version") != FIT_VERSION:
        raise HyalineError(f"{where}: format version {shown(content.get('version'))}; this program reads {FIT_VERSION}")
    listed: list[Json] = [path.name for path in sorted(folder.glob("*.png"))]
    pictures = from_json(tuple[str, ...], content.get("pictures", listed), where=f"{where}: pictures")
    return Fit(
        folder=folder,
        dataset=from_json(str, content.get("dataset"), where=f"{where}: dataset"),
        geometry=from_json(str, content.get("geometry"), where=f"{where}: geometry"),
        objects=from_json(tuple[FitObject, ...], _shown(content["objects"]), where=f"{where}: objects"),
        pictures=tuple(check_name(name, where=f"{where}: pictures") for name in pictures),
    )


def _shown(data: Json) -> Json:
    """The fields of fit.json's objects that a page shows."""
    if not isinstance(data, list):
        return data
    names = {item.name for item in fields(FitObject)}
    objects = [{key: value for key, value in item.items() if key in names} for item in data if isinstance(item, dict)]
    return [item | {name: _numbers(item.get(name)) for name in ("history", "grid")} for item in objects]


def _numbers(steps: Json) -> Json:
    """The numbers of each step, without what else is said of it."""
    found = [step for step in steps if isinstance(step, dict)] if isinstance(steps, list) else []
    return [{name: value for name, value in step.items() if is_number(value)} for step in found]


@dataclass(frozen=True, kw_only=True)
class Measured:
    """How an object of a fit compares with the truth; None where that is unknown."""

    errors: ShapeErrors | None
    hull_errors: ShapeErrors | None
    """The same of the first outside, as solid glass."""
    true: dict[str, float]
    """Numbers of the true object by their names in `FitObject.numbers`."""


def measure_fit(dataset: Dataset, fit: Fit) -> tuple[Measured, ...]:
    """How each object of a fit compares with the truth."""
    if not knows_truth(dataset):
        return (Measured(errors=None, hull_errors=None, true={}),) * len(fit.objects)
    truths, meshes = meshes_by_name(dataset, TRUTH), fitted_meshes(dataset, fit)
    materials = {item.name: item.material for item in open_scene(dataset).objects}
    measured = []
    for item in fit.objects:
        truth, true = truths.get(item.name), {}
        pairs = [None if truth is None or mesh is None else shape_errors(mesh, truth) for mesh in meshes[item.name]]
        if item.name in materials:
            material = materials[item.name]
            true = {"ior": material.surface().ior, "roughness": material.surface().roughness}
            if (medium := material.medium) is not None:
                true |= dict(zip(ABSORPTIONS, medium.absorption, strict=True))
        if pairs[0] is not None and pairs[0].true_thickness is not None:
            true["wall"] = pairs[0].true_thickness
        if truth is not None and item.axis is not None:
            true |= true_floor(truth, frame_of(item, truth))
        measured.append(Measured(errors=pairs[0], hull_errors=pairs[1], true=true))
    return tuple(measured)


def knows_truth(dataset: Dataset) -> bool:
    """True if the scene's meshes are what was seen."""
    return dataset.imported is None or (bool(dataset.objects) and dataset.imported.layout != CAPTURE)


def true_floor(truth: Mesh, frame: "Frame") -> dict[str, float]:
    """Height of the lowest point of the hollow above that of the outside; nothing if the axis misses the mesh."""
    cut = section_of(truth, frame) - [BESIDE_AXIS, 0]
    cut = cut[cut[:, 0, 0] * cut[:, 1, 0] < 0]
    (low, low_height), (high, high_height) = np.moveaxis(cut, (0, 1, 2), (2, 0, 1))
    heights = np.sort(low_height - low * (high_height - low_height) / (high - low))
    lowest = ((truth.vertices - frame.point) @ frame.up).min()
    return {"floor": float(heights[1] - lowest)} if len(heights) > 1 else {}


def meshes_by_name(dataset: Dataset, geometry: str) -> dict[str, Mesh]:
    """The meshes of a geometry that are there."""
    meshes = read_meshes(dataset, geometry)
    return {item.name: mesh for item, mesh in zip(dataset.objects, meshes, strict=True) if is_there(mesh)}


def fitted_meshes(dataset: Dataset, fit: Fit) -> dict[str, tuple[Mesh | None, Mesh | None]]:
    """Each object as it was found, and its first outside, by name."""
    found = meshes_by_name(dataset, fit.geometry) if fit.geometry in list_geometries(dataset) else {}
    return {item.name: (found.get(item.name), hull_mesh(item)) for item in fit.objects}


def hull_mesh(item: FitObject) -> Mesh | None:
    """The surface of revolution of an object's first outside; None if it is not round."""
    if item.hull_outline is None or item.axis is None:
        return None
    import trimesh

    line = np.array(item.hull_outline)
    line = np.concatenate([line[:1] * [0, 1], line, line[-1:] * [0, 1]])  # Closed at both ends.
    line = line[np.append(True, np.abs(np.diff(line, axis=0)).max(axis=1) > 1e-9)]
    shape = trimesh.creation.revolve(line, sections=96)
    shape.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], item.axis["direction"]))
    vertices = (shape.vertices + item.axis["point"]).astype(np.float32)
    faces = shape.faces.astype(np.int32)
    normals, uv = vertex_normals(vertices, faces).astype(np.float32), np.zeros((len(vertices), 2), np.float32)
    mesh = Mesh(vertices=vertices, faces=faces, normals=normals, uv=uv)
    return mesh if signed_volume(mesh) > 0 else Mesh(vertices=vertices, faces=faces[:, ::-1], normals=-normals, uv=uv)


# Drawn


@dataclass(frozen=True, kw_only=True, eq=False)
class Frame:
    """Where an object is cut and seen from."""

    point: np.ndarray
    up: np.ndarray
    across: np.ndarray
    """Unit vectors; the cut contains both."""


def frame_of(item: FitObject, mesh: Mesh) -> Frame:
    """Along the axis of a round object; upright through the middle of others."""
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)).astype(float) / 2
    axis = item.axis or {"point": middle, "direction": (0.0, 0.0, 1.0)}
    up = np.array(axis["direction"]) / np.linalg.norm(axis["direction"])
    across = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    return Frame(point=np.array(axis["point"]), up=up, across=across / np.linalg.norm(across))


def section_of(mesh: Mesh, frame: Frame) -> Section:
    """Where the plane of a frame cuts a mesh."""
    import trimesh

    shape = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    cut = trimesh.intersections.mesh_plane(shape, np.cross(frame.up, frame.across), frame.point)
    return (np.asarray(cut).reshape(-1, 2, 3) - frame.point) @ np.stack([frame.across, frame.up], axis=-1)


HEAT_SIDE, HEAT_POINTS, HEAT_TILT = 256, 400_000, np.radians(25)
"""Pixels of a side of a heat map, points drawn, and the angle from which it looks down."""
SMOOTHED = 4
"""Measured points whose distances are averaged for a drawn one."""


def heat_map(
    mesh: Mesh, distances: tuple[np.ndarray, np.ndarray], frame: Frame, most: float, *, is_cut: bool
) -> UInt8[np.ndarray, "h w 4"]:
    """A mesh seen from the side, coloured by its distance from the truth: dark for 0, bright for `most` metres.

    Args:
        distances: points on the mesh, and their distances.
        is_cut: leave out the half in front, so that the inside shows.
    """
    import matplotlib as mpl
    from scipy.spatial import KDTree

    front = np.cross(frame.across, frame.up)
    toward = np.cos(HEAT_TILT) * front + np.sin(HEAT_TILT) * frame.up
    found = points_on(mesh, HEAT_POINTS)
    local = found.position - frame.point
    keep = local @ front <= 0 if is_cut else np.ones(len(local), bool)
    order = np.flatnonzero(keep)[np.argsort(local[keep] @ toward, kind="stable")]  # The nearest is drawn last.
    flat = local @ np.stack([frame.across, np.cross(frame.across, toward)], axis=-1)
    low, size = flat.min(axis=0), np.ptp(flat, axis=0).max()
    pixel = ((flat - low - np.ptp(flat, axis=0) / 2) / size * (HEAT_SIDE - 8) + HEAT_SIDE / 2).astype(int)[order]
    near = KDTree(distances[0]).query(found.position[order], k=SMOOTHED)[1]
    far = distances[1][near].mean(axis=-1)
    corners = mesh.vertices[mesh.faces[found.face[order]]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lit = 0.55 + 0.45 * np.abs(normal @ toward) / np.linalg.norm(normal, axis=-1)
    color = mpl.colormaps["inferno"](0.1 + 0.9 * np.clip(far / most, 0, 1))
    color[:, :3] *= lit[:, None]
    image = np.zeros((HEAT_SIDE, HEAT_SIDE, 4), np.uint8)
    # Each point covers four pixels, so that no gaps show what is behind.
    spots = pixel[:, None] + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    image[spots[..., 1], spots[..., 0]] = np.rint(255 * color)[:, None]
    return image


def surface_distances(mesh: Mesh, truth: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Points on a mesh, and their distances from the truth in metres."""
    found, near = compare_surfaces(mesh, truth)
    return found.position, near.distance


def fit_data(fits: Sequence[tuple[Fit, tuple[Measured, ...]]]) -> Json:
    """Every fit's numbers and errors for results.json."""
    return {
        fit.folder.name: {
            item.name: {"kind": item.kind, "numbers": to_json(item.numbers), "measured": to_json(found)}
            for item, found in zip(fit.objects, measured, strict=True)
        }
        for fit, measured in fits
    }
