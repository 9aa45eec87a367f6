"""Exposure, white balance and vignetting of photographs, from opaque points that many of them show.

The logarithm of a picture's linear colour at a point is the point's own, plus a gain of the picture and channel, plus a
falloff towards the corners that all pictures share (the first term of Goldman 2010, "Vignette and Exposure Calibration
and Compensation"). Medians over pictures and points in turn find them (Tukey's median polish): shadows are outliers.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from datagen.data.cameras import Camera, Cameras
from datagen.data.images import linear_from_srgb, srgb_from_linear, to_8bit
from hyaline_photos.capture.stereo import DepthMaps

POINTS = 6000
DARKEST, BRIGHTEST = 0.02, 0.9
"""Linear colours outside of these say little: they are noise, or clipped."""
HIDDEN = 0.03
"""Relative difference from a view's depth at which the view shows something else."""
LEAST_VIEWS, LEAST_POINTS = 4, 100
"""Training pictures that must show a point, and points that a picture must show; otherwise it keeps its exposure."""
OUTLIER = 0.15
"""Difference of logarithms above which a colour does not count for the falloff."""
ROUNDS = 40
EQUAL = 0.05
"""Spread of the gains, and darkening of the corners, below which pictures are left as they are. Gloss and wrong depths
alone spread the gains of equally exposed pictures by 3 %."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Exposures:
    """Gains of pictures, and the falloff that all of them share."""

    gains: Float[np.ndarray, "view 3"]
    """Logarithms by colour channel; over training pictures, their mean is 0."""
    falloff: float
    """Of the logarithm, from the middle to the corners."""

    def in_words(self) -> str:
        if not (self.gains.any() or self.falloff):
            return f"exposure: pictures differ by less than {EQUAL:.1%}; they were left as they are"
        brightness, balance = self.gains.mean(axis=1), self.gains - self.gains.mean(axis=1, keepdims=True)
        low, high = np.exp([brightness.min(), brightness.max()])
        return (
            f"exposure: pictures were {low:.2f} to {high:.2f} times as bright as in the mean (spread "
            f"{_spread(brightness):.1%}), channels differed by {balance.std():.1%}, corners were "
            f"{1 - np.exp(self.falloff):.1%} darker; corrected"
        )

    def corrected(self, picture: UInt8[np.ndarray, "h w 3"], view: int) -> UInt8[np.ndarray, "h w 3"]:
        """A picture as if it had the mean exposure, and no falloff."""
        height, width = picture.shape[:2]
        log = self.gains[view] + self.falloff * _radii(width, height)[..., None]
        return to_8bit(srgb_from_linear(linear_from_srgb(picture / np.float32(255)) * np.exp(-log).astype(np.float32)))


def find_exposures(
    pictures: Sequence[UInt8[np.ndarray, "h w 3"]],
    cameras: Cameras,
    maps: DepthMaps,
    points: Float[np.ndarray, "point 3"],
) -> Exposures:
    """Finds the training pictures' gains together, then those of the others from the points' colours.

    Args:
        pictures: of all splits, those with a depth map first.
        points: that the depth maps show.
    """
    points = points[np.random.default_rng(0).permutation(len(points))[:POINTS]]
    count, radii = len(maps.depth), _radii(cameras.width, cameras.height)
    logs = np.full((len(pictures), len(points), 3), np.nan)
    squares = np.zeros(logs.shape[:2])
    seen = []  # Which points each depth map shows.
    for view, shown in enumerate(maps.depth):
        row, column, depth, is_in = _pixels(points, maps.cameras[view])
        seen.append(is_in & (np.abs(shown[row, column] - depth) < HIDDEN * depth))
    places = cameras.world_from_camera[:, :3, 3]
    for view, picture in enumerate(pictures):
        # A picture without a depth map shows what the nearest one with a map does.
        nearest = int(np.linalg.norm(places[:count] - places[view], axis=1).argmin()) if view >= count else view
        row, column, _, is_in = _pixels(points, cameras[view])
        linear = linear_from_srgb(picture[row, column] / 255.0)
        is_good = is_in & seen[nearest] & (linear > DARKEST).all(axis=1) & (linear < BRIGHTEST).all(axis=1)
        logs[view, is_good] = np.log(linear[is_good])
        squares[view] = radii[row, column]
    is_kept = np.isfinite(logs[:count, :, 0]).sum(axis=0) >= LEAST_VIEWS
    logs, squares = logs[:, is_kept], squares[:, is_kept, None]
    is_shown = np.isfinite(logs[..., 0]).sum(axis=1) >= LEAST_POINTS
    gains, falloff, train = np.zeros((len(pictures), 3)), 0.0, is_shown & (np.arange(len(pictures)) < count)
    if not train.any():
        return Exposures(gains=gains, falloff=0.0)
    is_known = np.isfinite(logs[train][..., 0]).any(axis=0)
    logs, squares = logs[:, is_known], squares[:, is_known]
    for _ in range(ROUNDS):
        own = np.nanmedian((logs - gains[:, None] - falloff * squares)[train], axis=0)
        left = logs - own - falloff * squares
        gains[is_shown] = np.nanmedian(left[is_shown], axis=1)
        gains[is_shown] -= gains[train].mean(axis=0)
        left = left[train] - gains[train, None]
        bend = np.broadcast_to(squares[train], left.shape)[inside := np.abs(left) < OUTLIER]
        falloff += float(np.cov(bend, left[inside])[0, 1] / bend.var())
    gains *= _spread(gains[train]) >= EQUAL
    return Exposures(gains=gains, falloff=falloff * (abs(falloff) >= EQUAL))


def _spread(gains: Float[np.ndarray, "*gain"]) -> float:
    """What a standard deviation would be without outliers: a picture with wrong depths is no reason to change all."""
    return 1.4826 * float(np.median(np.abs(gains)))


def _radii(width: int, height: int) -> Float[np.ndarray, "h w"]:
    """Squared distance of pixels from the middle of the picture; 1 in the corners."""
    rows, columns = np.indices((height, width)) + 0.5
    return ((rows - height / 2) ** 2 + (columns - width / 2) ** 2) / ((height**2 + width**2) / 4)


def _pixels(
    points: Float[np.ndarray, "point 3"], camera: Camera
) -> tuple[np.ndarray, np.ndarray, Float[np.ndarray, " point"], Bool[np.ndarray, " point"]]:
    """Rows and columns where a camera sees points, their depths, and whether they are in its picture."""
    pixels, depth = camera.project(points)
    column, row = np.floor(np.clip(pixels, -1, 1e6)).astype(int).T
    is_in = (depth > 0) & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    return np.where(is_in, row, 0), np.where(is_in, column, 0), depth, is_in
