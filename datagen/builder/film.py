"""Films through a dataset's scene: their cameras, their path-traced pictures, and a WebP or an MP4 of them."""

import dataclasses
import io
import itertools
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from datagen.builder.build import refuse_unlit
from datagen.builder.choices import FilmChoices
from datagen.builder.variants import Plan, build_variant
from datagen.data.cameras import Cameras
from datagen.data.config import SplitConfig, check_spp
from datagen.data.dataset import Dataset
from datagen.data.images import srgb_from_linear, to_8bit
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import refuse_file
from datagen.disk.storage import commit, read_regular
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.folder import open_scene
from datagen.scene.rig import cameras_within, make_path
from datagen.scene.soundness import check_cameras_outside
from datagen.terminal.command import track

Picture = UInt8[np.ndarray, "h w 3"]

ANIMATED, MOVIE = ".webp", ".mp4"
MAX_FPS = 240.0

H264 = ("-crf", "16", "-movflags", "+faststart", "-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact")
# Players take untagged pictures of 1280 pixels and more for BT.709, and ffmpeg converts to BT.601.
BT709 = ("-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_range", "tv")


def plan_film(dataset: Dataset, choices: FilmChoices, out: Path) -> Cameras:
    """The cameras of a film that can be written to `out`."""
    refuse_unlit(dataset, what="a film")
    cameras = make_path(dataset, choices.path, choices.frames, width=choices.width, height=choices.height)
    check_cameras_outside(open_scene(dataset), cameras.world_from_camera[:, :3, 3])
    check_film(out, choices.fps, overwrite=choices.overwrite)
    return cameras


def path_trace(dataset: Dataset, cameras: Cameras, *, spp: int) -> Iterator[Picture]:
    """8-bit sRGB pictures, one a camera, each with noise of its own; seeds follow the dataset's."""
    check_spp(spp)
    use_mitsuba()
    from datagen.render.truth import Renderer, derive_seed, render_view

    renderer = Renderer(open_scene(dataset), max_depth=dataset.config.max_depth)
    for view in track(range(len(cameras)), label="render", total=len(cameras)):
        seed = derive_seed(dataset.config.seed, "film", view)
        truth = render_view(renderer, cameras, view, spp=spp, view_seed=seed, ceiling_db=None)
        yield to_8bit(srgb_from_linear(truth.radiance))


def build_labelled(dataset: Dataset, cameras: Cameras, choices: FilmChoices, *, spp: int) -> Dataset:
    """The frames of a film as views of a variant, `film-PATH`, in its split `interpolating`."""
    frames = SplitConfig(views=len(cameras), spp=spp)
    plan = Plan(
        name=f"film-{choices.path}",
        config=dataclasses.replace(dataset.config, resolution=cameras.size, interpolating=frames, ceiling_db=None),
        cameras=cameras_within(open_scene(dataset), {"interpolating": cameras}),
        objects=dataset.objects,
    )
    return build_variant(dataset, plan, workers=1, overwrite=choices.overwrite)


def check_film(out: Path, fps: float, *, overwrite: bool) -> None:
    """Raises if the film cannot be written, before anything is rendered."""
    if not 0 < fps <= MAX_FPS:
        raise HyalineError(f"--fps: is {fps}; expected more than 0, at most {MAX_FPS:g} frames a second")
    if out.suffix not in (ANIMATED, MOVIE):
        raise HyalineError(f"{out}: {out.suffix!r} is no kind of film; expected {ANIMATED} or {MOVIE}")
    refuse_file(out, overwrite=overwrite)
    if out.suffix == MOVIE:
        try:
            import imageio_ffmpeg  # noqa: F401
        except ImportError:
            raise HyalineError(
                "MP4 needs the extra `video` (`pip install imageio-ffmpeg`); or let --out end in .webp"
            ) from None


def write_film(out: Path, pictures: Iterable[Picture], fps: float) -> None:
    """Writes a film of pictures of one size; call `check_film` first.

    The file gets its name when it is complete. WebP loops for ever.
    """
    if out.suffix == MOVIE:
        commit(out, _mp4_bytes(iter(pictures), fps))
    else:
        first, *others = map(Image.fromarray, pictures)
        data = io.BytesIO()
        pace = {"duration": 1000 / fps, "loop": 0}
        first.save(data, format="WEBP", save_all=True, append_images=others, quality=90, method=4, **pace)
        commit(out, data.getvalue())


def _mp4_bytes(pictures: Iterator[Picture], fps: float) -> bytes:
    """H.264 in MP4. The format needs even sizes, so odd ones are padded by a row or column."""
    import imageio_ffmpeg

    first = next(pictures)
    height, width = first.shape[:2]
    padding, size = ((0, height % 2), (0, width % 2), (0, 0)), (width + width % 2, height + height % 2)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.mp4"
        options = {"fps": fps, "codec": "libx264", "quality": None, "macro_block_size": 1}
        writer = imageio_ffmpeg.write_frames(str(path), size, **options, output_params=[*H264, *BT709])
        writer.send(None)
        for picture in itertools.chain([first], pictures):
            writer.send(np.ascontiguousarray(np.pad(picture, padding, mode="edge")))
        writer.close()
        return read_regular(path)
