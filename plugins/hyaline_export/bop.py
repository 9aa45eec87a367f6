"""BOP: pose, masks and visible share of every object, scene-wise, as tools for 6-D poses and the BOP toolkit read them.

    ROLE_pbr/000000/scene_camera.json    by picture: cam_K, pose, depth_scale; `view` is its name in the dataset
    ROLE_pbr/000000/scene_gt.json        by picture, each object: obj_id and pose
    ROLE_pbr/000000/scene_gt_info.json   by picture, each object: boxes, numbers of pixels, visible share
    ROLE_pbr/000000/rgb/000000.png       8-bit sRGB
    ROLE_pbr/000000/depth/000000.png     16 bits, millimetres along the axis to the first surface, glass or not; 0: none
                                         (bop-sensor: as a structured-light camera measures it, sensor.py)
    ROLE_pbr/000000/mask/000000_000000.png           picture, object: the object's silhouette, 255, also behind others
    ROLE_pbr/000000/mask_visib/000000_000000.png     where the object is seen first: glass hides what is behind it
    models/obj_000001.ply, models/models_info.json   shapes, diameters, symmetries of glass
    camera.json                                      the lens again

ROLE is train, val or test. Lengths are millimetres. Cameras are OpenCV's, and a pixel's centre has whole coordinates:
`cx` and `cy` are half a pixel less than elsewhere. A model's origin is the middle of its box, and its axes are the
world's. `obj_id` is the dataset's object id. Silhouettes are counted beyond the picture's edges, too, up to its size.

Source: https://github.com/thodan/bop_toolkit/blob/master/docs/bop_datasets_format.md, scripts/calc_gt_info.py.
"""

import dataclasses
import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import ConvexHull, KDTree
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from datagen.data.cameras import Camera
from datagen.data.config import DatasetObject
from datagen.data.dataset import check_has_meshes
from datagen.data.meshes import Mesh, face_corners, is_there
from datagen.data.ply import write_ply
from datagen.disk.records import Json, dump_json
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.quantities import surfaces_of
from datagen.trace.peel import Peeler
from hyaline_export.formats import Format
from hyaline_export.sensor import sensor_depth
from hyaline_export.source import Source, depth_png, mask_png, rgb_png, tracked

MM = 1000.0
MAX_ORDER, ROUND = 128, 24
"""The largest order of symmetry that is sought, and the least that counts as continuous: its edges are off by 1 %."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Model:
    """An object, its mesh in the world in metres, and the middle of its box."""

    object_id: int
    item: DatasetObject
    mesh: Mesh
    center: Float[np.ndarray, "3"]
    peeler: Peeler

    def ply(self) -> bytes:
        vertices = (MM * (self.mesh.vertices - self.center)).astype(np.float32)
        return write_ply(dataclasses.replace(self.mesh, vertices=vertices))

    def info(self) -> dict[str, Json]:
        """Its entry in models_info.json."""
        points = MM * (np.unique(self.mesh.vertices, axis=0) - self.center)
        # Joggled, since the points of a pane lie in a plane.
        outside = points[ConvexHull(points, qhull_options="QJ").vertices]
        diameter = max(float(cdist(part, outside).max()) for part in np.array_split(outside, len(outside) // 1000 + 1))
        box = {"min": points.min(axis=0).tolist(), "size": np.ptp(points, axis=0).tolist()}
        sides: dict[str, Json] = {f"{key}_{axis}": at for key in box for axis, at in zip("xyz", box[key], strict=True)}
        centers = MM * (face_corners(self.mesh).mean(axis=1) - self.center)
        known = symmetries(points, centers, diameter) if self.item.is_glass else {}
        return {"name": self.item.name, "is_glass": self.item.is_glass, "diameter": diameter, **sides, **known}


def symmetries(
    points: Float[np.ndarray, "point 3"], centers: Float[np.ndarray, "face 3"], diameter: float
) -> dict[str, Json]:
    """The symmetries of a solid around the upright axis through its origin, and of a ball.

    Turned, each vertex of the solid falls on one. A ball's vertices and faces are all equally far from its origin.
    """
    if np.ptp(np.linalg.norm(np.concatenate([points, centers]), axis=-1)) < 0.005 * diameter:
        return {"symmetries_continuous": [_around(axis) for axis in np.eye(3).tolist()]}
    tree = KDTree(points)

    def has(order: int) -> bool:
        turn = Rotation.from_rotvec([0, 0, 2 * np.pi / order])
        parts = (points[:: len(points) // 100 + 1], points)  # A few points refute most orders.
        return all(np.isfinite(tree.query(turn.apply(p), distance_upper_bound=1e-5 * diameter)[0]).all() for p in parts)

    order = next(order for order in range(MAX_ORDER, 0, -1) if has(order))
    if order >= ROUND:
        return {"symmetries_continuous": [_around([0.0, 0.0, 1.0])]}
    turns = np.tile(np.eye(4), (order, 1, 1))
    turns[:, :3, :3] = Rotation.from_rotvec(np.outer(np.arange(order), [0, 0, 2 * np.pi / order])).as_matrix()
    discrete: list[Json] = [[*turn] for turn in turns[1:].reshape(-1, 16).tolist()]
    return {"symmetries_discrete": discrete} if discrete else {}


def _around(axis: list[float]) -> Json:
    return {"axis": [*axis], "offset": [0.0, 0.0, 0.0]}


def _bop(source: Source, *, has_sensor: bool) -> Iterator[tuple[str, bytes]]:
    check_has_meshes(source.dataset)
    use_mitsuba()
    there = zip(source.dataset.objects, surfaces_of(source.dataset).meshes, strict=True)
    models = []
    for number, (item, mesh) in enumerate(there, start=1):
        if is_there(mesh):
            center = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)).astype(np.float64) / 2
            models.append(_Model(object_id=number, item=item, mesh=mesh, center=center, peeler=Peeler((mesh,))))
    for model in models:
        yield f"models/obj_{model.object_id:06d}.ply", model.ply()
    yield "models/models_info.json", dump_json({str(model.object_id): model.info() for model in models})
    matrix, lens = source.lens.intrinsics.copy(), source.lens
    matrix[:2, 2] -= 0.5
    values = matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    numbers: dict[str, Json] = dict(zip(("fx", "fy", "cx", "cy"), values, strict=True))
    yield "camera.json", dump_json({**numbers, "width": lens.width, "height": lens.height, "depth_scale": 1.0})
    scenes: dict[str, list[dict[str, Json]]] = {}
    for item in tracked(source.views):
        folder = f"{item.role}_pbr/000000"
        cameras, truths, infos = scenes.setdefault(folder, [{}, {}, {}])
        number, camera, found = len(cameras), item.view.camera, item.quantities
        yield f"{folder}/rgb/{number:06d}.png", rgb_png(item)
        depth = sensor_depth(found) if has_sensor else found.depth_along_axis
        yield f"{folder}/depth/{number:06d}.png", depth_png(depth)
        rotation = (camera.world_from_camera[:3, :3] @ np.diag([1.0, -1.0, -1.0])).T  # OpenCV's y is down, z ahead.
        place, turn = camera.world_from_camera[:3, 3], rotation.ravel().tolist()
        pose = {"cam_R_w2c": turn, "cam_t_w2c": (-MM * rotation @ place).tolist()}
        lines: list[tuple[Json, Json]] = []
        for index, model in enumerate(models):
            seen, silhouette = found.object_id == model.object_id, _silhouette(camera, model)
            mask = _within(silhouette, seen.shape)
            at = (MM * rotation @ (model.center - place)).tolist()
            counts = _counts(silhouette, np.argwhere(seen), int((mask & (depth > 0)).sum()))
            lines.append(({"obj_id": model.object_id, "cam_R_m2c": turn, "cam_t_m2c": at}, counts))
            for kind, picture in (("mask", mask), ("mask_visib", seen)):
                yield f"{folder}/{kind}/{number:06d}_{index:06d}.png", mask_png(picture)
        cameras[str(number)] = {"cam_K": matrix.ravel().tolist(), "depth_scale": 1.0, "view": item.name, **pose}
        truths[str(number)], infos[str(number)] = map(list, zip(*lines, strict=True))
    for folder, contents in scenes.items():
        for name, content in zip(("camera", "gt", "gt_info"), contents, strict=True):
            yield f"{folder}/scene_{name}.json", dump_json(content)


HINT = "cat OUT/models/models_info.json"
BOP = Format(files=functools.partial(_bop, has_sensor=False), hint=HINT, takes_variants=True)
BOP_SENSOR = Format(files=functools.partial(_bop, has_sensor=True), hint=HINT, takes_variants=True)

Pixels = Int[np.ndarray, "pixel 2"]
"""Row and column."""


def _silhouette(camera: Camera, model: _Model) -> Pixels:
    """The pixels whose centre ray meets an object, also beyond the picture, up to its width and height."""
    size = np.array([camera.width, camera.height])
    pixels, depth = camera.project(model.mesh.vertices.astype(np.float64))
    low, high = -size, 2 * size
    if (depth > 0).all():
        low, high = np.floor(pixels.min(axis=0)), np.ceil(pixels.max(axis=0))
    left, top, right, bottom = np.clip([low, high], -size, 2 * size).astype(int).ravel().tolist()
    origin, directions = camera.rays((left, top, right, bottom))
    hits = model.peeler.trace(origin, directions.reshape(-1, 3), 1).shape[0] >= 0
    return np.add(np.argwhere(hits.reshape(directions.shape[:2])), (top, left))


def _within(pixels: Pixels, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """The mask of pixels in a picture of some height and width."""
    mask = np.zeros(shape, bool)
    mask[tuple(pixels[((pixels >= 0) & (pixels < shape)).all(axis=-1)].T)] = True
    return mask


def _counts(silhouette: Pixels, seen: Pixels, valid: int) -> dict[str, Json]:
    """An object's entry in scene_gt_info.json; boxes from the first pixel to the last, as the toolkit counts."""
    parts = (silhouette, seen) if len(seen) else ()
    boxes = [(*at.min(axis=0)[::-1], *np.ptp(at, axis=0)[::-1]) for at in parts]
    obj, visib = ([int(value) for value in box] for box in boxes or [[-1] * 4] * 2)
    return {
        "px_count_all": len(silhouette),
        "px_count_valid": valid,
        "px_count_visib": len(seen),
        "visib_fract": len(seen) / len(silhouette) if len(silhouette) else 0.0,
        "bbox_obj": [*obj],
        "bbox_visib": [*visib],
    }
