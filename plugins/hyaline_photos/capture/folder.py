"""The folder of a capture: pictures, a mask for each picture and glass object, cameras, points.

    FOLDER/images/NAME.jpg           pictures (PNG, JPEG or WebP); or in FOLDER itself, or where a transforms file says
    FOLDER/masks/OBJECT/NAME.png     white where the object is seen
    FOLDER/transforms.json           cameras as NeRF tools write them (or transforms_{train,val,test}.json), or
    FOLDER/sparse/0/                 a model of COLMAP, binary or text, or neither

Masks that a transforms file names (mask_file_path, as in RefRef) are of one object, `glass`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float

from datagen.data.config import MAX_VIEWS, license_line
from datagen.data.ply import read_ply_points
from datagen.data.transforms import Transforms, relative_name
from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import check_regular, find_file
from datagen.scene.description import MAX_OBJECTS
from hyaline_import.cameras import colmap_images, colmap_points, has_colmap
from hyaline_import.datasets.layouts import (
    ROLES,
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
class Folder:
    """Everything that the folder of a capture names."""

    root: Path
    views: dict[Role, tuple[Shot, ...]]
    objects: tuple[str, ...]
    """Names of the objects of glass, in the order of a shot's masks."""
    points: Float[np.ndarray, "point 3"]
    """Points on opaque surfaces in the cameras' world; possibly empty."""
    has_unit: bool
    """True if the cameras' world is upright and in metres, as in a transforms file."""
    cameras: str
    """Where the cameras come from."""
    points_file: Path | None = None
    license: str | None = None
    remarks: tuple[str, ...] = field(default=())

    @property
    def shots(self) -> list[Shot]:
        """All views."""
        return [shot for role in ROLES for shot in self.views[role]]


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
    masks = Masks(root, pictures)
    if not has_colmap(root):
        find_cameras(root, pictures, masks)
    return _with_colmap(root, pictures, masks)


def find_pictures(root: Path) -> list[Path]:
    """The pictures in images/, or else in the folder itself, by name."""
    found = _listed(root, ENDINGS)
    if not 3 <= len(found) <= MAX_VIEWS:
        others = f" beside {kinds}" if (kinds := _other_kinds(root)) else ""
        expected = f"expected 3 to {MAX_VIEWS:,} PNG, JPEG or WebP files"
        raise HyalineError(f"{_folder_of(root)}: has {len(found)} pictures{others}; {expected}")
    for path in found:
        check_regular(path, root, where=str(root))
        picture_size(path)  # Refuses turned pictures before COLMAP spends minutes on them.
    return found


def _folder_of(root: Path) -> Path:
    return root / PICTURES if (root / PICTURES).is_dir() else root


def _listed(root: Path, endings: tuple[str, ...]) -> list[Path]:
    return [path for path in _pictures_below(_folder_of(root), endings) if path.relative_to(root).parts[0] != MASKS]


def _other_kinds(root: Path) -> str:
    """How many pictures are of kinds that are not read, and which; empty without any."""
    found = _listed(root, OTHER_ENDINGS)
    kinds = ", ".join(sorted({path.suffix.lower() for path in found}))
    return f"{len(found)} of other kinds ({kinds})" if found else ""


def _pictures_below(folder: Path, endings: tuple[str, ...] = ENDINGS) -> list[Path]:
    """The pictures in a folder and the folders in it, except hidden ones, such as macOS leaves."""
    found = (path for path in folder.rglob("*") if path.suffix.lower() in endings)
    return sorted(path for path in found if not any(part[0] == "." for part in path.relative_to(folder).parts))


class Masks:
    """The masks of each object, by the pictures that they belong to."""

    def __init__(self, root: Path, pictures: Sequence[Path]) -> None:
        folder = root / MASKS
        folders = sorted(path for path in folder.glob("[!.]*") if path.is_dir()) if folder.is_dir() else []
        if not 1 <= len(folders) < MAX_OBJECTS:
            raise HyalineError(
                f"{folder}: has {len(folders)} folders; expected one for each object of glass with a PNG for each "
                "picture, white where the object is seen"
            )
        self.objects = tuple(unique_names([path.name for path in folders]))
        self._of = dict(zip(pictures, zip(*(_masks_of(one, root, pictures) for one in folders)), strict=True))

    def of(self, picture: Path) -> tuple[Path, ...]:
        """The masks of a picture."""
        return self._of[picture]


def _masks_of(folder: Path, root: Path, pictures: Sequence[Path]) -> list[Path]:
    """The mask of each picture, found by its path below images/ or by its name alone, with or without its ending."""
    listed: dict[str, Path] = {}
    for path in _pictures_below(folder):
        name = path.relative_to(folder).with_suffix("").as_posix()
        if (other := listed.setdefault(name, path)) != path:
            raise HyalineError(f"{other} and {path}: two masks of one picture; expected one")
    whole = [name_of(root, path) for path in pictures]
    names = [Path(name).with_suffix("").as_posix() for name in whole]
    stems = [path.stem for path in pictures]
    if len(set(names)) < len(names):
        again = next(name for name in names if names.count(name) > 1)
        raise HyalineError(f"{root}: two pictures are called {shown(again)}; expected names that differ before the dot")
    found = [
        listed.get(name) or listed.get(with_ending) or (listed.get(stem) if stems.count(stem) == 1 else None)
        for name, with_ending, stem in zip(names, whole, stems, strict=True)
    ]
    if not any(found):
        raise HyalineError(
            f"{folder}: its masks are of none of the pictures; expected the pictures' names, such as {names[0]}.png"
        )
    lacking = [f"{name}.png" for name, path in zip(names, found, strict=True) if path is None]
    if lacking:
        raise HyalineError(
            f"{folder}: has no mask for {len(lacking)} of {len(pictures)} pictures ({', '.join(lacking[:NAMED])}); "
            "expected one for each, black where the object is not seen"
        )
    for path in found:
        check_regular(path, root, where=str(root))  # type: ignore[arg-type]
    return [path for path in found if path is not None]


def name_of(root: Path, picture: Path) -> str:
    """A picture's path below images/, or else below the folder: what COLMAP and masks call it."""
    path = picture.relative_to(root)
    return (Path(*path.parts[1:]) if path.parts[0] == PICTURES else path).as_posix()


# Cameras


def _with_transforms(root: Path, found: dict[Role, Transforms]) -> Folder:
    first = found["train"]
    pictures = {role: [find_named(root, frame, "file_path") for frame in file.frames] for role, file in found.items()}
    every = list(dict.fromkeys(path for paths in pictures.values() for path in paths))
    sizes = {path: picture_size(path) for path in every}
    remarks = []
    if (root / MASKS).is_dir() and any(path.is_dir() for path in (root / MASKS).iterdir()):
        masks = Masks(root, every)
        objects, masks_of = masks.objects, lambda _, picture: masks.of(picture)
    elif all("mask_file_path" in frame for file in found.values() for frame in file.frames):
        objects, masks_of = (ONE_OBJECT,), lambda frame, _: (find_named(root, frame, "mask_file_path"),)
        remarks.append(f"masks: {MASKS}/ is not there; the files' masks are those of one object, {ONE_OBJECT}")
    else:
        Masks(root, [])
        raise AssertionError("without folders of masks, this is an error")
    views: dict[Role, list[Shot]] = {role: [] for role in ROLES}
    for role, file in found.items():
        for frame, picture in zip(file.frames, pictures[role], strict=True):
            views[role].append(
                Shot(
                    picture=picture,
                    mask=None,
                    world_from_camera=file.pose(frame),
                    lens=lens_of_frame(file, frame, sizes[picture]),
                    masks=masks_of(frame, picture),
                )
            )
    listed: dict[Role, tuple[Shot, ...]] = {role: tuple(shots) for role, shots in views.items()}
    if len(found) == 1:
        listed = split_listed(first, listed["train"])
        remarks += about_unlisted(first, listed)
    points_file = _points_file(root, first)
    return Folder(
        root=root,
        views=listed,
        objects=objects,
        points=_points_in(points_file),
        has_unit=True,
        cameras=", ".join(Path(file.where).name for file in found.values()),
        points_file=points_file,
        license=license_line(first.content.get("license")),
        remarks=tuple(remarks),
    )


def _points_file(root: Path, file: Transforms | None = None) -> Path | None:
    if file is not None and isinstance(named := file.content.get("ply_file_path"), str):
        return find_file(root, relative_name(named), where=f"{file.where}.ply_file_path")
    return next((find_file(root, name, where=str(root)) for name in POINTS if (root / name).is_file()), None)


def _points_in(file: Path | None) -> Float[np.ndarray, "point 3"]:
    return np.zeros((0, 3)) if file is None else read_ply_points(file)


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
        shots.append(Shot(picture=picture, mask=None, world_from_camera=pose, lens=lens, masks=masks.of(picture)))
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
    points = colmap_points(root)
    points_file = None if len(points) else _points_file(root)
    return Folder(
        root=root,
        views=split_evenly(shots),
        objects=masks.objects,
        points=points if points_file is None else _points_in(points_file),
        has_unit=False,
        cameras="COLMAP",
        points_file=points_file,
        remarks=tuple(remarks),
    )
