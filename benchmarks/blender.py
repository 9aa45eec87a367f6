"""A foreign file imported and drawn by hyaline, and by Blender, with one camera, sky and ground.

Blender's Cycles is the judge of what an import makes of materials and meshes. It runs in a process of its own, since
bpy brings an LLVM and a NumPy that do not go with Mitsuba's.
"""

import json
import math
import subprocess
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from jaxtyping import Float

from benchmarks.blender_child import NOT_INSTALLED, UNREADABLE
from benchmarks.sky import radiance_of_sky
from datagen.data.cameras import Camera
from datagen.data.config import DatasetConfig, Resolution
from datagen.data.images import encode_float_exr, png_bytes, srgb_from_linear, to_8bit
from datagen.disk.errors import HyalineError
from datagen.render.mitsuba_scene import linear_texels
from datagen.render.truth import Renderer, render_view
from datagen.scene.description import Scene, SceneObject
from datagen.scene.finding import ImportChoices
from datagen.scene.materials import SolidTexture
from datagen.scene.rig import make_cameras
from datagen.terminal.command import say
from hyaline_import.foreign import Axis, z_up_from
from hyaline_import.importing import Imported, import_scene

CHILD = Path(__file__).with_name("blender_child.py")
READ_BY_BLENDER: dict[str, Axis] = {".glb": "y", ".gltf": "y", ".obj": "z", ".ply": "z", ".stl": "z"}
"""Endings, and the axis that `blender_child.py` leaves pointing up where the file's y (its own z) does."""
SKY_ROWS = 1024
MAX_DEPTH = 32
VIEWS = 8
"""Number of cameras around the scene; one of them is used."""
GAIN = 4
"""By which the difference picture is stronger than the difference."""
TIMEOUT_S = 3600


@dataclass(frozen=True, kw_only=True, eq=False)
class Compared:
    """Two pictures of one file, linear."""

    name: str
    ours: Float[np.ndarray, "h w 3"]
    cycles: Float[np.ndarray, "h w 3"]
    noise_mse: float
    """Mean squared error in sRGB that noise alone makes, of both together."""
    size_ratio: float
    """Largest side of what Blender read over ours: 1 where both read the same lengths."""
    told: list[str]
    """Messages of the import."""

    @property
    def psnr_db(self) -> float:
        return _decibels(float(np.mean((srgb_from_linear(self.ours) - srgb_from_linear(self.cycles)) ** 2)))

    @property
    def floor_db(self) -> float:
        """PSNR in dB of two correct pictures with this noise."""
        return _decibels(self.noise_mse)

    @property
    def mean_ratios(self) -> np.ndarray:
        """Our mean radiance over that of Cycles, by channel."""
        return self.ours.mean(axis=(0, 1)) / np.maximum(self.cycles.mean(axis=(0, 1)), 1e-9)


def compare_with_cycles(
    file: Path, choices: ImportChoices, *, python: Path, view: int, size: Resolution, spp: int
) -> Compared:
    """Renders a file with both; each picture is the mean of two halves, whose difference measures the noise.

    Args:
        python: interpreter of an environment with bpy.
        view: which camera of those all around.
    """
    if file.suffix.lower() not in READ_BY_BLENDER:
        raise HyalineError(f"{file}: Blender reads {', '.join(READ_BY_BLENDER)} of what hyaline imports")
    imported = import_scene(file, choices)
    config = DatasetConfig.even(imported.scene.name, size, VIEWS)
    cameras = make_cameras(imported.scene.cameras, config)["interpolating"]
    say(f"{file.name}: rendering with hyaline")
    truth = render_view(
        Renderer(imported.scene, max_depth=MAX_DEPTH), cameras, view, spp=spp, view_seed=1, ceiling_db=None
    )
    say(f"{file.name}: rendering with Cycles")
    halves, size_ratio = _drawn_by_cycles(file, imported, cameras[view], python, spp)
    noise = np.mean((srgb_from_linear(halves[0]) - srgb_from_linear(halves[1])) ** 2) / 4
    return Compared(
        name=file.name,
        ours=truth.radiance,
        cycles=np.mean(halves, axis=0),
        noise_mse=truth.noise_mse + float(noise),
        size_ratio=size_ratio,
        told=imported.told(),
    )


def _drawn_by_cycles(
    file: Path, imported: Imported, camera: Camera, python: Path, spp: int
) -> tuple[list[np.ndarray], float]:
    """Two independent pictures, and the size of what Blender read over that of our scene."""
    ours = [item for item in imported.scene.objects if not _is_added_ground(item)]
    points = np.concatenate([item.mesh.vertices for item in ours]).astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    with tempfile.TemporaryDirectory(prefix="hyaline-cycles-") as folder:
        root = Path(folder)
        pictures = [root / f"{half}.npy" for half in "ab"]
        scale = cast(float, imported.record["scale"])
        turned = z_up_from(cast(Axis, imported.record["up"])) @ z_up_from(READ_BY_BLENDER[file.suffix.lower()]).T
        job = {
            "file": str(file.resolve()),
            "scale": scale,
            "linear": (scale * turned).tolist(),
            "base": [*((low + high) / 2)[:2], low[2]],
            "ground": _write_ground(imported.scene, root),
            "sky": str(write_sky(imported.scene, root)),
            "world_from_camera": camera.world_from_camera.tolist(),
            "fov_x": camera.fov_x,
            "width": camera.width,
            "height": camera.height,
            "spp": max(1, spp // 2),
            "max_depth": MAX_DEPTH,
            "pictures": list(map(str, pictures)),
        }
        (root / "job.json").write_text(json.dumps(job))
        command = [str(python.absolute()), "-I", str(CHILD), str(root / "job.json"), str(root / "answer.json")]
        try:
            done = subprocess.run(command, capture_output=True, text=True, cwd=root, check=False, timeout=TIMEOUT_S)
        except OSError as error:
            raise HyalineError(f"--python: {python} does not run ({error.strerror}); expected an interpreter") from None
        if done.returncode == NOT_INSTALLED:
            raise HyalineError(f"--python: {python} has no bpy; `{python} -m pip install bpy` brings Blender")
        if done.returncode:
            last = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
            does = "cannot import it" if done.returncode == UNREADABLE else "failed"
            raise HyalineError(f"{file}: Blender {does} ({last})")
        answer = json.loads((root / "answer.json").read_text())
        halves = [np.load(picture) for picture in pictures]
    return halves, max(answer["size"]) / float((high - low).max())


def _is_added_ground(item: SceneObject) -> bool:
    return any(isinstance(texture, SolidTexture) for texture in item.material.textures().values())


def _write_ground(scene: Scene, root: Path) -> dict | None:
    """The ground that hyaline added, and its pattern as the image that hyaline draws."""
    added = next((item for item in scene.objects if _is_added_ground(item)), None)
    if added is None:
        return None
    (pattern,) = added.material.textures().values()
    assert isinstance(pattern, SolidTexture)
    image = root / "ground.exr"
    write_exr(image, linear_texels(scene, added.mesh, pattern))
    arrays = {"vertices": added.mesh.vertices, "faces": added.mesh.faces, "uv": added.mesh.uv}
    return {"image": str(image), **{name: values.tolist() for name, values in arrays.items()}}


def write_sky(scene: Scene, root: Path) -> Path:
    """The sky as Blender maps it: the middle column is +x, and the columns run clockwise seen from above."""
    theta = (np.arange(SKY_ROWS) + 0.5)[:, None] / SKY_ROWS * np.pi
    phi = np.pi - (np.arange(2 * SKY_ROWS) + 0.5)[None, :] / SKY_ROWS * np.pi
    around = np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
    return write_exr(root / "sky.exr", radiance_of_sky(scene, np.stack(around, axis=-1)))


def write_exr(path: Path, image: np.ndarray) -> Path:
    """Writes linear RGB (h, w, 3) in 32 bits, and returns the path."""
    channels = {name: np.ascontiguousarray(image[..., i], np.float32) for i, name in enumerate("RGB")}
    path.write_bytes(encode_float_exr(channels))
    return path


def cycles_table(rows: dict[str, Compared | str]) -> str:
    """A line for each file: what was compared, or why it could not be."""
    lines = [
        "| file | to Cycles, dB | noise alone, dB | below the noise, dB | mean light, ours / Cycles (R G B) | size |",
        "|---|---:|---:|---:|---|---:|",
    ]
    for name, row in rows.items():
        if isinstance(row, str):
            lines.append(f"| {name} | | | | {row} | |")
            continue
        ratios = " ".join(f"{ratio:.2f}" for ratio in row.mean_ratios)
        lines.append(
            f"| {name} | {row.psnr_db:.1f} | {row.floor_db:.1f} | {row.floor_db - row.psnr_db:.1f} | {ratios} "
            f"| {row.size_ratio:.3f} |"
        )
    return "\n".join(lines)


def sheet_bytes(compared: Compared) -> bytes:
    """A PNG: hyaline's picture, that of Cycles, and grey plus `GAIN` times their difference."""
    ours, cycles = srgb_from_linear(compared.ours), srgb_from_linear(compared.cycles)
    return png_bytes(to_8bit(np.concatenate([ours, cycles, 0.5 + GAIN * (ours - cycles)], axis=1)))


def _decibels(mse: float) -> float:
    return -10 * math.log10(max(mse, 1e-12))
