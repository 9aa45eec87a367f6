"""Cameras and points of opaque surfaces that COLMAP finds in pictures; needs the extra `capture`.

Glass is masked: features on it move with the light, not with the surface.
"""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

import numpy as np
from PIL import Image

from datagen.data.images import mask_pixels
from datagen.disk.errors import HyalineError
from datagen.disk.storage import commit
from datagen.terminal.command import say
from hyaline_import.datasets.layouts import opened, picture_size
from hyaline_photos.capture.folder import FOUND, POINTS, Folder, Masks, Shot, name_of

EXTRA = "pip install 'hyaline-glass[capture]'"
SMALL = 400
"""Pictures with a shorter longest side are enlarged: SIFT finds too little in them."""
LARGE = 1600
"""Larger ones are made smaller: that costs no accuracy that a dataset's pictures could show."""
MOST_FEATURES = 1200
LEAST_SHARE = 0.5
"""Share of the pictures whose cameras must be found."""
LEAST_SEEN = 20
"""Points that a picture must show: cameras by fewer are often wrong."""
MODEL, KNOWN = "SIMPLE_RADIAL", "OPENCV"
"""COLMAP's models of lenses that are found, and that are known."""


def find_cameras(root: Path, pictures: list[Path], masks: Masks) -> None:
    """Writes a model with the cameras of pictures to FOLDER/colmap/sparse/0, where the next run finds them."""
    colmap = _colmap(f"{root}: has no cameras (transforms.json, or COLMAP's sparse/0)")
    say(f"{root}: has no cameras; finding them in {len(pictures)} pictures, which takes minutes")
    with tempfile.TemporaryDirectory(prefix="hyaline-capture-") as scratch:
        folder = Path(scratch)
        times = _write_pictures(folder, [(path, masks.of[path]) for path in pictures])
        database = _matched(colmap, folder, model=MODEL)
        options = colmap.IncrementalPipelineOptions()
        options.min_model_size = 3
        # Small pictures have few features.
        options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = 50, 15
        models = colmap.incremental_mapping(database, folder / "images", folder, options)
        found = max(models.values(), key=lambda model: model.num_reg_images(), default=None)
        for image in list(found.images.values()) if found else []:
            image.name = name_of(root, pictures[int(Path(image.name).stem)])
            if image.num_points3D < LEAST_SEEN:
                found.deregister_frame(image.frame_id)  # pyright: ignore[reportOptionalMemberAccess]
        count = found.num_reg_images() if found else 0
        if not found or count < max(3, LEAST_SHARE * len(pictures)):
            raise HyalineError(
                f"{root}: COLMAP found the cameras of {count} of {len(pictures)} pictures; expected at least half: "
                "take more pictures with texture around the glass, at least 500 pixels wide, or bring transforms.json"
            )
        for camera in found.cameras.values():
            camera.rescale(round(camera.width / times), round(camera.height / times))
        found.write_text(folder)
        # Without its images the model does not count, so they are the last to be there.
        for name in ("points3D.txt", "cameras.txt", "images.txt"):
            commit(root / FOUND / "sparse" / "0" / name, (folder / name).read_bytes())
    say(f"{root}: {count} cameras and {len(found.points3D):,} points were found, and kept in {root / FOUND}")


def find_points(folder: Folder) -> None:
    """Writes points of opaque surfaces, seen by cameras that are known, to FOLDER/points3d.ply.

    Without the extra `capture`, there are none.
    """
    try:
        colmap = _colmap("")
    except HyalineError:
        return
    shots = folder.shots
    say(f"{folder.root}: has no points for the room; finding them in {len(shots)} pictures, which takes minutes")
    with tempfile.TemporaryDirectory(prefix="hyaline-capture-") as scratch:
        work = Path(scratch)
        times = _write_pictures(work, [(shot.picture, shot.masks) for shot in shots])
        database = _matched(colmap, work, model=KNOWN)
        known = _known(colmap, database, shots, times)
        found = colmap.triangulate_points(known, database, work / "images", work)
    points = np.array([point.xyz for point in found.points3D.values()]).reshape(-1, 3)
    if not len(points):
        say(f"{folder.root}: no points were found, for want of detail beside the glass")
        return
    import trimesh

    data = trimesh.PointCloud(points).export(file_type="ply")
    assert isinstance(data, bytes), "a binary PLY"
    commit(folder.root / POINTS[0], data)
    say(f"{folder.root}: {len(points):,} points were found, and kept in {folder.root / POINTS[0]}")


def _colmap(why: str) -> ModuleType:
    try:
        import pycolmap  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise HyalineError(f"{why}, and pycolmap, which finds them, is not installed: `{EXTRA}`") from None
    pycolmap.logging.minloglevel = 2  # It logs every step; its errors are enough.
    pycolmap.set_random_seed(0)
    return pycolmap


def _write_pictures(folder: Path, pictures: Sequence[tuple[Path, Sequence[Path]]]) -> float:
    """Pictures and masks by their numbers, as COLMAP takes them, all made larger or smaller alike; by how much."""
    longest = max(max(picture_size(path)) for path, _ in pictures)
    times = LARGE / longest if longest > LARGE else float(np.ceil(SMALL / longest)) if longest < SMALL else 1.0
    for name in ("images", "masks"):
        (folder / name).mkdir()
    for place, (path, masks) in enumerate(pictures):
        picture = opened(path).convert("RGB")
        size = (round(times * picture.width), round(times * picture.height))
        picture.resize(size, Image.Resampling.LANCZOS).save(folder / "images" / f"{place:05d}.png")
        seen = np.zeros((picture.height, picture.width), bool)
        for mask in masks:
            seen |= mask_pixels(opened(mask, picture.size))
        hidden = Image.fromarray(np.where(seen, 0, 255).astype(np.uint8)).resize(size)
        hidden.save(folder / "masks" / f"{place:05d}.png.png")
    return times


def _matched(colmap: ModuleType, folder: Path, *, model: str) -> Path:
    """The database of features and matches of all pairs of pictures."""
    database = folder / "database.db"
    reader = colmap.ImageReaderOptions()
    reader.camera_model, reader.mask_path = model, folder / "masks"
    features = colmap.FeatureExtractionOptions()
    features.sift.max_num_features = MOST_FEATURES
    sizes = {picture_size(path) for path in (folder / "images").iterdir()}
    found = colmap.CameraMode.SINGLE if len(sizes) == 1 else colmap.CameraMode.AUTO
    options = {
        "camera_mode": colmap.CameraMode.PER_IMAGE if model == KNOWN else found,
        "reader_options": reader,
        "extraction_options": features,
        "device": colmap.Device.cpu,
    }
    colmap.extract_features(database, folder / "images", **options)
    colmap.match_exhaustive(database, device=colmap.Device.cpu)
    return database


def _known(colmap: ModuleType, database: Path, shots: Sequence[Shot], times: float) -> object:
    """A model of COLMAP that holds cameras and no points."""
    known = colmap.Reconstruction()
    with colmap.Database.open(database) as opened_database:
        for image in opened_database.read_all_images():
            shot = shots[int(Path(image.name).stem)]
            lens = shot.lens
            k1, k2 = (*lens.radial, 0.0, 0.0)[:2]
            camera = colmap.Camera(
                camera_id=image.camera_id,
                model=KNOWN,
                width=round(times * lens.width),
                height=round(times * lens.height),
                params=[*(times * f for f in lens.focal), *(times * c for c in lens.center), k1, k2, *lens.tangential],
            )
            known.add_camera_with_trivial_rig(camera)
            pose = shot.world_from_camera
            rotation = (pose[:3, :3] * [1, -1, -1]).T
            camera_from_world = np.concatenate([rotation, -rotation @ pose[:3, 3:]], axis=1)
            placed = colmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
            known.add_image_with_trivial_frame(placed, colmap.Rigid3d(camera_from_world))
    return known
