"""Cameras: where they stand, which rays they shoot, and their files."""

import math
from dataclasses import dataclass
from typing import cast

import numpy as np
from jaxtyping import Float, Float32, Int

from datagen.data.config import ANGLE_SPLITS, Split
from datagen.data.paths import view_name
from datagen.disk.errors import HyalineError
from datagen.disk.reading import parse_json
from datagen.disk.records import Json, shown
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
    """A pinhole camera with square pixels and its principal point in the picture's middle."""

    world_from_camera: Float[np.ndarray, "4 4"]
    """float64, metres, OpenGL convention: +x right, +y up, the camera looks along -z; world +z is up."""
    fov_x: float
    """Horizontal field of view in radians."""
    width: int
    height: int

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Focal lengths and principal point in pixels, as OpenCV writes them: x right, y down, from the upper left.

        The rays of `rays` are those of OpenCV's camera (y down, z ahead) after its y and z are turned round.
        """
        focal = 0.5 * self.width / math.tan(0.5 * self.fov_x)
        return np.array([[focal, 0, 0.5 * self.width], [0, focal, 0.5 * self.height], [0, 0, 1]])

    def rays(self) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "h w 3"]]:
        """Origin (metres) and unit directions of the rays through pixel centres, in the world, computed in float64."""
        focal = self.intrinsics[0, 0]
        x = (np.arange(self.width) + 0.5 - 0.5 * self.width) / focal
        y = (0.5 * self.height - np.arange(self.height) - 0.5) / focal
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
    """Horizontal field of view in radians."""
    width: int
    height: int

    def __len__(self) -> int:
        return len(self.world_from_camera)

    def __getitem__(self, view: int) -> Camera:
        return Camera(
            world_from_camera=self.world_from_camera[view], fov_x=self.fov_x, width=self.width, height=self.height
        )


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
    x = (column[:, None] + offsets[..., 1] - 0.5 * cameras.width) / focal
    y = (0.5 * cameras.height - row[:, None] - offsets[..., 0]) / focal
    d_camera = np.stack([x, y, -np.ones_like(x)], axis=-1)
    world_from_camera = cameras.world_from_camera[view]
    d_world = np.einsum("psc,pdc->psd", d_camera, world_from_camera[:, :3, :3])
    d_world /= np.linalg.norm(d_world, axis=-1, keepdims=True)
    origins = np.broadcast_to(world_from_camera[:, None, :3, 3], d_world.shape)
    return origins.reshape(-1, 3).astype(np.float32), d_world.reshape(-1, 3).astype(np.float32)


def transforms_bytes(cameras: Cameras, split: Split) -> bytes:
    """The cameras of a split as NeRF tools read them."""
    focal = 0.5 * cameras.width / math.tan(0.5 * cameras.fov_x)
    return dump_json(
        {
            "convention": CONVENTION,
            "camera_angle_x": cameras.fov_x,
            "fl_x": focal,
            "fl_y": focal,
            "cx": 0.5 * cameras.width,
            "cy": 0.5 * cameras.height,
            "w": cameras.width,
            "h": cameras.height,
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
        return Cameras(
            world_from_camera=np.array([frame["transform_matrix"] for frame in frames], np.float64).reshape(-1, 4, 4),
            fov_x=float(cast(float, content["camera_angle_x"])),
            width=int(cast(int, content["w"])),
            height=int(cast(int, content["h"])),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise HyalineError(
            f"{where}: holds no cameras ({type(error).__name__}: {error}); expected those that `datagen build` writes"
        ) from error
