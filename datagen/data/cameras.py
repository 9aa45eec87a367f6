"""Cameras: where they stand, which rays they shoot, and their files."""

import dataclasses
import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float, Float32, Int

from datagen.data.config import ANGLE_SPLITS, Split
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json, parse_json, shown
from datagen.disk.storage import dump_json

TRANSFORMS_FILES: dict[Split, str] = {
    "train": "transforms_train.json",
    "interpolating": "transforms_test.json",
    "extrapolating": "transforms_extrapolating.json",
    **{split: f"transforms_{split}.json" for split in ANGLE_SPLITS},
}
CONVENTION = "transform_matrix is world_from_camera, OpenGL: +x right, +y up, looks along -z; world +z up; m"


@dataclass(frozen=True, kw_only=True, eq=False)
class Camera:
    """A pinhole camera with square pixels."""

    world_from_camera: Float[np.ndarray, "4 4"]
    """float64, metres, OpenGL convention: +x right, +y up, the camera looks along -z; world +z is up."""
    fov_x: float
    """2 atan(width / 2 / focal length) in radians: the horizontal field of view where the principal point is in the
    picture's middle."""
    width: int
    height: int
    center: tuple[float, float] | None = None
    """Column and row of the principal point in pixels, from the picture's upper left corner; None: its middle."""

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row in pixels, from the picture's upper left corner."""
        return _principal_point(self)

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Focal lengths and principal point in pixels, as OpenCV writes them: x right, y down, from the upper left.

        The rays of `rays` are those of OpenCV's camera (y down, z ahead) after its y and z are turned round.
        """
        focal = 0.5 * self.width / math.tan(0.5 * self.fov_x)
        column, row = self.principal_point
        return np.array([[focal, 0, column], [0, focal, row], [0, 0, 1]])

    def project(
        self, p_world: Float[np.ndarray, "point 3"]
    ) -> tuple[Float[np.ndarray, "point 2"], Float[np.ndarray, " point"]]:
        """Column and row in pixels of where points are seen, and their depth along the axis in metres.

        Column and row mean nothing where the depth is not positive.
        """
        p_camera = (p_world - self.world_from_camera[:3, 3]) @ self.world_from_camera[:3, :3]
        depth = -p_camera[:, 2]
        image = np.stack([p_camera[:, 0], -p_camera[:, 1], depth], axis=1) @ self.intrinsics.T
        return image[:, :2] / np.where(depth > 0, depth, 1)[:, None], depth

    def rays(self) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "h w 3"]]:
        """Origin (metres) and unit directions of the rays through pixel centres, in the world, computed in float64."""
        focal = self.intrinsics[0, 0]
        column, row = self.principal_point
        x = (np.arange(self.width) + 0.5 - column) / focal
        y = (row - np.arange(self.height) - 0.5) / focal
        d_camera = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1)
        d_world = d_camera @ self.world_from_camera[:3, :3].T
        d_world /= np.linalg.norm(d_world, axis=-1, keepdims=True)
        return self.world_from_camera[:3, 3].astype(np.float32), d_world.astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Cameras:
    """The cameras of one split, all with square pixels and the same lens."""

    world_from_camera: Float[np.ndarray, "view 4 4"]
    """float64, OpenGL convention."""
    fov_x: float
    """Of each `Camera`."""
    width: int
    height: int
    center: tuple[float, float] | None = None
    """Of each `Camera`."""
    near: float | None = None
    """Metres along the ray: every surface that a picture of the dataset shows is farther; None: not known."""
    far: float | None = None
    """And nearer than this; the sky is beyond it."""

    def __len__(self) -> int:
        return len(self.world_from_camera)

    def __getitem__(self, view: int) -> Camera:
        return Camera(
            world_from_camera=self.world_from_camera[view],
            fov_x=self.fov_x,
            width=self.width,
            height=self.height,
            center=self.center,
        )

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row in pixels, from the picture's upper left corner."""
        return _principal_point(self)

    def times(self, scale: int) -> "Cameras":
        """The same with pictures so many times as wide and high."""
        center = None if self.center is None else (scale * self.center[0], scale * self.center[1])
        return dataclasses.replace(self, width=scale * self.width, height=scale * self.height, center=center)


def _principal_point(lens: Camera | Cameras) -> tuple[float, float]:
    return (0.5 * lens.width, 0.5 * lens.height) if lens.center is None else lens.center


def look_at(
    position: Float[np.ndarray, "3"] | tuple[float, float, float],
    target: Float[np.ndarray, "3"] | tuple[float, float, float],
) -> Float[np.ndarray, "4 4"]:
    """world_from_camera of a level camera (OpenGL convention, +z up), from its place and what it looks at, in metres.

    Raises:
        HyalineError: the camera looks straight up or down, or at its own place.
    """
    back = np.asarray(position, np.float64) - target
    right = np.cross([0.0, 0.0, 1.0], back)
    if np.linalg.norm(right) < 1e-6 * max(np.linalg.norm(back), 1e-6):
        raise HyalineError(f"camera at {position}: looks straight up or down at {target}; move the target aside")
    back, right = back / np.linalg.norm(back), right / np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return matrix


def check_camera(camera: Camera) -> None:
    """Refuses what somebody made by hand and no picture can be drawn through.

    Raises:
        HyalineError: no rotation and place, no lens, or no pixels.
    """
    matrix = np.asarray(camera.world_from_camera)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise HyalineError(f"camera: world_from_camera is of shape {matrix.shape}; expected (4, 4) finite numbers")
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        is_rotation = np.abs(rotation.T @ rotation - np.eye(3)).max() < 1e-4 and np.linalg.det(rotation) > 0
    if not is_rotation or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise HyalineError(
            f"camera: world_from_camera is {shown(matrix.tolist())}; expected a rotation and a place, without scale or "
            "mirroring, as look_at gives"
        )
    if not 0 < camera.fov_x < math.pi:
        raise HyalineError(f"camera: fov_x is {camera.fov_x}; expected radians, more than 0 and less than pi")
    if camera.width < 1 or camera.height < 1:
        raise HyalineError(f"camera: is {camera.width} x {camera.height} pixels; expected at least 1 x 1")
    if not np.isfinite(camera.principal_point).all():
        raise HyalineError(f"camera: center is {camera.center}; expected a column and a row in pixels, or None")


def subpixel_offsets(
    samples: int, place: float | Float[np.ndarray, "... sample 2"] = 0.5
) -> Float[np.ndarray, "... sample 2"]:
    """Where the rays of a pixel pass through it: (down, right) from its upper left corner, in [0, 1)^2 of its width.

    Each ray has a cell of its own in a regular grid that tiles the pixel, row by row.

    Args:
        samples: rays per pixel, a square number.
        place: where in its cell a ray is, in [0, 1); 0.5 is the cell's centre.

    Raises:
        HyalineError: no square number.
    """
    side = math.isqrt(max(samples, 0))
    if samples < 1 or side**2 != samples:
        raise HyalineError(f"rays: is {samples}; expected a square number of rays per pixel")
    cells = np.stack(np.divmod(np.arange(samples), side), axis=-1)
    return (cells + place) / side


def subpixel_rays(
    cameras: Cameras, pixel: Int[np.ndarray, " pixel"], offsets: Float[np.ndarray, "pixel sample 2"]
) -> tuple[Float32[np.ndarray, "ray 3"], Float32[np.ndarray, "ray 3"]]:
    """Origins and unit directions of rays through pixels of any views, pixel by pixel, computed in float64.

    Args:
        pixel: its place among all pixels of all views: row by row and view by view.
        offsets: as `subpixel_offsets` gives them.
    """
    view, place = np.divmod(pixel, cameras.height * cameras.width)
    row, column = np.divmod(place, cameras.width)
    focal = 0.5 * cameras.width / math.tan(0.5 * cameras.fov_x)
    center_x, center_y = cameras.principal_point
    x = (column[:, None] + offsets[..., 1] - center_x) / focal
    y = (center_y - row[:, None] - offsets[..., 0]) / focal
    d_camera = np.stack([x, y, -np.ones_like(x)], axis=-1)
    world_from_camera = cameras.world_from_camera[view]
    d_world = np.einsum("psc,pdc->psd", d_camera, world_from_camera[:, :3, :3])
    d_world /= np.linalg.norm(d_world, axis=-1, keepdims=True)
    origins = np.broadcast_to(world_from_camera[:, None, :3, 3], d_world.shape)
    return origins.reshape(-1, 3).astype(np.float32), d_world.reshape(-1, 3).astype(np.float32)


def transforms_bytes(cameras: Cameras, split: Split) -> bytes:
    """The cameras of a split as NeRF tools read them."""
    focal = 0.5 * cameras.width / math.tan(0.5 * cameras.fov_x)
    column, row = cameras.principal_point
    bounds: dict[str, Json] = {"near": cameras.near, "far": cameras.far}
    return dump_json(
        {
            "convention": CONVENTION,
            "camera_angle_x": cameras.fov_x,
            "fl_x": focal,
            "fl_y": focal,
            "cx": column,
            "cy": row,
            "w": cameras.width,
            "h": cameras.height,
            **{key: value for key, value in bounds.items() if value is not None},
            "frames": [
                {"file_path": f"images/{split}/{view_name(view)}", "transform_matrix": matrix.tolist()}
                for view, matrix in enumerate(cameras.world_from_camera)
            ],
        }
    )


def parse_transforms(data: bytes, *, where: str) -> Cameras:
    """The cameras in the bytes that `transforms_bytes` gives.

    Raises:
        HyalineError: it holds none.
    """
    content = parse_json(data, where=where)
    try:
        frames = cast(list[dict[str, Json]], content["frames"])
        width, height = int(cast(int, content["w"])), int(cast(int, content["h"]))
        center = float(cast(float, content["cx"])), float(cast(float, content["cy"]))
        return Cameras(
            world_from_camera=np.array([frame["transform_matrix"] for frame in frames], np.float64).reshape(-1, 4, 4),
            fov_x=float(cast(float, content["camera_angle_x"])),
            width=width,
            height=height,
            center=None if center == (0.5 * width, 0.5 * height) else center,
            near=_length(content.get("near")),
            far=_length(content.get("far")),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise HyalineError(
            f"{where}: holds no cameras ({type(error).__name__}: {error}); expected those that `datagen build` writes"
        ) from error


def _length(value: Json) -> float | None:
    return None if value is None else float(cast(float, value))
