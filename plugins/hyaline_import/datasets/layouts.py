"""Layouts of other projects' datasets with transforms files, read before any picture is decoded.

    refref         transforms_{train,val,test}.json, whose frames name masks
    openmaterial   transforms_{train,test}.json; {train,test}/mask/NAME beside {train,test}/images/NAME
    blender        transforms_{train,val,test}.json, as of NeRF's synthetic scenes
    nerfstudio     transforms.json for all pictures

Source: RefRef's data parser, OpenMaterial's loader for instant-nsr-pl, nerf-pytorch, nerfstudio's documentation.
"""

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar, get_args

import numpy as np
from jaxtyping import Float, UInt8
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError

from datagen.data.cameras import Lens
from datagen.data.config import Resolution, license_line
from datagen.data.images import mask_pixels, png_bytes
from datagen.data.transforms import Frame, Transforms, read_transforms, refuse_other_lens, relative_name
from datagen.disk.errors import HyalineError, shown
from datagen.disk.storage import check_regular, find_file, open_regular
from hyaline_import.commands import DatasetImportChoices

Role = Literal["train", "val", "test"]
ROLES: tuple[Role, ...] = get_args(Role)

Layout = Literal["refref", "openmaterial", "blender", "nerfstudio"]
"""The layouts of `read_folder`."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignView:
    """One picture and its camera."""

    picture: Path
    mask: Path | None
    """White, or 1 of 255, where the object is seen."""
    world_from_camera: Float[np.ndarray, "4 4"]
    """OpenGL convention, in the folder's units and axes."""


View = TypeVar("View", bound=ForeignView)


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignDataset:
    """Everything that a folder names."""

    root: Path
    layout: str
    """Its name in the dataset's record of its import."""
    lens: Lens
    views: dict[Role, tuple[ForeignView, ...]]
    remarks: tuple[str, ...]
    """What is left out."""
    license: str | None = None
    """The licence in its transforms file, which our exports write."""

    @property
    def files(self) -> list[Path]:
        """Every file whose content becomes a part of the dataset."""
        views = [view for role in ROLES for view in self.views[role]]
        return [part for view in views for part in (view.picture, view.mask) if part is not None]


ONE_FILE = "transforms.json"
UNKNOWN, UPRIGHT = 0, 1
"""EXIF's orientations of pictures that are shown as they are stored."""
EVERY = 8
"""Without splits in the folder, every eighth picture is for tests, as in most NeRF tools."""
FORMATS = ["PNG", "JPEG", "WEBP"]
ENDINGS = ("", ".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")


def read_folder(root: Path) -> ForeignDataset | None:
    """What a folder with transforms files names; None where it has none."""
    found = transforms_in(root)
    if not found:
        return None
    train = found["train"]
    views: dict[Role, tuple[ForeignView, ...]] = dict.fromkeys(ROLES, ())
    views |= {role: _views(root, file) for role, file in found.items()}
    layout: Layout = "blender" if views["train"][0].mask is None else "openmaterial"
    if "mask_file_path" in train.frames[0]:
        layout = "refref"
    if train.where.endswith(ONE_FILE):
        layout = "nerfstudio"
    size = _shared_size([view.picture for role in ROLES for view in views[role]])
    lens = _lens_for(size, train)
    for file in found.values():
        refuse_other_lens(_lens_for(size, file), lens, where=file.where)
    if layout == "nerfstudio":
        views = split_listed(train, views["train"])
    return ForeignDataset(
        root=root,
        layout=layout,
        lens=lens,
        views=views,
        remarks=_left_out(train, layout, views),
        license=license_line(train.content.get("license")),
    )


def transforms_in(root: Path) -> dict[Role, Transforms]:
    """The transforms files of a folder by role; a single one for all pictures is that of training."""
    names: dict[Role, str] = {role: f"transforms_{role}.json" for role in ROLES}
    names = {role: name for role, name in names.items() if (root / name).is_file()}
    if "train" not in names:
        names = {"train": ONE_FILE} if (root / ONE_FILE).is_file() else {}
    return {role: read_transforms(find_file(root, name, where=str(root))) for role, name in names.items()}


def _shared_size(pictures: Sequence[Path]) -> Resolution:
    """The size of all pictures."""
    sizes = [Resolution(width=width, height=height) for width, height in map(picture_size, pictures)]
    for picture, size in zip(pictures, sizes, strict=True):
        if size != sizes[0]:
            raise HyalineError(f"{picture}: is {size} pixels; expected {sizes[0]}, as {pictures[0]}")
    return sizes[0]


def _lens_for(size: Resolution, file: Transforms) -> Lens:
    """The lens of all frames, for pictures as large as they are now: they may have been made smaller."""
    lens = file.shared_lens((size.width, size.height))
    if abs(lens.height * size.width / lens.width - size.height) > 0.5:
        raise HyalineError(f"{file.where}: w and h are {lens.width} x {lens.height}; expected {size}, as the pictures")
    return lens.fitted(size)


def find_named(root: Path, frame: Frame, key: str) -> Path:
    """The file that a frame names, with or without its ending."""
    where, name = f"{frame.where}.{key}", frame.file(key)
    for ending in ENDINGS:
        path = find_file(root, name + ending, where=where)
        if path.is_file():
            return path
    raise HyalineError(f"{where}: names {shown(name)}, which is not in {root}; download the whole scene")


def picture_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture, by its header."""
    with header(path) as picture:
        return picture.size


@contextmanager
def header(path: Path) -> Iterator[Image.Image]:
    """The picture or mask of a file, not decoded.

    Raises:
        HyalineError: it is stored on its side: tools differ on whether they turn it before they find cameras.
    """
    try:
        with open_regular(path) as file, Image.open(file, formats=FORMATS) as picture:
            turn = picture.getexif().get(ExifTags.Base.Orientation, UPRIGHT)
            if turn not in (UNKNOWN, UPRIGHT):
                raise HyalineError(
                    f"{path}: is stored turned or mirrored (EXIF orientation {turn}), which some tools undo and others "
                    "do not; turn the pixels (`mogrify -auto-orient`) before masks and cameras are made, or, if these "
                    "fit the stored pixels, delete the tag (`exiftool -Orientation=`)"
                )
            yield picture
    except HyalineError:
        raise
    # Pillow answers a broken file with many kinds of exception (OSError, SyntaxError, ValueError, struct.error, ...).
    except Exception as error:
        is_other = isinstance(error, UnidentifiedImageError)
        what = "no PNG, JPEG or WebP" if is_other else f"{type(error).__name__}: {error}".replace("\n", " ")
        raise HyalineError(f"{path}: not a picture that can be read ({what})") from error


def _views(root: Path, file: Transforms) -> tuple[ForeignView, ...]:
    views = []
    for frame in file.frames:
        picture = find_named(root, frame, "file_path")
        mask = picture.parent.parent / "mask" / picture.name  # As in OpenMaterial.
        if "mask_file_path" in frame:
            mask = find_named(root, frame, "mask_file_path")
        elif mask.is_file() and mask.is_relative_to(root):
            check_regular(mask, root, where=frame.where)
        else:
            mask = None
        views.append(ForeignView(picture=picture, mask=mask, world_from_camera=file.pose(frame)))
    return tuple(views)


def split_listed(file: Transforms, views: Sequence[View]) -> dict[Role, tuple[View, ...]]:
    """The views of one file by role: by its lists of names (`train_filenames`), or else every eighth for tests."""
    if f"{ROLES[0]}_filenames" not in file.content:
        # Every eighth view, starting with the first, is for tests.
        train = tuple(view for place, view in enumerate(views) if place % EVERY)
        return {"train": train, "val": (), "test": tuple(views[::EVERY])}
    paths = [frame.file("file_path") for frame in file.frames]
    found: dict[Role, tuple[View, ...]] = {}
    for role in ROLES:
        named = file.content.get(f"{role}_filenames", [])
        if not isinstance(named, list):
            raise HyalineError(f"{file.where}: {role}_filenames is {shown(named)}; expected a list of names")
        wanted = {relative_name(str(name)) for name in named}
        found[role] = tuple(view for view, path in zip(views, paths, strict=True) if path in wanted)
    return found


def about_unlisted(file: Transforms, found: Mapping[Role, Sequence[ForeignView]]) -> list[str]:
    """A line if the lists of a file leave out some of its views."""
    count = len(file.frames) - len({view for role in ROLES for view in found[role]})
    return [f"splits: {count} of {len(file.frames)} pictures are in none of the file's lists; left out"] * bool(count)


def _left_out(train: Transforms, layout: Layout, views: dict[Role, tuple[ForeignView, ...]]) -> tuple[str, ...]:
    lines = []
    first = train.frames[0]
    if "depth_file_path" in first:
        lines.append("depth: is not imported")
    if layout == "openmaterial":
        lines.append("masks: show the object, which is taken for glass")
    if "mask_path" in first:
        lines.append("mask_path: selects what nerfstudio trains on, not glass; left out")
    if layout == "nerfstudio" and f"{ROLES[0]}_filenames" not in train.content:
        lines.append(f"splits: the file has none; each {EVERY}th picture is for tests")
    if layout == "nerfstudio":
        lines += about_unlisted(train, views)
    has_masks = [view.mask is not None for role in ROLES for view in views[role]]
    if any(has_masks) and not all(has_masks):
        lines.append(f"masks: {has_masks.count(False)} of {len(has_masks)} pictures have none; all were left out")
    return tuple(lines)


BACKGROUND = {"white": 255.0, "black": 0.0}
EIGHT_BITS = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "CMYK", "YCbCr")


def view_files(
    view: ForeignView, size: Resolution, choices: DatasetImportChoices, *, has_mask: bool
) -> dict[str, bytes]:
    """The files of a view, by ending."""
    wanted = size.width, size.height
    files = {".png": png_bytes(on_background(opened(view.picture, wanted), view.picture, choices.background))}
    if has_mask and view.mask is not None:
        files[".mask.png"] = png_bytes(np.where(mask_pixels(opened(view.mask, wanted)), 255, 0).astype(np.uint8))
    return files


def on_background(
    picture: Image.Image, path: Path, background: Literal["white", "black"]
) -> UInt8[np.ndarray, "h w 3"]:
    """An 8-bit picture over its background, in sRGB whatever its profile; mixed in sRGB as NeRF's tools do it."""
    if picture.mode not in EIGHT_BITS:
        raise HyalineError(f"{path}: has pixels of kind {picture.mode}; expected 8 bits a channel, sRGB")
    rgba = np.asarray(_in_srgb(picture, path))
    alpha = rgba[..., 3:].astype(np.float64) / 255
    return np.rint(rgba[..., :3] * alpha + BACKGROUND[background] * (1 - alpha)).astype(np.uint8)


def _in_srgb(picture: Image.Image, path: Path) -> Image.Image:
    """RGBA in sRGB; a picture may have another profile, such as the Display P3 of phones."""
    rgba = picture.convert("RGBA")
    if not (icc := picture.info.get("icc_profile")):
        return rgba
    mode = {b"GRAY": "L", b"CMYK": "CMYK"}.get(icc[16:20], "RGB")  # The pixels that the profile is for.
    pixels = rgba.convert("RGB") if mode == "RGB" else picture.convert(mode)
    try:
        profile = ImageCms.ImageCmsProfile(io.BytesIO(icc))
        converted = ImageCms.profileToProfile(pixels, profile, ImageCms.createProfile("sRGB"), outputMode="RGB")
    except (OSError, ImageCms.PyCMSError) as error:
        raise HyalineError(f"{path}: has a colour profile that cannot be used ({error}); convert it to sRGB") from None
    assert converted is not None, "None is for pictures that are changed in place"
    converted.putalpha(rgba.getchannel("A"))
    return converted


def opened(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
    """The picture of a file; nothing is decoded of one that has not the width and height it should have."""
    with header(path) as picture:
        if size is not None and picture.size != size:
            raise HyalineError(f"{path}: is {picture.width} x {picture.height} pixels; expected {size[0]} x {size[1]}")
        picture.load()
        return picture
