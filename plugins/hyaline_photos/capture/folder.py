"""The folder of a capture: pictures, a mask for each picture and glass object, cameras, points of opaque surfaces.

    FOLDER/images/NAME.jpg           pictures (PNG, JPEG or WebP); or in FOLDER itself, or where a transforms file says
    FOLDER/masks/OBJECT/NAME.png     white where the object is seen
    FOLDER/transforms.json           cameras as NeRF tools write them (or transforms_{train,val,test}.json), or
    FOLDER/sparse/0/                 a model of COLMAP, binary or text, or neither

COLMAP finds cameras that are not there, from the training pictures alone; this needs the extra `capture`. Glass is
masked: features on it move with the light, not with the surface.
"""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import numpy as np
from jaxtyping import Bool, Float
from PIL import Image

from datagen.data.config import MAX_VIEWS, license_line
from datagen.data.images import mask_pixels
from datagen.data.transforms import Frame, Transforms
from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import check_regular, commit
from datagen.scene.description import MAX_OBJECTS
from datagen.terminal.command import say, track, waiting
from hyaline_import.cameras import colmap_images, colmap_points, has_colmap
from hyaline_import.datasets.import_dataset import OURS
from hyaline_import.datasets.layouts import (
    EVERY,
    ROLES,
    ForeignDataset,
    ForeignView,
    Role,
    about_unlisted,
    find_named,
    opened,
    picture_size,
    split_listed,
    transforms_in,
)
from hyaline_import.importing import unique_names
from hyaline_photos.capture.lenses import TakenLens, lens_of_colmap, lens_of_frame

PICTURES, MASKS, FOUND = "images", "masks", "colmap"
LAYOUT = "capture"
"""Name of the layout in a dataset's record of its import."""
ENDINGS = (".png", ".jpg", ".jpeg", ".webp")
NAMED = 3
"""Files that an error names."""
MAX_LACKING = 0.15
"""Share of the pictures that may lack a mask; they are left out."""
MAX_SPECK = 0.003
"""Area of a speck or pinhole over that of its mask."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Shot(ForeignView):
    """A picture, the lens that took it, and a mask for each object."""

    lens: TakenLens
    masks: tuple[Path, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class Folder(ForeignDataset):
    """Everything that the folder of a capture names."""

    objects: tuple[str, ...]
    """Names of the objects of glass, in the order of a shot's masks."""
    points: Float[np.ndarray, "point 3"]
    """COLMAP's, on opaque surfaces in the cameras' world; possibly none."""
    has_unit: bool
    """True if the cameras' world is upright and in metres, as in a transforms file."""

    @property
    def shots(self) -> list[Shot]:
        """All views."""
        return [cast(Shot, shot) for role in ROLES for shot in self.views[role]]

    @property
    def files(self) -> list[Path]:
        """Every file whose content becomes a part of the dataset."""
        return [path for shot in self.shots for path in (shot.picture, *shot.masks)]


def read_capture(root: Path) -> Folder:
    """Lists the contents of a folder without decoding pictures; finds cameras that it lacks."""
    if not root.is_dir():
        raise HyalineError(f"{root}: is not a folder; expected one with {PICTURES}/ and {MASKS}/OBJECT/")
    if files := transforms_in(root):
        return _with_transforms(root, files)
    pictures = find_pictures(root)
    tests = tests_among(pictures)
    objects, masks, remarks = find_masks(root, pictures)
    if not has_colmap(root):
        find_cameras(root, masks, tests)
    return _with_colmap(root, pictures, tests, objects, masks, remarks)


def find_pictures(root: Path) -> list[Path]:
    """The pictures in images/, or else in the folder itself, by name."""
    folder = root / PICTURES if (root / PICTURES).is_dir() else root
    found = [path for path in _pictures_below(folder) if path.relative_to(root).parts[0] != MASKS]
    if not 3 <= len(found) <= MAX_VIEWS:
        expected = f"expected 3 to {MAX_VIEWS:,} PNG, JPEG or WebP files in it or in {PICTURES}/"
        raise HyalineError(f"{root}: has {len(found)} pictures; {expected}")
    for path in found:
        check_regular(path, root, where=str(root))
        picture_size(path)  # Refuses turned pictures before COLMAP spends minutes on them.
    return found


def _pictures_below(folder: Path) -> list[Path]:
    """The pictures in a folder and the folders in it, except hidden ones, such as macOS leaves."""
    found = (path for path in folder.rglob("*") if path.suffix.lower() in ENDINGS)
    return sorted(path for path in found if not any(part[0] == "." for part in path.relative_to(folder).parts))


Masks = dict[Path, tuple[Path, ...]]
"""For each picture the masks of all objects."""


def find_masks(root: Path, pictures: Sequence[Path]) -> tuple[tuple[str, ...], Masks, list[str]]:
    """Names of the objects, masks by the pictures' paths below images/, with or without their endings, and remarks.

    A picture without a mask for each object is left out: what it lacks may be glass.
    """
    folder = root / MASKS
    folders = sorted(path for path in folder.glob("[!.]*") if path.is_dir()) if folder.is_dir() else []
    if not 1 <= len(folders) < MAX_OBJECTS:
        raise HyalineError(
            f"{folder}: has {len(folders)} folders; expected one for each object of glass with a PNG for each "
            "picture, white where the object is seen"
        )
    found: Masks = dict.fromkeys(pictures, ())
    for one in folders:
        listed = {path.relative_to(one).with_suffix("").as_posix(): path for path in _pictures_below(one)}
        for picture in found:
            name = name_of(root, picture)
            path = listed.get(Path(name).with_suffix("").as_posix(), listed.get(name))
            if path is not None:
                check_regular(path, root, where=str(root))
                found[picture] += (path,)
    lost = [name_of(root, picture) for picture, masks in found.items() if len(masks) < len(folders)]
    if len(lost) > MAX_LACKING * len(found):
        raise HyalineError(
            f"{folder}: lacks masks of {len(lost)} of {len(found)} pictures ({', '.join(lost[:NAMED])}); expected one "
            "for each picture and object, black where the object is not seen"
        )
    whole = {picture: masks for picture, masks in found.items() if len(masks) == len(folders)}
    return tuple(unique_names([path.name for path in folders])), whole, _left_out("masks", lost, len(pictures))


def _left_out(what: str, names: Sequence[str], count: int) -> list[str]:
    """A line on pictures without masks or cameras."""
    some = f"{', '.join(names[:NAMED])}{', ...' if len(names) > NAMED else ''}"
    return [f"{what}: {len(names)} of {count} pictures have none and were left out ({some})"] * bool(names)


def read_mask(path: Path, size: tuple[int, int]) -> Bool[np.ndarray, "h w"]:
    """True where a mask shows its object; without the specks and pinholes that segmentation networks leave."""
    from scipy import ndimage

    mask = mask_pixels(opened(path, size))
    for value in (True, False):
        parts = np.asarray(ndimage.label(mask == value)[0])  # pyright: ignore[reportIndexIssue]
        is_small = np.bincount(parts.reshape(-1)) < MAX_SPECK * mask.sum()
        is_small[0] = False  # It counts the pixels of the other value.
        mask = mask ^ is_small[parts]
    return mask


def tests_among(pictures: Sequence[Path]) -> set[Path]:
    """The pictures that nothing is found from: those that `datagen export` named as tests, or else every eighth."""
    named = [OURS.fullmatch(path.stem) for path in pictures]
    if all(named):
        return {path for path, match in zip(pictures, named, strict=True) if match and match[1] != "train"}
    return set(pictures[::EVERY])


def name_of(root: Path, picture: Path) -> str:
    """A picture's path below images/, or else below the folder: what COLMAP and masks call it."""
    path = picture.relative_to(root)
    return (Path(*path.parts[1:]) if path.parts[0] == PICTURES else path).as_posix()


# Cameras


def _with_transforms(root: Path, found: dict[Role, Transforms]) -> Folder:
    first = found["train"]
    frames: list[tuple[Role, Transforms, Frame]]
    frames = [(role, file, frame) for role, file in found.items() for frame in file.frames]
    pictures = [find_named(root, frame, "file_path") for _, _, frame in frames]
    objects, masks, remarks = find_masks(root, pictures)
    views: dict[Role, list[Shot]] = {role: [] for role in ROLES}
    for (role, file, frame), picture in zip(frames, pictures, strict=True):
        lens, pose, own = lens_of_frame(file, frame, picture_size(picture)), file.pose(frame), masks.get(picture, ())
        views[role].append(Shot(picture=picture, mask=None, world_from_camera=pose, lens=lens, masks=own))
    listed: dict[Role, tuple[Shot, ...]] = {role: tuple(shots) for role, shots in views.items()}
    if len(found) == 1:
        listed = split_listed(first, listed["train"])
        remarks += about_unlisted(first, listed)
    return Folder(
        root=root,
        layout=LAYOUT,
        lens=views["train"][0].lens.pinhole,
        views={role: tuple(shot for shot in shots if shot.masks) for role, shots in listed.items()},
        objects=objects,
        points=np.zeros((0, 3)),
        has_unit=True,
        license=license_line(first.content.get("license")),
        remarks=tuple(remarks),
    )


def _with_colmap(
    root: Path, pictures: list[Path], tests: set[Path], objects: tuple[str, ...], masks: Masks, remarks: list[str]
) -> Folder:
    listed, shots, lost = colmap_images(root), [], []
    for picture in masks:
        name = name_of(root, picture)
        if name not in listed:
            lost.append(name)
            continue
        row, pose, where = listed[name]
        lens = lens_of_colmap(row, picture_size(picture), where=where)
        shots.append(Shot(picture=picture, mask=None, world_from_camera=pose, lens=lens, masks=masks[picture]))
    if len(shots) < 3:
        raise HyalineError(
            f"{root}: its model of COLMAP has cameras for {len(shots)} of {len(pictures)} pictures, by names such as "
            f"{shown(next(iter(listed)))}; expected those below {PICTURES}/, such as {name_of(root, pictures[0])}"
        )
    return Folder(
        root=root,
        layout=LAYOUT,
        lens=shots[0].lens.pinhole,
        views={
            "train": tuple(shot for shot in shots if shot.picture not in tests),
            "val": (),
            "test": tuple(shot for shot in shots if shot.picture in tests),
        },
        objects=objects,
        points=colmap_points(root),
        has_unit=False,
        remarks=(*remarks, *_left_out("cameras", lost, len(pictures))),
    )


# What COLMAP finds


EXTRA = "pip install 'hyaline-glass[capture]'"
SMALL = 400
"""Pictures with a shorter longest side are enlarged: SIFT finds too little in them."""
LARGE = 1600
"""Larger ones are made smaller: that costs no accuracy that a dataset's pictures could show."""
MOST_FEATURES = 1200
LEAST_SHARE = 0.5
"""Share of the pictures whose cameras must be found."""
TRIES = 4
"""Searches for cameras from other first pairs: of six on one scene, one found a wrong lens and another few points."""
LEAST_SEEN = 20
"""Points that a picture must show: cameras by fewer are often wrong."""
MODEL = "SIMPLE_RADIAL"
"""COLMAP's model of the lens."""


def find_cameras(root: Path, masks: Masks, tests: set[Path]) -> None:
    """Writes a model with the cameras of pictures to FOLDER/colmap/sparse/0, where the next run finds them.

    The lens, the points and the cameras of training pictures come from these alone; those of test pictures follow.
    """
    colmap = _colmap(f"{root}: has no cameras (transforms.json, or COLMAP's sparse/0)")
    pictures = list(masks)
    held_out = {f"{place:05d}.png" for place, path in enumerate(pictures) if path in tests}
    say(f"{root}: has no cameras; finding them in {len(pictures)} pictures, which takes minutes")
    with tempfile.TemporaryDirectory(prefix="hyaline-capture-") as scratch:
        folder = Path(scratch)
        times = _write_pictures(folder, masks)
        database = _matched(colmap, folder)
        options = colmap.IncrementalPipelineOptions()
        options.image_names = sorted({path.name for path in (folder / "images").iterdir()} - held_out)
        options.min_model_size = 3
        # Small pictures have few features.
        options.mapper.init_min_num_inliers, options.mapper.abs_pose_min_num_inliers = 50, 15
        models = []
        with waiting("cameras of training pictures"):
            for seed in range(TRIES):
                options.random_seed = options.mapper.random_seed = seed
                (folder / str(seed)).mkdir()
                models += colmap.incremental_mapping(database, folder / "images", folder / str(seed), options).values()
        found = max(models, key=lambda model: model.compute_num_observations(), default=None)
        if found:
            for image in list(found.images.values()):
                if image.num_points3D < LEAST_SEEN:
                    found.deregister_frame(image.frame_id)
            _place_others(colmap, found, database, held_out)
            for image in found.images.values():
                image.name = name_of(root, pictures[int(Path(image.name).stem)])
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


def _place_others(colmap: ModuleType, found: Any, database: Path, names: set[str]) -> None:
    """Adds to a model the cameras of pictures that took no part in it; neither its points nor its lens change."""
    known = [found.images[number] for number in found.reg_image_ids()]
    with colmap.Database.open(database) as opened_database:
        for image in opened_database.read_all_images():
            if image.name not in names or image.camera_id not in found.cameras:
                continue
            places, points = opened_database.read_keypoints(image.image_id)[:, :2], {}
            for other in known:
                pair = opened_database.read_two_view_geometry(image.image_id, other.image_id)
                for own, their in pair.inlier_matches.tolist():
                    if other.points2D[their].has_point3D():
                        points[own, other.points2D[their].point3D_id] = found.points3D[other.points2D[their].point3D_id]
            seen = np.array([places[own] for own, _ in points], np.float64).reshape(-1, 2)
            there = np.array([point.xyz for point in points.values()]).reshape(-1, 3)
            answer = colmap.estimate_and_refine_absolute_pose(seen, there, found.cameras[image.camera_id])
            if answer is not None and answer["num_inliers"] >= LEAST_SEEN:
                placed = colmap.Image(name=image.name, camera_id=image.camera_id, image_id=image.image_id)
                found.add_image_with_trivial_frame(placed, answer["cam_from_world"])


def _colmap(why: str) -> ModuleType:
    try:
        import pycolmap  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise HyalineError(f"{why}, and pycolmap, which finds them, is not installed: `{EXTRA}`") from None
    pycolmap.logging.minloglevel = 2  # It logs every step; its errors are enough.
    pycolmap.set_random_seed(0)
    return pycolmap


def _write_pictures(folder: Path, pictures: Masks) -> float:
    """Pictures and masks by their numbers, as COLMAP takes them, all made larger or smaller alike; by how much."""
    longest = max(max(picture_size(path)) for path in pictures)
    times = LARGE / longest if longest > LARGE else float(np.ceil(SMALL / longest)) if longest < SMALL else 1.0
    for name in ("images", "masks"):
        (folder / name).mkdir()
    for place, (path, masks) in enumerate(track(pictures.items(), label="reading", total=len(pictures))):
        picture = opened(path).convert("RGB")
        size = (round(times * picture.width), round(times * picture.height))
        picture.resize(size, Image.Resampling.LANCZOS).save(folder / "images" / f"{place:05d}.png")
        seen = np.any([read_mask(mask, picture.size) for mask in masks], axis=0)
        hidden = Image.fromarray(np.where(seen, 0, 255).astype(np.uint8)).resize(size)
        hidden.save(folder / "masks" / f"{place:05d}.png.png")
    return times


def _matched(colmap: ModuleType, folder: Path) -> Path:
    """The database of features and matches of all pairs of pictures."""
    database = folder / "database.db"
    reader = colmap.ImageReaderOptions()
    reader.camera_model, reader.mask_path = MODEL, folder / "masks"
    features = colmap.FeatureExtractionOptions()
    features.sift.max_num_features = MOST_FEATURES
    options = {"reader_options": reader, "extraction_options": features, "device": colmap.Device.cpu}
    by_size: dict[tuple[int, int], list[str]] = {}
    for path in sorted((folder / "images").iterdir()):
        by_size.setdefault(picture_size(path), []).append(path.name)
    with waiting("features of all pictures"):
        for names in by_size.values():  # Pictures of one size have one lens.
            single = {"image_names": names, "camera_mode": colmap.CameraMode.SINGLE}
            colmap.extract_features(database, folder / "images", **single, **options)
    with waiting("matches of all pairs of pictures"):
        colmap.match_exhaustive(database, device=colmap.Device.cpu)
    return database
