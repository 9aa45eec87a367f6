"""COLMAP: a finished sparse model of the true cameras as text, with points of the true surfaces.

    images/NAME.png                              8-bit sRGB
    sparse/0/cameras.txt                         one PINHOLE camera
    sparse/0/images.txt                          world-to-camera quaternion (w, x, y, z) and translation, OpenCV axes
    sparse/0/points3D.txt                        points and their colours, without tracks
    train_list.txt, val_list.txt, test_list.txt  names of pictures by split, as nerfstudio reads them
    sparse/0/test.txt                            the same of the test splits, as Gaussian splatting can read it

A model has no splits: a tool that reads no lists takes every eighth picture for its test, and trains on the rest.

Pixel (0.5, 0.5) is the centre of the upper left pixel, in COLMAP as in the dataset.
"""

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from hyaline_export.formats import Format
from hyaline_export.source import ROLES, Source, rgb_png, tracked


def _colmap(source: Source) -> Iterator[tuple[str, bytes]]:
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "# POINTS2D[] as (X, Y, POINT3D_ID)"]
    for number, item in enumerate(tracked(source.views), start=1):
        yield f"images/{item.name}.png", rgb_png(item)
        pose = item.view.camera.world_from_camera @ np.diag([1.0, -1.0, -1.0, 1.0])  # COLMAP's y is down, and z ahead.
        rotation = pose[:3, :3].T
        # SciPy before 1.14 gives (x, y, z, w) alone.
        x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
        images.append(f"{number} {_words([w, x, y, z, *(-rotation @ pose[:3, 3]).tolist()])} 1 {item.name}.png")
        images.append("")  # Points have no tracks.
    cloud = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    rows = zip(source.points.position.tolist(), source.points.color.tolist(), strict=True)
    for number, (position, color) in enumerate(rows, start=1):
        cloud.append(" ".join([f"{number} {_words(position)}", *map(str, color), "0"]))
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


def _text(lines: list[str]) -> bytes:
    return "".join(f"{line}\n" for line in lines).encode()


def _words(values: list[float]) -> str:
    return " ".join(map(repr, values))
