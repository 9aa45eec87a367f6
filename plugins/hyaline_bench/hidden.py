"""Hidden tests: scenes of a secret seed, published without the pictures that score a method.

A verifier keeps a secret text. The seed of hidden scene K follows from the SHA-256 of `hyaline-bench VERSION SECRET K`,
and families take turns with K, as in public scenes. Two datasets are made from that of the scene, with the same head
and so the same digest:

    public/hidden-K    what participants get: training pictures, all cameras and layers, meshes, materials of glass
    truth/hidden-K     the same with the pictures of the test splits and masks of where light meets glass; stays with
                       the verifier

With light and colours, anybody could path-trace the truth. Both have grey colours and sky, no lamps, no seed.
"""

import dataclasses
import hashlib
import os
import secrets
import shutil
from pathlib import Path

from datagen.data.cameras import Cameras
from datagen.data.config import DatasetConfig, Split
from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.data.variants import EDIT_MASKS_FOLDER, variant_root
from datagen.data.writing import commit_view, head_contents, write_head
from datagen.disk.errors import HyalineError
from datagen.disk.ownership import DATASET, holding
from datagen.disk.storage import read_promised, read_regular, sha256
from datagen.scene.description import Scene, SoftEnvironment
from datagen.scene.folder import open_scene, scene_files
from datagen.scene.materials import Diffuse, Plastic
from datagen.terminal.command import choose, say
from hyaline_bench.protocol import NO_GLASS, Protocol, glass_masks, is_of_preset

GREY = (0.5, 0.5, 0.5)
SECRET_BYTES = 32


def read_secret(path: Path) -> str:
    """The secret in a file, which is drawn if the file is missing; only its owner may read it."""
    if not os.path.lexists(path):
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
            file.write(secrets.token_hex(SECRET_BYTES) + "\n")
    secret = read_regular(path, at_most=1 << 10).decode("ascii", errors="replace").strip()
    if len(secret) < 2 * SECRET_BYTES:
        raise HyalineError(f"{path}: has {len(secret)} characters; expected a secret of {2 * SECRET_BYTES} or more")
    return secret


def hidden_seed(secret: str, place: int, protocol: Protocol) -> int:
    """The seed of a hidden scene."""
    digest = hashlib.sha256(f"hyaline-bench {protocol.version} {secret} {place}".encode()).digest()
    return int.from_bytes(digest[:8]) % 2**63


def hidden_names(preset: str, protocol: Protocol) -> list[str]:
    """The names of a preset's hidden scenes.

    Raises:
        HyalineError: it has none.
    """
    if not (names := protocol.hidden_scenes(preset)):
        raise HyalineError(f"{preset} has no hidden scenes; expected small, demo or standard")
    return names


def verifier_commands(secret: str, preset: str, protocol: Protocol) -> list[str]:
    """The commands that build the hidden scenes of a preset, and split each into both datasets."""
    lines = []
    for place, name in enumerate(protocol.hidden_scenes(preset)):
        scene = protocol.random_name(place, hidden_seed(secret, place, protocol))
        source = f"secret/{name}-{preset}"
        lines += [
            protocol.build_command(scene, preset, source),
            f"datagen add {source} --edit {NO_GLASS}",
            f"hyaline-bench hide {source} --scene {name}",
        ]
    return lines


def hide_truth(source: Dataset, name: str, out: Path, protocol: Protocol) -> tuple[Path, Path]:
    """Makes the public dataset and that of the verifier from a dataset; returns their folders in `out`.

    Args:
        name: what the scene is called from now on, such as hidden-0.
    """
    from datagen.builder.build import peel_dataset  # With a ray tracer, which scoring does not need.

    preset = source.config.preset
    choose("scene", name, hidden_names(preset, protocol))
    if source.imported is not None or source.parent is not None:
        raise HyalineError(f"{source.root}: is imported, or a variant; expected what `datagen build` made")
    published = dataclasses.replace(source.config, scene=name, seed=0)
    is_of_preset(dataclasses.replace(source, config=published), preset, protocol)
    masks = glass_masks(source)
    scene = open_scene(source)
    files = scene_files(without_colours(scene, name))
    num_layers = source.layer_store().head.num_layers
    public, truth = (out / kind / f"{name}-{preset}" for kind in ("public", "truth"))
    for root, is_truth in ((public, False), (truth, True)):
        with holding(root, DATASET):
            made = _write(root, source, published, files, is_truth=is_truth)
        peel_dataset(made, TRUTH, num_layers=num_layers, overwrite=False)
        if is_truth:
            shutil.copytree(masks, variant_root(root, NO_GLASS) / EDIT_MASKS_FOLDER, dirs_exist_ok=True)
        say(f"{root}: dataset {made.seal[:12]}, {'with' if is_truth else 'without'} the truth of its test views")
    return public, truth


def without_colours(scene: Scene, name: str) -> Scene:
    """The scene under another name, with grey diffuse colours, a grey sky, and no lamps."""
    objects = tuple(
        dataclasses.replace(item, material=dataclasses.replace(item.material, color=GREY))
        if isinstance(item.material, Diffuse | Plastic)
        else item
        for item in scene.objects
    )
    sky = SoftEnvironment(zenith=GREY, horizon=GREY, ground=GREY)
    return dataclasses.replace(scene, name=name, description="", objects=objects, environment=sky, lights=())


def _write(root: Path, source: Dataset, config: DatasetConfig, scene: dict[str, bytes], *, is_truth: bool) -> Dataset:
    cameras: dict[Split, Cameras] = {split: source.cameras(split) for split in source.splits}
    made = write_head(root, config, source.objects, cameras, scene, stated_license=source.stated_license)
    if made.files != {path: sha256(data) for path, data in head_contents(scene, cameras).items()}:
        raise HyalineError(f"{root}: holds another scene; choose another --out, or delete it")
    kept: list[Split] = [split for split in source.splits if is_truth or split == "train"]
    for split in kept:
        for view in source.views(split):
            record = view.record
            data = {
                Path(path).suffix: read_promised(source.root, path, digest) for path, digest in record.files.items()
            }
            commit_view(
                made,
                split,
                view.index,
                data,
                seed=0,
                spp=record.spp,
                noise_mse=record.noise_mse,
                variant=record.variant,
            )
    return made
