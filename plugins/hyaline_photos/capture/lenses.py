"""Lenses with distortion, and pictures resampled for the dataset's one pinhole lens.

Points are on the plane one unit ahead: x right, y down. Pixels are columns and rows from the upper left corner.

Source: the camera models of COLMAP (src/colmap/sensor/models.h) and OpenCV; up to six radial and two tangential terms.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from datagen.data.cameras import TOLERANCE, Lens, check_lens
from datagen.data.config import Resolution
from datagen.data.images import linear_from_srgb, srgb_from_linear, to_8bit
from datagen.data.transforms import Frame, Transforms
from datagen.disk.errors import HyalineError
from hyaline_import.cameras import ColmapCamera

NARROWEST = 0.02
"""Tangent of half the narrowest angle that all pictures may share."""


@dataclass(frozen=True, kw_only=True)
class TakenLens:
    """The lens of a camera: focal lengths, principal point, radial and tangential distortion."""

    width: int
    height: int
    focal: tuple[float, float]
    center: tuple[float, float]
    radial: tuple[float, ...] = ()
    """k1, k2, k3 in the numerator, then k4, k5, k6 in the denominator."""
    tangential: tuple[float, float] = (0.0, 0.0)

    @property
    def is_pinhole(self) -> bool:
        """True without distortion and with square pixels."""
        bent = np.abs([*self.radial, *self.tangential]).max(initial=0) > 1e-9
        return not bent and abs(self.focal[1] / self.focal[0] - 1) <= TOLERANCE

    @property
    def pinhole(self) -> Lens:
        """The lens without its distortion."""
        center = None if self.center == (self.width / 2, self.height / 2) else self.center
        angle = 2 * math.atan(0.5 * self.width / self.focal[0])
        return Lens(fov_x=angle, width=self.width, height=self.height, center=center)

    def pixels(self, points: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
        """Where points are seen."""
        x, y = points[..., 0], points[..., 1]
        square = x * x + y * y
        k = (*self.radial, *(0.0,) * (6 - len(self.radial)))
        factor = 1 + square * (k[0] + square * (k[1] + square * k[2]))
        factor = factor / (1 + square * (k[3] + square * (k[4] + square * k[5])))
        p1, p2 = self.tangential
        across = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x)
        down = y * factor + 2 * p2 * x * y + p1 * (square + 2 * y * y)
        return np.stack([self.focal[0] * across + self.center[0], self.focal[1] * down + self.center[1]], axis=-1)


def lens_of_colmap(row: ColmapCamera, size: tuple[int, int], *, where: str) -> TakenLens:
    """The lens of a camera of COLMAP, for its pictures as large as they are now."""
    focals, values = row.focals, row.values
    bends = values[focals + 2 :]
    radial, tangential = bends, (0.0, 0.0)
    if row.model in ("OPENCV", "FULL_OPENCV"):
        radial, tangential = (*bends[:2], *bends[4:]), (bends[2], bends[3])
    lens = TakenLens(
        width=row.width,
        height=row.height,
        focal=(values[0], values[focals - 1]),
        center=(values[focals], values[focals + 1]),
        radial=radial,
        tangential=tangential,
    )
    return _checked(lens, size, where=where)


def lens_of_frame(file: Transforms, frame: Frame, size: tuple[int, int]) -> TakenLens:
    """The lens of a frame of a transforms file, for its picture as large as it is now."""

    def number(key: str, default: float = 0.0) -> float:
        return file.number(key, default, frame=frame)

    # nerfstudio writes k4 for fisheyes alone.
    if other := file.other_model(frame) or "k4" * (abs(number("k4")) > 1e-9):
        raise HyalineError(
            f"{frame.where}: its camera is not a pinhole camera ({other}); expected PINHOLE or OPENCV: undistort the "
            "pictures first (`colmap image_undistorter`)"
        )
    width, height = number("w", size[0]), number("h", size[1])
    focal = number("fl_x") or 0.5 * width / math.tan(0.5 * (number("camera_angle_x") or math.pi))
    if not (1e-6 < focal and 1 <= width <= 1e6 and 1 <= height <= 1e6):
        raise HyalineError(f"{frame.where}: has no lens; expected camera_angle_x in radians, or fl_x and w in pixels")
    lens = TakenLens(
        width=round(width),
        height=round(height),
        focal=(focal, number("fl_y") or focal),
        center=(number("cx", width / 2), number("cy", height / 2)),
        radial=tuple(number(f"k{place}") for place in (1, 2, 3)),
        tangential=(number("p1"), number("p2")),
    )
    return _checked(lens, size, where=frame.where)


def _checked(lens: TakenLens, size: tuple[int, int], *, where: str) -> TakenLens:
    """The lens, scaled to its picture."""
    across, down = size[0] / lens.width, size[1] / lens.height
    if abs(down / across - 1) > 0.02:
        raise HyalineError(
            f"{where}: its camera is for pictures of {lens.width} x {lens.height} pixels, and the picture has "
            f"{size[0]} x {size[1]}; expected that shape"
        )
    focal, center = ((pair[0] * across, pair[1] * down) for pair in (lens.focal, lens.center))
    lens = replace(lens, width=size[0], height=size[1], focal=focal, center=center)
    try:
        check_lens(lens.pinhole)
    except HyalineError as error:
        raise HyalineError(f"{where}: {error}") from None
    return lens


# The lens of the dataset


def shared_lens(lenses: Sequence[TakenLens], longest: int) -> tuple[Lens, list[str]]:
    """The lens that the dataset's pictures are to have, and remarks: the pictures' own, or what all of them show."""
    first = lenses[0]
    times = min(1.0, longest / max(first.width, first.height))
    size = Resolution(width=max(1, round(times * first.width)), height=max(1, round(times * first.height)))
    if all(lens.is_pinhole and lens.pinhole.is_like(first.pinhole) for lens in lenses):
        return first.pinhole.fitted(size), []
    narrow, wide = 0.0, max(0.5 * lens.width / lens.focal[0] for lens in lenses) * 1.5
    for _ in range(40):
        middle = (narrow + wide) / 2
        narrow, wide = (middle, wide) if _is_seen_by_all(middle, size, lenses) else (narrow, middle)
    if narrow < NARROWEST:
        raise HyalineError("pictures: their lenses share no part of the view; expected one camera, or similar ones")
    lens = Lens(fov_x=2 * math.atan(narrow), width=size.width, height=size.height)
    remark = "lenses: differ or are distorted; all pictures are drawn as a pinhole would see what they share"
    return lens, [f"{remark}, {math.degrees(lens.fov_x):.1f} degrees wide"]


def _is_seen_by_all(tangent: float, size: Resolution, lenses: Sequence[TakenLens]) -> bool:
    along = np.linspace(-1, 1, 33)
    edge = np.concatenate([[(t, s), (s, t)] for t in along for s in (-1.0, 1.0)])
    points = edge * (tangent, tangent * size.height / size.width)
    outwards = points * np.linspace(0.1, 1, 10)[:, None, None]
    for lens in dict.fromkeys(lenses):
        # Strong distortion folds the plane back into the picture, far from where any picture told it.
        steps = lens.pixels(1.001 * outwards) - lens.pixels(outwards)
        is_folded = ((steps * points).sum(axis=-1) <= 0).any()
        seen = lens.pixels(points)
        if is_folded or not ((seen >= -1e-6) & (seen <= np.array([lens.width, lens.height]) + 1e-6)).all():
            return False
    return True


# Pictures


def redrawn(picture: UInt8[np.ndarray, "h w 3"], taken: TakenLens, lens: Lens) -> UInt8[np.ndarray, "height width 3"]:
    """A picture as another lens would have taken it from the same place; light is averaged over its pixels."""
    linear = linear_from_srgb(picture.astype(np.float32) / 255).astype(np.float32)
    return to_8bit(srgb_from_linear(_looked_up(linear, taken, lens)))


def redrawn_mask(mask: Bool[np.ndarray, "h w"], taken: TakenLens, lens: Lens) -> Bool[np.ndarray, "height width"]:
    """Resamples a mask for another lens; a pixel is set if the mask covers more than half of it.

    Of the pixels that are covered to exactly one half, as many as a quarter of those at edges when a mask is halved,
    every other one is set: all of them would make the mask a quarter of a pixel wider on every side.
    """
    covered = _looked_up(mask.astype(np.float32)[..., None], taken, lens)[..., 0]
    is_odd = np.indices(covered.shape).sum(axis=0) % 2 == 1
    return np.where(np.isclose(covered, 0.5), is_odd, covered > 0.5)


def _looked_up(
    values: Float32[np.ndarray, "h w c"], taken: TakenLens, lens: Lens
) -> Float[np.ndarray, "height width c"]:
    from scipy.ndimage import map_coordinates

    per_side = max(1, math.ceil(max(taken.focal) / lens.focal - 0.01))
    column, row = lens.principal_point
    x = ((np.arange(lens.width * per_side) + 0.5) / per_side - column) / lens.focal
    out = np.empty((lens.height, lens.width, values.shape[2]))
    for line in range(lens.height):  # One by one, to save memory.
        y = (line + (np.arange(per_side) + 0.5) / per_side - row) / lens.focal
        points = np.stack(np.meshgrid(x, y), axis=-1)
        # Rounded to a thousandth of a pixel: where both lenses agree, pixels are taken over as they are.
        at = np.moveaxis(np.round(taken.pixels(points)[..., ::-1] - 0.5, 3), -1, 0)
        for channel in range(values.shape[2]):
            found = map_coordinates(values[..., channel], at, order=1, mode="nearest")
            out[line, :, channel] = found.reshape(per_side, lens.width, per_side).mean(axis=(0, 2))
    return out
