"""Makes the double of a captured scene: like it, but path-traced, so that its glass is known to the last digit.

    python examples/synthetic_double.py shot      # data/shot and its fit -> double, a scene, and double-shots
    datagen capture double-shots --diameter 50mm
    datagen peel double-shots
    model fit double-shots                        # fit.json beside that of the original

The double has the captured room, with the mean colours of its pictures as diffuse textures, the fitted glass, and the
same cameras. Its pictures get what those of a phone have: other exposures and white balances, darker corners, noise,
JPEG; its masks get soft and slightly wrong edges. Cameras are left out, so that `datagen capture` has to find them.
"""

import argparse
import dataclasses
import io
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

import hyaline
from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.images import linear_from_srgb, png_bytes, srgb_from_linear, to_8bit
from datagen.scene.description import SoftEnvironment
from datagen.scene.folder import open_scene, save_scene
from datagen.scene.materials import Diffuse, ImageTexture

LIFT = 0.001
"""Metres by which glass is moved up."""
TEXELS = 512
"""Along a side of each texture."""
WHITE = (1.0, 1.0, 1.0)
EXPOSURE, BALANCE, FALLOFF = 0.1, 0.013, 0.07
"""Standard deviations of the logarithms of brightness and channels, and how much darker corners are: as measured in
photographs by a phone."""
NOISE = 0.01
"""Standard deviation, of sRGB in [0, 1]."""
EDGE = 0.7
"""Standard deviation in pixels by which edges of masks are off."""
QUALITY = 92
"""Of the JPEG files."""


def main() -> None:
    parser = argparse.ArgumentParser(description="Make a path-traced double of a captured scene, and its photographs.")
    parser.add_argument("dataset", help="a captured dataset with a fit: a folder, or a name under data/")
    parser.add_argument("--width", type=int, default=500, help="of the pictures in pixels; default: 500")
    parser.add_argument("--spp", type=int, default=64, help="samples a pixel; default: 64")
    choices = parser.parse_args()
    dataset = hyaline.open_dataset(choices.dataset)
    make_scene(dataset, Path("double"))
    lens = dataset.config.resolution
    size = f"{choices.width}x{round(choices.width * lens.height / lens.width)}"
    shutil.rmtree("double-shots", ignore_errors=True)
    samples = ("--spp", str(choices.spp), "--test-spp", str(choices.spp))
    call("build", "--scene", "double", "--resolution", size, *samples)
    call("export", "double", "--format", "capture", "--out", "double-shots")
    spoil(Path("double-shots"))
    print("double-shots")


def call(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "datagen", *words], check=True)


def make_scene(dataset: Dataset, folder: Path) -> None:
    """Writes the scene of a captured dataset, with fitted glass and textures from its pictures."""
    scene, meshes = open_scene(dataset, "fitted"), read_meshes(dataset, "fitted")
    colors = bake(dataset)
    objects, files = [], {}
    for place, (item, mesh) in enumerate(zip(scene.objects, meshes, strict=True), start=1):
        material = item.material
        if not material.is_glass:
            path = f"textures/{item.name}.png"
            files[path] = png_bytes(to_8bit(srgb_from_linear(colors[place])))
            material = Diffuse(color=ImageTexture(path=path))
        else:  # Or it would touch what it stands on.
            mesh = dataclasses.replace(mesh, vertices=mesh.vertices + np.float32([0, 0, LIFT]))
        if len(mesh.faces):
            objects.append(dataclasses.replace(item, mesh=mesh, material=material))
    light = SoftEnvironment(zenith=WHITE, horizon=WHITE, ground=WHITE)
    double = dataclasses.replace(scene, name="double", objects=tuple(objects), environment=light, baked=files)
    shutil.rmtree(folder, ignore_errors=True)
    save_scene(double, folder)


def bake(dataset: Dataset) -> dict[int, np.ndarray]:
    """The mean linear colour of the pixels that see each texel first, by object id; holes take the nearest one."""
    sums = {place: np.zeros((TEXELS, TEXELS, 4), np.float32) for place in range(1, len(dataset.objects) + 1)}
    for view in dataset.views("train"):
        layers = view.layers("fitted")
        linear = np.dstack([linear_from_srgb(view.image / np.float32(255)), np.ones(view.image.shape[:2], np.float32)])
        first, uv = layers.object_id[0], layers.uv[0] / 65535
        row, column = (np.clip((TEXELS * each).astype(int), 0, TEXELS - 1) for each in (1 - uv[..., 1], uv[..., 0]))
        for place in np.unique(first[first > 0]).tolist():
            is_on = first == place
            np.add.at(sums[place], (row[is_on], column[is_on]), linear[is_on])
    colors = {}
    for place, total in sums.items():
        is_seen = total[..., 3] > 0
        nearest = ndimage.distance_transform_edt(~is_seen, return_distances=False, return_indices=True)
        mean = total[..., :3] / np.maximum(total[..., 3:], 1)
        colors[place] = mean[tuple(nearest)] if is_seen.any() else np.full_like(mean, 0.5)
    return colors


def spoil(folder: Path) -> None:
    """Makes exact pictures and masks as those of a phone and a segmentation network."""
    rng = np.random.default_rng(0)
    for path in sorted((folder / "images").iterdir()):
        linear = linear_from_srgb(np.asarray(Image.open(path).convert("RGB"), np.float32) / 255)
        height, width = linear.shape[:2]
        rows, columns = np.indices((height, width)) + 0.5
        radii = ((rows - height / 2) ** 2 + (columns - width / 2) ** 2) / ((height**2 + width**2) / 4)
        gain = np.exp(EXPOSURE * rng.standard_normal() + BALANCE * rng.standard_normal(3))
        taken = srgb_from_linear(np.clip(linear * gain * (1 - FALLOFF * radii[..., None]), 0, 1))
        taken = taken + NOISE * rng.standard_normal(taken.shape)
        data = io.BytesIO()
        Image.fromarray(to_8bit(np.clip(taken, 0, 1))).save(data, "JPEG", quality=QUALITY)
        path.unlink()
        path.with_suffix(".jpg").write_bytes(data.getvalue())
    for drink in sorted((folder / "masks").glob("*_drink")):  # Networks mask a glass and what it holds as one.
        for path in sorted(drink.iterdir()):
            glass = drink.with_name(drink.name.removesuffix("_drink")) / path.name
            both = np.maximum(*(np.asarray(Image.open(each).convert("L")) for each in (glass, path)))
            Image.fromarray(both).save(glass)
        shutil.rmtree(drink)
    for path in sorted((folder / "masks").rglob("*.png")):
        inside = np.asarray(Image.open(path).convert("L")) > 127
        distance = ndimage.distance_transform_edt(inside) - ndimage.distance_transform_edt(~inside)
        off = ndimage.gaussian_filter(rng.standard_normal(inside.shape), 4)
        wrong = distance + EDGE * off / max(off.std(), 1e-9)
        Image.fromarray(np.where(inside.any() & (wrong > 0), 255, 0).astype(np.uint8)).save(path)
    for file in folder.glob("transforms*.json"):
        file.unlink()


if __name__ == "__main__":
    main()
