"""Whether a room explains training pictures: each is predicted beside the glass from others, across its surfaces."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Float32, UInt8

from datagen.data.cameras import Cameras
from datagen.data.meshes import Mesh
from datagen.machine.mitsuba_variant import use_mitsuba
from hyaline_photos.capture.stereo import DepthMaps, projections_of, sources_of

SEEN, FOUND = 0.03, 0.1
"""Relative differences of depths up to which another picture sees a place, and a depth map agrees with the room."""
WORSE = 3.0
"""A picture that is this many dB below the median is named, but no more than `NAMED`."""
NAMED = 5
MAX_LACKING = 0.15
"""Share of what depth maps show that a room may lack without a remark."""


def judge_room(
    parts: Mapping[str, Mesh],
    pictures: Mapping[str, UInt8[np.ndarray, "h w 3"]],
    ids: Sequence[UInt8[np.ndarray, "h w"]],
    cameras: Cameras,
    maps: DepthMaps,
) -> list[str]:
    """Lines on a room: dB beside the glass, the pictures that it explains worst, and what it lacks.

    Args:
        pictures: of training, by name.
        ids: 0 beside the glass.
        maps: of the same views, perhaps larger.
    """
    depth = _depths(parts, cameras)
    scores = _scores([picture / 255 for picture in pictures.values()], ids, depth, cameras)
    known = np.isfinite(scores)
    if not known.any():
        return ["room: no picture shows a surface of it that another one shows, too; check cameras and masks"]
    median = float(np.median(scores[known]))
    lines = [f"room: pictures that are predicted from others have {median:.1f} dB (median) beside the glass"]
    order = [(name, score) for score, name in sorted(zip(scores, pictures, strict=True)) if score < median - WORSE]
    if order:
        worst = ", ".join(f"{name} ({score:.1f} dB)" for name, score in order[:NAMED])
        lines.append(f"room: doubtful in {len(order)} of {len(scores)} pictures, worst in {worst}")
    sizes = zip(depth.shape[1:], maps.depth.shape[1:], strict=True)
    rows, columns = (((np.arange(size) + 0.5) * large / size).astype(int) for size, large in sizes)
    found = maps.depth[:, rows[:, None], columns]
    lacking = (np.abs(depth - found) > FOUND * found)[found > 0]
    if len(lacking) and lacking.mean() > MAX_LACKING:
        lines.append(f"room: {lacking.mean():.0%} of the surfaces that depth maps show are missing or elsewhere")
    return lines


def _depths(parts: Mapping[str, Mesh], cameras: Cameras) -> Float32[np.ndarray, "view h w"]:
    """Depth of the room along each camera's axis; infinite where there is none."""
    use_mitsuba()
    from datagen.trace.peel import Peeler

    peeler, found = Peeler(tuple(parts.values())), []
    for view in range(len(cameras)):
        origin, directions = cameras[view].rays()
        hits = peeler.trace(origin, directions.reshape(-1, 3), 1)
        along = directions @ -cameras.world_from_camera[view, :3, 2]
        found.append(np.where(hits.shape[0] >= 0, hits.t[0], np.inf).reshape(along.shape) * along)
    return np.stack(found).astype(np.float32)


def _scores(
    pictures: Sequence[Float[np.ndarray, "h w 3"]],
    ids: Sequence[UInt8[np.ndarray, "h w"]],
    depth: Float32[np.ndarray, "view h w"],
    cameras: Cameras,
) -> Float[np.ndarray, " view"]:
    """dB of each picture beside the glass, at best brightness; NaN where no other picture shows what it shows."""
    from scipy.ndimage import map_coordinates

    projections, scores = projections_of(cameras), np.full(len(pictures), np.nan)
    rows, columns = np.indices(depth.shape[1:]) + 0.5
    ahead = np.stack([columns, rows, np.ones_like(rows)])
    middle = cameras.world_from_camera[:, :3, 3].mean(axis=0) - cameras.world_from_camera[:, :3, 2].mean(axis=0)
    for view, others in enumerate(sources_of(cameras, middle)):
        is_there = np.isfinite(depth[view]) & (ids[view] == 0)
        seen = ahead[:, is_there] * depth[view][is_there] - projections[view, :, 3:]
        points = np.linalg.solve(projections[view, :, :3], seen)
        total, count = np.zeros((points.shape[1], 3)), np.zeros(points.shape[1])
        for other in others:
            x, y, z = projections[other, :, :3] @ points + projections[other, :, 3:]
            place = np.stack([y, x]) / np.where(z > 0, z, np.inf) - 0.5
            near = np.rint(place).astype(int)
            is_in = (z > 0) & (near >= 0).all(axis=0) & (near < np.array(rows.shape)[:, None]).all(axis=0)
            row, column = np.where(is_in, near, 0)
            is_in &= (np.abs(depth[other, row, column] - z) < SEEN * z) & (ids[other][row, column] == 0)
            colors = [map_coordinates(pictures[other][..., each], place, order=1, mode="nearest") for each in range(3)]
            total += np.where(is_in, colors, 0).T
            count += is_in
        shown = count > 0
        if shown.any():
            truth, drawn = pictures[view][is_there][shown], total[shown] / count[shown, None]
            drawn = drawn * truth.sum(axis=0) / np.maximum(drawn.sum(axis=0), 1e-9)
            scores[view] = -10 * np.log10(max(np.mean((drawn - truth) ** 2), 1e-10))
    return scores
