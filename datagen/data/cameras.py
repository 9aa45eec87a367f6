"""Cameras: their lens and place, and the rays through their pixels.

The convention, here and in every file of a dataset: metres, world +z up. `world_from_camera` is OpenGL's: +x right, +y
up, the camera looks along -z. Pixels are square; pixel (column i, row j) has its centre at (i + 0.5, j + 0.5), row 0 on
top. A lens is given by its horizontal angle in radians, its principal point by pixels from the upper left corner.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

from datagen.data.config import MAX_SIDE, Resolution, Split
from datagen.data.meshes import Mesh, face_corners
from datagen.disk.errors import HyalineError, shown
from datagen.disk.records import checked

MAX_FOV_DEG = 170.0
MAX_SKEW = 1e-3
"""By how much a rotation's axes may miss being perpendicular and of unit length."""
MAX_SHIFT = 4
"""Largest distance of a principal point from the picture's middle, in pictures; a larger one is probably a typo."""
TOLERANCE = 1e-3
"""Share by which two focal lengths may differ, and share of the picture by which two principal points may."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """A pinhole lens with square pixels, and the size of its pictures.

    A square picture whose principal point is its middle says nothing but the angle: such a lens fits any resolution.
    """

    fov_x: float
    """2 atan(width / 2 / focal length) in radians: the horizontal field of view if the principal point is central."""
    width: int
    height: int
    center: tuple[float, float] | None = None
    """Column and row of the principal point in pixels; None: the picture's middle."""

    @property
    def size(self) -> Resolution:
        return Resolution(width=self.width, height=self.height)

    @property
    def focal(self) -> float:
        """Focal length in pixels."""
        return 0.5 * self.width / math.tan(0.5 * self.fov_x)

    @property
    def principal_point(self) -> tuple[float, float]:
        """Column and row in pixels, from the picture's upper left corner."""
        return (0.5 * self.width, 0.5 * self.height) if self.center is None else self.center

    @property
    def intrinsics(self) -> Float[np.ndarray, "3 3"]:
        """Focal lengths and principal point in pixels, as OpenCV writes them: x right, y down, from the upper left.

        The rays of `rays` are those of OpenCV's camera (y down, z ahead) after its y and z are turned round.
        """
        column, row = self.principal_point
        return np.array([[self.focal, 0, column], [0, self.focal, row], [0, 0, 1]])

    @property
    def fits_any_shape(self) -> bool:
        return self.center is None and self.width == self.height

    def shaped(self, pixels: int) -> Resolution:
        """The resolution of pictures of this lens's shape with about this number of pixels."""
        width = max(1, round(self.width * math.sqrt(pixels / (self.width * self.height))))
        return Resolution(width=width, height=max(1, round(self.height * width / self.width)))

    def fitted(self, size: Resolution) -> Self:
        """The same lens for pictures of another resolution; an error unless they have its shape."""
        scale = size.width / self.width
        if not self.fits_any_shape and abs(size.height - scale * self.height) > 0.5 + 1e-9:
            raise HyalineError(
                f"resolution: is {size}, and the cameras' lens is for {self.width} x {self.height} pixels; expected "
                f"that shape, such as {self.shaped(size.pixels)}"
            )
        center = None if self.center is None else (self.center[0] * scale, self.center[1] * scale)
        if center == (size.width / 2, size.height / 2):
            center = None
        return dataclasses.replace(self, width=size.width, height=size.height, center=center)

    def camera(self, world_from_camera: Float[np.ndarray, "4 4"]) -> "Camera":
        """The camera with this lens at a place."""
        return Camera(world_from_camera=world_from_camera, **self._lens())

    def cameras(self, world_from_camera: Float[np.ndarray, "view 4 4"]) -> "Cameras":
        """The cameras with this lens at these places."""
        return Cameras(world_from_camera=world_from_camera, **self._lens())

    def _lens(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(Lens)}

    def is_like(self, other: "Lens") -> bool:
        """True for a lens that shows the same, to a thousandth of its angle and of the picture's width."""
        apart = np.abs(np.subtract(self.principal_point, other.principal_point)).max()
        return (
            (self.width, self.height) == (other.width, other.height)
            and abs(self.fov_x / other.fov_x - 1) <= TOLERANCE
            and bool(apart <= TOLERANCE * self.width)
        )


@checked
@dataclass(frozen=True, kw_only=True, eq=False)
class Camera(Lens):
    """A lens and where it is."""

    world_from_camera: Float[np.ndarray, "4 4"]
    """float64, metres, OpenGL convention: +x right, +y up, the camera looks along -z; world +z is up."""

    def __post_init__(self) -> None:
        check_pose(self.world_from_camera)
        check_lens(self)
        if max(self.width, self.height) > MAX_SIDE:
            raise HyalineError(f"camera: is {self.width} x {self.height} pixels; expected at most {MAX_SIDE} a side")

    @property
    def alone(self) -> "Cameras":
        """A set of cameras that contains only this one."""
        return self.cameras(self.world_from_camera[None].astype(np.float64))

    @checked
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

    def rays(
        self, window: tuple[int, int, int, int] | None = None
    ) -> tuple[Float32[np.ndarray, "3"], Float32[np.ndarray, "h w 3"]]:
        """Origin (metres) and unit directions of the rays through pixel centres, in the world, computed in float64.

        Args:
            window: left, top, right and bottom of these pixels, which may lie beyond the picture. Default: all of it.
        """
        left, top, right, bottom = window or (0, 0, self.width, self.height)
        column, row = self.principal_point
        x = (np.arange(left, right) + 0.5 - column) / self.focal
        y = (row - np.arange(top, bottom) - 0.5) / self.focal
        d_camera = np.stack(np.broadcast_arrays(x[None, :], y[:, None], -1.0), axis=-1)
        d_world = d_camera @ self.world_from_camera[:3, :3].T
        d_world /= np.linalg.norm(d_world, axis=-1, keepdims=True)
        return self.world_from_camera[:3, 3].astype(np.float32), d_world.astype(np.float32)


@dataclass(frozen=True, kw_only=True, eq=False)
class Cameras(Lens):
    """The cameras of one split, which all have the same lens."""

    world_from_camera: Float[np.ndarray, "view 4 4"]
    """float64, OpenGL convention."""
    near: float | None = None
    """Metres along the ray: every surface that a picture of the dataset shows is farther; None: not known."""
    far: float | None = None
    """And nearer than this; the sky is beyond it."""

    def __len__(self) -> int:
        return len(self.world_from_camera)

    def __getitem__(self, view: int) -> Camera:
        return self.camera(self.world_from_camera[view].copy())


@checked
def look_at(
    position: Float[np.ndarray, "3"] | tuple[float, float, float],
    target: Float[np.ndarray, "3"] | tuple[float, float, float],
) -> Float[np.ndarray, "4 4"]:
    """world_from_camera of a level camera (OpenGL convention, +z up), from its place and what it looks at, in metres.

    A camera cannot look straight up or down, nor at its own place.
    """
    back = np.asarray(position, np.float64) - target
    if not np.isfinite(back).all():
        raise HyalineError(f"camera at {position} that looks at {target}: expected finite numbers")
    right = np.cross([0.0, 0.0, 1.0], back)
    distance, across = math.hypot(*back), math.hypot(*right)  # BLAS would differ between processors in the last bit.
    if across < 1e-6 * max(distance, 1e-6):
        raise HyalineError(f"camera at {position}: looks straight up or down at {target}; move the target aside")
    back, right = back / distance, right / across
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return matrix


def direction_of(
    elevation: Float[np.ndarray, "*place"], azimuth: Float[np.ndarray, "*place"]
) -> Float[np.ndarray, "*place 3"]:
    """The unit vector at these angles in radians, above the horizon and from +x towards +y."""
    across = np.cos(elevation)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)], axis=-1)


def check_pose(world_from_camera: np.ndarray) -> None:
    """Raises a HyalineError for anything but a rotation and a place."""
    matrix = np.asarray(world_from_camera)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise HyalineError(f"camera: world_from_camera is of shape {matrix.shape}; expected (4, 4) finite numbers")
    rotation = matrix[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        is_rotation = np.abs(rotation.T @ rotation - np.eye(3)).max() < MAX_SKEW and np.linalg.det(rotation) > 0
    if not is_rotation or not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise HyalineError(
            f"camera: world_from_camera is {shown(matrix.tolist())}; expected a rotation and a place, without scale or "
            "mirroring, as look_at gives"
        )


def check_lens(lens: Lens) -> None:
    """Raises a HyalineError for a lens that no camera has."""
    if lens.width < 1 or lens.height < 1:
        raise HyalineError(f"camera: is {lens.width} x {lens.height} pixels; expected at least 1 x 1")
    if not 0 < math.degrees(lens.fov_x) < MAX_FOV_DEG:
        raise HyalineError(
            f"camera: fov_x is {lens.fov_x:g}; expected radians, more than 0 and less than {MAX_FOV_DEG:g} degrees"
        )
    if not np.isfinite(lens.principal_point).all():
        raise HyalineError(f"camera: center is {lens.center}; expected a column and a row in pixels, or None")
    away = np.subtract(lens.principal_point, (lens.width / 2, lens.height / 2)) / (lens.width, lens.height)
    if np.abs(away).max() > MAX_SHIFT:
        column, row = lens.principal_point
        raise HyalineError(
            f"camera: its principal point is {column:g}, {row:g}; expected pixels, at most {MAX_SHIFT} pictures of "
            f"{lens.width} x {lens.height} away from the middle"
        )


def subpixel_offsets(
    samples: int, place: float | Float[np.ndarray, "... sample 2"] = 0.5
) -> Float[np.ndarray, "... sample 2"]:
    """Where the rays of a pixel pass through it: (down, right) from its upper left corner, in [0, 1)^2 of its width.

    Each ray has a cell of its own in a regular grid that tiles the pixel, row by row.

    Args:
        samples: rays per pixel, a square number.
        place: where in its cell a ray is, in [0, 1); 0.5 is the cell's centre.
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
    center_x, center_y = cameras.principal_point
    x = (column[:, None] + offsets[..., 1] - center_x) / cameras.focal
    y = (center_y - row[:, None] - offsets[..., 0]) / cameras.focal
    d_camera = np.stack([x, y, -np.ones_like(x)], axis=-1)
    world_from_camera = cameras.world_from_camera[view]
    d_world = np.einsum("psc,pdc->psd", d_camera, world_from_camera[:, :3, :3])
    d_world /= np.linalg.norm(d_world, axis=-1, keepdims=True)
    origins = np.broadcast_to(world_from_camera[:, None, :3, 3], d_world.shape)
    return origins.reshape(-1, 3).astype(np.float32), d_world.reshape(-1, 3).astype(np.float32)


# Depth range: how near and how far the surfaces in pictures are


MARGIN = 0.01
"""Near is this share nearer than the nearest surface, and far this share farther than the farthest."""

NO_SURFACE = (0.1, 10.0)
"""Near and far in metres if no picture shows a surface."""

LEAST_NEAR = 1e-6
"""Metres. A surface may pass through a camera."""


def with_depth_range(cameras: Mapping[Split, Cameras], meshes: Sequence[Mesh]) -> dict[Split, Cameras]:
    """The cameras with one near and one far for all of them, in metres along the ray.

    Every surface inside any picture lies between them, hidden surfaces included, with a margin; triangles that a
    picture shows in part count as a whole. Rounded outwards to five digits, against the last bits of sums.
    """
    corners = _corners(meshes)
    found = [_depths(poses, matrix, corners) for poses in cameras.values() for matrix in poses.world_from_camera]
    seen = np.array([depths for depths in found if depths is not None]).reshape(-1, 2)
    near, far = NO_SURFACE
    if len(seen):
        near = max(_rounded((1 - MARGIN) * seen[:, 0].min(), up=False), LEAST_NEAR)
        far = _rounded((1 + MARGIN) * seen[:, 1].max(), up=True)
    return {split: dataclasses.replace(poses, near=near, far=far) for split, poses in cameras.items()}


def seeing(cameras: Cameras, mesh: Mesh) -> Iterator[bool]:
    """For each camera, whether its picture may show a part of a mesh, hidden or not."""
    corners = _corners([mesh])
    return (_depths(cameras, matrix, corners) is not None for matrix in cameras.world_from_camera)


def _corners(meshes: Sequence[Mesh]) -> Float64[np.ndarray, "face 3 3"]:
    return np.concatenate([np.zeros((0, 3, 3)), *map(face_corners, meshes)])


def _depths(
    lens: Lens, world_from_camera: Float[np.ndarray, "4 4"], corners: Float64[np.ndarray, "face 3 3"]
) -> tuple[float, float] | None:
    """Distances of the nearest and the farthest point of the triangles that are not beside a picture, nor behind it."""
    from trimesh.triangles import closest_point

    from_camera = corners - world_from_camera[:3, 3]
    (focal, _, column), (_, _, row), _ = lens.intrinsics
    # Normals, inwards, of the planes through the camera that bound what the picture shows, in the camera's axes.
    planes = np.array(
        [
            (focal, 0, -column),
            (-focal, 0, column - lens.width),
            (0, -focal, -row),
            (0, focal, row - lens.height),
            (0, 0, -1),
        ]
    )
    is_inside = from_camera @ (world_from_camera[:3, :3] @ planes.T) >= 0
    shown = from_camera[np.all(is_inside.any(axis=1), axis=1)]
    if not len(shown):
        return None
    distance = np.linalg.norm(shown, axis=2)
    longest = np.linalg.norm(shown - np.roll(shown, 1, axis=1), axis=2).max(axis=1)
    # A triangle whose corners are all farther than the nearest one by more than an edge holds no nearer point.
    close = shown[distance.min(axis=1) - longest <= distance.min()]
    nearest = np.linalg.norm(closest_point(close, np.zeros((len(close), 3))), axis=1)
    return float(min(nearest.min(), distance.min())), float(distance.max())


def _rounded(value: float, *, up: bool) -> float:
    """To five digits, away from the surfaces."""
    unit = 10.0 ** (np.floor(np.log10(max(value, LEAST_NEAR))) - 4)
    steps = np.ceil(value / unit) if up else np.floor(value / unit)
    return float(f"{steps * unit:.5g}")
