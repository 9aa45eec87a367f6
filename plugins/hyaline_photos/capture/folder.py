"""The folder of a capture: pictures, a mask for each picture and glass object, cameras, points.

    FOLDER/images/NAME.jpg           pictures (PNG, JPEG or WebP); or in FOLDER itself, or where a transforms file says
    FOLDER/masks/OBJECT/NAME.png     white where the object is seen
    FOLDER/transforms.json           cameras as NeRF tools write them (or transforms_{train,val,test}.json), or
    FOLDER/sparse/0/                 a model of COLMAP, binary or text, or neither

Masks that a transforms file names (mask_file_path, as in RefRef) are of one object, `glass`.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float

from datagen.data.config import MAX_VIEWS, license_line
from datagen.data.ply import read_ply_points
from datagen.data.transforms import Frame, Transforms, relative_name
from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import check_regular, find_file
from datagen.scene.description import MAX_OBJECTS
from hyaline_import.cameras import colmap_images, colmap_points, has_colmap
from hyaline_import.datasets.layouts import (
    ROLES,
    ForeignDataset,
    ForeignView,
    Role,
    about_unlisted,
    find_named,
    picture_size,
    split_evenly,
    split_listed,
    transforms_in,
)
from hyaline_import.importing import unique_names
from hyaline_photos.capture.lenses import TakenLens, lens_of_colmap, lens_of_frame

PICTURES, MASKS, FOUND = "images", "masks", "colmap"
LAYOUT = "capture"
"""Name of the layout in a dataset's record of its import."""
ENDINGS = (".png", ".jpg", ".jpeg", ".webp")
OTHER_ENDINGS = (".heic", ".heif", ".avif", ".tif", ".tiff", ".bmp")
"""Pictures of kinds that are not read."""
POINTS = ("points3d.ply", "sparse_pc.ply")
"""Files of points beside a transforms file that names none."""
ONE_OBJECT = "glass"
NAMED = 3
"""Files that an error names."""


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
    """Points on opaque surfaces in the cameras' world; possibly empty."""
    points_file: Path | None
    has_unit: bool
    """True if the cameras' world is upright and in metres, as in a transforms file."""
    cameras: str
    """Where the cameras come from."""

    @property
    def shots(self) -> list[Shot]:
        """All views."""
        return [cast(Shot, shot) for role in ROLES for shot in self.views[role]]

    @property
    def files(self) -> list[Path]:
        """Every file whose content becomes a part of the dataset."""
        parts = [path for shot in self.shots for path in (shot.picture, *shot.masks)]
        return [*parts, *([self.points_file] if self.points_file else [])]


def read_capture(root: Path, find_cameras: Callable[[Path, list[Path], "Masks"], None]) -> Folder:
    """Lists the contents of a folder without decoding pictures.

    Args:
        find_cameras: writes a model of COLMAP for pictures without cameras into FOLDER/colmap.
    """
    if not root.is_dir():
        raise HyalineError(f"{root}: is not a folder; expected one with {PICTURES}/ and {MASKS}/OBJECT/")
    if files := transforms_in(root):
        return _with_transforms(root, files)
    pictures = find_pictures(root)
    masks = find_masks(root, pictures)
    if not has_colmap(root):
        find_cameras(root, pictures, masks)
    return _with_colmap(root, pictures, masks)


def find_pictures(root: Path) -> list[Path]:
    """The pictures in images/, or else in the folder itself, by name."""
    found = _listed(root, ENDINGS)
    if not 3 <= len(found) <= MAX_VIEWS:
        others = f" beside {kinds}" if (kinds := _other_kinds(root)) else ""
        expected = f"expected 3 to {MAX_VIEWS:,} PNG, JPEG or WebP files in it or in {PICTURES}/"
        raise HyalineError(f"{root}: has {len(found)} pictures{others}; {expected}")
    for path in found:
        check_regular(path, root, where=str(root))
        picture_size(path)  # Refuses turned pictures before COLMAP spends minutes on them.
    return found


def _listed(root: Path, endings: tuple[str, ...]) -> list[Path]:
    folder = root / PICTURES if (root / PICTURES).is_dir() else root
    return [path for path in _pictures_below(folder, endings) if path.relative_to(root).parts[0] != MASKS]


def _other_kinds(root: Path) -> str:
    """How many pictures are of kinds that are not read, and which; empty without any."""
    found = _listed(root, OTHER_ENDINGS)
    kinds = ", ".join(sorted({path.suffix.lower() for path in found}))
    return f"{len(found)} of other kinds ({kinds})" if found else ""


def _pictures_below(folder: Path, endings: tuple[str, ...] = ENDINGS) -> list[Path]:
    """The pictures in a folder and the folders in it, except hidden ones, such as macOS leaves."""
    found = (path for path in folder.rglob("*") if path.suffix.lower() in endings)
    return sorted(path for path in found if not any(part[0] == "." for part in path.relative_to(folder).parts))


@dataclass(frozen=True, kw_only=True)
class Masks:
    """The names of the objects, and for each picture the masks of all of them."""

    objects: tuple[str, ...]
    of: dict[Path, tuple[Path, ...]]


def find_masks(root: Path, pictures: Sequence[Path]) -> Masks:
    """The mask of each picture and object, by the picture's path below images/ or by its name alone, with or without
    its ending."""
    folder = root / MASKS
    folders = sorted(path for path in folder.glob("[!.]*") if path.is_dir()) if folder.is_dir() else []
    if not 1 <= len(folders) < MAX_OBJECTS:
        raise HyalineError(
            f"{folder}: has {len(folders)} folders; expected one for each object of glass with a PNG for each "
            "picture, white where the object is seen"
        )
    names = [Path(name_of(root, path)).with_suffix("").as_posix() for path in pictures]
    if again := [name for name, count in Counter(names).items() if count > 1]:
        raise HyalineError(
            f"{root}: two pictures are called {shown(again[0])}; expected names that differ before the dot"
        )
    stems = Counter(path.stem for path in pictures)
    found: list[list[Path]] = [[] for _ in pictures]
    for one in folders:
        listed: dict[str, Path] = {}
        for path in _pictures_below(one):
            name = path.relative_to(one).with_suffix("").as_posix()
            if (other := listed.setdefault(name, path)) != path:
                raise HyalineError(f"{other} and {path}: two masks of one picture; expected one")
        lacking = []
        for masks, name, picture in zip(found, names, pictures, strict=True):
            known = [name, name_of(root, picture), *([picture.stem] if stems[picture.stem] == 1 else [])]
            path = next((listed[each] for each in known if each in listed), None)
            if path is None:
                lacking.append(f"{name}.png")
            else:
                check_regular(path, root, where=str(root))
                masks.append(path)
        if lacking:
            raise HyalineError(
                f"{one}: has no mask for {len(lacking)} of {len(pictures)} pictures ({', '.join(lacking[:NAMED])}); "
                "expected one for each, black where the object is not seen"
            )
    objects = tuple(unique_names([path.name for path in folders]))
    return Masks(objects=objects, of=dict(zip(pictures, map(tuple, found), strict=True)))


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
    sizes = {path: picture_size(path) for path in pictures}
    remarks, has_folders = [], (root / MASKS).is_dir() and any(path.is_dir() for path in (root / MASKS).iterdir())
    if not has_folders and all("mask_file_path" in frame.data for _, _, frame in frames):
        objects, masks = (ONE_OBJECT,), [(find_named(root, frame, "mask_file_path"),) for _, _, frame in frames]
        remarks.append(f"masks: {MASKS}/ is not there; the files' masks are those of one object, {ONE_OBJECT}")
    else:
        given = find_masks(root, list(sizes))
        objects, masks = given.objects, [given.of[picture] for picture in pictures]
    views: dict[Role, list[Shot]] = {role: [] for role in ROLES}
    for (role, file, frame), picture, own in zip(frames, pictures, masks, strict=True):
        lens = lens_of_frame(file, frame, sizes[picture])
        views[role].append(Shot(picture=picture, mask=None, world_from_camera=file.pose(frame), lens=lens, masks=own))
    listed: dict[Role, tuple[Shot, ...]] = {role: tuple(shots) for role, shots in views.items()}
    if len(found) == 1:
        listed = split_listed(first, listed["train"])
        remarks += about_unlisted(first, listed)
    points, points_file = _points(root, first.content.get("ply_file_path"))
    return Folder(
        root=root,
        layout=LAYOUT,
        lens=views["train"][0].lens.pinhole,
        views={**listed},
        objects=objects,
        points=points,
        points_file=points_file,
        has_unit=True,
        cameras=", ".join(Path(file.where).name for file in found.values()),
        license=license_line(first.content.get("license")),
        remarks=tuple(remarks),
    )


def _points(root: Path, named: object = None) -> tuple[Float[np.ndarray, "point 3"], Path | None]:
    """The points of a file of this name, or of a usual one, and where they are; none without such a file."""
    usual = (name for name in POINTS if (root / name).is_file())
    name = relative_name(named) if isinstance(named, str) else next(usual, None)
    file = None if name is None else find_file(root, name, where=f"{root}: points")
    return (np.zeros((0, 3)) if file is None else read_ply_points(file)), file


def _with_colmap(root: Path, pictures: list[Path], masks: Masks) -> Folder:
    listed = colmap_images(root)
    shots, lost = [], []
    for picture in pictures:
        name = name_of(root, picture)
        if name not in listed:
            lost.append(name)
            continue
        row, pose, where = listed[name]
        lens = lens_of_colmap(row, picture_size(picture), where=where)
        shots.append(Shot(picture=picture, mask=None, world_from_camera=pose, lens=lens, masks=masks.of[picture]))
    if len(shots) < 3:
        raise HyalineError(
            f"{root}: its model of COLMAP has cameras for {len(shots)} of {len(pictures)} pictures, by names such as "
            f"{shown(next(iter(listed)))}; expected those below {PICTURES}/, such as {name_of(root, pictures[0])}"
        )
    remarks = []
    if others := _other_kinds(root):
        remarks.append(f"pictures: {others} were left out; convert them to PNG or JPEG")
    if lost:
        remarks.append(
            f"cameras: {len(lost)} of {len(pictures)} pictures have none and were left out "
            f"({', '.join(lost[:NAMED])}{', ...' if len(lost) > NAMED else ''})"
        )
    points, points_file = colmap_points(root), None
    if not len(points):
        points, points_file = _points(root)
    return Folder(
        root=root,
        layout=LAYOUT,
        lens=shots[0].lens.pinhole,
        views={**split_evenly(shots)},
        objects=masks.objects,
        points=points,
        points_file=points_file,
        has_unit=False,
        cameras="COLMAP",
        remarks=tuple(remarks),
    )
