"""COLMAP: a finished sparse model of the true cameras as text, with points of the true surfaces.

    images/NAME.png                              8-bit sRGB
    sparse/0/cameras.txt                         one PINHOLE camera
    sparse/0/images.txt                          world-to-camera quaternion (w, x, y, z) and translation, OpenCV axes
    sparse/0/points3D.txt                        points, their colours, and in which pictures they are seen
    train_list.txt, val_list.txt, test_list.txt  names of pictures by split, as nerfstudio reads them
    sparse/0/test.txt                            the same of the test splits, as Gaussian splatting can read it

A model has no splits: a tool that does not read the lists takes every eighth picture for its test, and trains on the
test splits.

Pixel (0.5, 0.5) is the centre of the upper left pixel, in COLMAP as in the dataset.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from datagen.data.cameras import Camera
from hyaline_export.formats import Format
from hyaline_export.source import ROLES, ExportView, PointCloud, Source, rgb_png, tracked

TOLERANCE = 0.005
"""A point is seen where its distance is that of the first surface at its pixel, but for this share."""


def _colmap(source: Source) -> Iterator[tuple[str, bytes]]:
    points = source.points
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    tracks: list[list[int]] = [[] for _ in points.position]
    for number, item in enumerate(tracked(source.pictures), start=1):
        yield f"images/{item.name}.png", rgb_png(item)
        rotation, translation = _camera_from_world(item.view.camera)
        # SciPy before 1.14 gives (x, y, z, w) alone.
        x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
        images.append(f"{number} {_words([w, x, y, z, *translation.tolist()])} 1 {item.name}.png")
        pixels, seen = _seen(item, points)
        images.append(
            " ".join(f"{x:.6f} {y:.6f} {point + 1}" for (x, y), point in zip(pixels.tolist(), seen, strict=True))
        )
        for place, point in enumerate(seen):
            tracks[point] += [number, place]
    cloud = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    rows = zip(points.position.tolist(), points.color.tolist(), tracks, strict=True)
    for number, (position, color, track) in enumerate(rows, start=1):
        cloud.append(" ".join([f"{number} {_words(position)}", *map(str, color), "0", *map(str, track)]))
    lens, matrix = source.lens, source.lens.intrinsics
    values = [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]
    camera = f"1 PINHOLE {lens.width} {lens.height} {_words(values)}"
    yield "sparse/0/cameras.txt", _text(["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", camera])
    yield "sparse/0/images.txt", _text(images)
    yield "sparse/0/points3D.txt", _text(cloud)
    names = {role: [f"{item.name}.png" for item in source.of_role(role)] for role in ROLES}
    yield "sparse/0/test.txt", _text(names["test"])
    for role in ROLES:
        yield f"{role}_list.txt", _text(names[role])


COLMAP = Format(files=_colmap, hint="colmap model_analyzer --path OUT/sparse/0")


def _camera_from_world(camera: Camera) -> tuple[Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Rotation and translation; COLMAP's camera has y down and looks along +z."""
    world_from_camera = camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    rotation = world_from_camera[:3, :3].T
    return rotation, -rotation @ world_from_camera[:3, 3]


def _seen(item: ExportView, points: PointCloud) -> tuple[Float[np.ndarray, "seen 2"], list[int]]:
    """Pixels at which a view shows points, and which these are."""
    camera = item.view.camera
    rotation, translation = _camera_from_world(camera)
    p_camera = points.position @ rotation.T + translation
    is_ahead = p_camera[:, 2] > 1e-6
    image = p_camera @ camera.intrinsics.T
    pixels = image[:, :2] / np.where(is_ahead, p_camera[:, 2], 1)[:, None]
    size = np.array([camera.width, camera.height])
    inside = is_ahead & (pixels >= 0).all(axis=-1) & (pixels < size).all(axis=-1)
    column, row = np.where(inside[:, None], np.floor(pixels), 0).astype(np.int64).T
    depth = item.quantities.depth_along_ray[row, column]
    distance = np.linalg.norm(p_camera, axis=-1)
    seen = np.flatnonzero(inside & (np.abs(distance - depth) < TOLERANCE * distance))
    return pixels[seen], seen.tolist()


def _text(lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode()


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))
