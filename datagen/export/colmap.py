"""COLMAP: a finished sparse model of the true cameras, in text and binary, with points of the true surfaces.

    images/NAME.png                              8-bit sRGB
    sparse/0/cameras.{txt,bin}                   one PINHOLE camera
    sparse/0/images.{txt,bin}                    world-to-camera quaternion (w, x, y, z) and translation, OpenCV axes
    sparse/0/points3D.{txt,bin}                  points, their colours, and in which pictures they are seen
    train_list.txt, val_list.txt, test_list.txt  names of pictures by split, as nerfbaselines and nerfstudio read them
    sparse/0/test.txt                            the same of the test splits, as Gaussian splatting can read it

A model has no splits: a tool that does not read the lists takes every eighth picture for its test, and trains on the
test splits.

Pixel (0.5, 0.5) is the centre of the upper left pixel, in COLMAP as in the dataset.

The format nerfbaselines is the same with nb-info.json: loader, scene, and the range of depths in metres. Its loader of
transforms.json rotates points, as those of nerfstudio's own COLMAP runs need it; that of COLMAP does not, and reads the
lists of names.
"""

import struct
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from datagen.disk.storage import dump_json
from datagen.export.files import rgb_png
from datagen.export.plan import Part, Plan, one_file
from datagen.export.source import ROLES, ExportView, PointCloud, Source

PINHOLE = 1
"""COLMAP's number of the camera model; its parameters are fx, fy, cx, cy."""

TOLERANCE = 0.005
"""A point is seen where its distance is that of the first surface at its pixel, but for this share."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Image:
    """A picture of the model; its id is 1 + its place."""

    name: str
    quaternion: Float[np.ndarray, "4"]
    translation: Float[np.ndarray, "3"]
    pixels: Float[np.ndarray, "seen 2"]
    """Where it shows points, in pixels."""
    points: Int[np.ndarray, " seen"]
    """Which points these are: their ids, from 1."""


def plan_colmap(source: Source) -> Plan:
    """The whole folder."""
    return Plan(parts=_parts(source), hint="colmap model_analyzer --path OUT/sparse/0")


def plan_nerfbaselines(source: Source) -> Plan:
    """The whole folder."""
    info = one_file("info", "nb-info.json", lambda: _nerfbaselines_info(source))
    return Plan(parts=(*_parts(source), info), hint="nerfbaselines train --method nerfacto --data OUT")


def _nerfbaselines_info(source: Source) -> bytes:
    return dump_json(
        {
            "loader": "colmap",
            "id": f"hyaline-{source.dataset.name}",
            "scene": source.dataset.name,
            "license": source.dataset.license,
            "evaluation_protocol": "default",
            "depth_range": [source.bounds.near, source.bounds.far],
        }
    )


def _parts(source: Source) -> tuple[Part, ...]:
    """Pictures, model and lists."""
    lists = Part(name="lists", files=tuple(_lists(source)), make=lambda: _lists(source))
    return (*(_view_part(item) for item in source.pictures), _model_part(source), lists)


def _model_part(source: Source) -> Part:
    """The sparse model alone; the names in it are those of the files in `images/`."""
    files = [f"sparse/0/{name}.{ending}" for name in ("cameras", "images", "points3D") for ending in ("txt", "bin")]

    def make() -> dict[str, bytes]:
        images = [_image(item, source.points) for item in source.pictures]
        contents = [*_cameras(source), *_images(images), *_points(source.points, images)]
        test = {"sparse/0/test.txt": _lists(source)["test_list.txt"]}
        return dict(zip(files, contents, strict=True)) | test

    return Part(name="model", files=(*files, "sparse/0/test.txt"), make=make)


def _view_part(item: ExportView) -> Part:
    file = f"images/{item.name}.png"
    return Part(name=item.name, files=(file,), make=lambda: {file: rgb_png(item)})


def _lists(source: Source) -> dict[str, bytes]:
    return {
        f"{role}_list.txt": "".join(f"{item.name}.png\n" for item in source.of_role(role)).encode() for role in ROLES
    }


def _image(item: ExportView, points: PointCloud) -> _Image:
    camera = item.view.camera
    # COLMAP's camera has y down and looks along +z.
    world_from_camera = camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
    rotation = world_from_camera[:3, :3].T
    translation = -rotation @ world_from_camera[:3, 3]
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
    return _Image(
        name=f"{item.name}.png",
        quaternion=_quaternion(rotation),
        translation=translation,
        pixels=pixels[seen],
        points=seen + 1,
    )


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    """The unit quaternion (w, x, y, z) of a rotation, w not negative.

    It is the eigenvector of the largest eigenvalue of a symmetric matrix: no case is near a division by 0.
    Source: Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix".
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = rotation.reshape(-1)
    matrix = np.array(
        [
            [xx - yy - zz, 0, 0, 0],
            [yx + xy, yy - xx - zz, 0, 0],
            [zx + xz, zy + yz, zz - xx - yy, 0],
            [zy - yz, xz - zx, yx - xy, xx + yy + zz],
        ]
    )
    _, vectors = np.linalg.eigh(matrix)  # It reads the lower triangle alone.
    quaternion = vectors[[3, 0, 1, 2], -1]
    return -quaternion if quaternion[0] < 0 else quaternion


def _cameras(source: Source) -> tuple[bytes, bytes]:
    camera = source.pictures[0].view.camera
    matrix = camera.intrinsics
    values = [float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])]
    text = f"# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 PINHOLE {camera.width} {camera.height} {_words(values)}\n"
    return text.encode(), struct.pack("<QIiQQ4d", 1, 1, PINHOLE, camera.width, camera.height, *values)


def _images(images: list[_Image]) -> tuple[bytes, bytes]:
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    data = [struct.pack("<Q", len(images))]
    layout = np.dtype([("pixel", "<f8", 2), ("point", "<u8")])
    for place, image in enumerate(images):
        pose = [*image.quaternion.tolist(), *image.translation.tolist()]
        lines.append(f"{place + 1} {_words(pose)} 1 {image.name}")
        seen = zip(image.pixels.tolist(), image.points.tolist(), strict=True)
        lines.append(" ".join(f"{x:.6f} {y:.6f} {point}" for (x, y), point in seen))
        rows = np.empty(len(image.points), layout)
        rows["pixel"], rows["point"] = image.pixels, image.points
        head = struct.pack("<I7dI", place + 1, *pose, 1) + image.name.encode() + b"\0"
        data += [head, struct.pack("<Q", len(rows)), rows.tobytes()]
    return ("\n".join(lines) + "\n").encode(), b"".join(data)


def _points(points: PointCloud, images: list[_Image]) -> tuple[bytes, bytes]:
    point = np.concatenate([image.points for image in images])
    image_id = np.concatenate([np.full(len(image.points), place + 1) for place, image in enumerate(images)])
    place_in_image = np.concatenate([np.arange(len(image.points)) for image in images])
    order = np.argsort(point, kind="stable")
    tracks = np.stack([image_id, place_in_image], axis=-1)[order].astype("<u4")
    ends = np.searchsorted(point[order], np.arange(1, len(points.position) + 1), side="right")
    starts = np.concatenate([[0], ends[:-1]])
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    data = [struct.pack("<Q", len(points.position))]
    for index, (position, color) in enumerate(zip(points.position.tolist(), points.color.tolist(), strict=True)):
        track = tracks[starts[index] : ends[index]]
        lines.append(" ".join([f"{index + 1} {_words(position)}", *map(str, color), "0", *map(str, track.ravel())]))
        data.append(struct.pack("<Q3d3BdQ", index + 1, *position, *color, 0.0, len(track)) + track.tobytes())
    return ("\n".join(lines) + "\n").encode(), b"".join(data)


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))
