"""Pictures by Blender's Cycles: of a foreign file, compared with what hyaline imports, and of hyaline's own scenes.

Cycles runs in a process of its own, since bpy brings an LLVM and a NumPy that do not go with Mitsuba's.
"""

import json
import math
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import cast

import numpy as np
from jaxtyping import Float

from benchmarks.blender_child import NOT_INSTALLED, UNREADABLE
from benchmarks.sky import radiance_of_sky
from datagen.data.cameras import Camera
from datagen.data.config import DatasetConfig, Resolution
from datagen.data.images import encode_float_exr, png_bytes, srgb_from_linear, to_8bit
from datagen.disk.errors import HyalineError
from datagen.disk.records import Json
from datagen.render.mitsuba_scene import linear_texels
from datagen.render.truth import Renderer, render_view
from datagen.scene.description import EnvironmentMap, Scene, SceneObject, image_bytes
from datagen.scene.finding import ImportChoices
from datagen.scene.images import read_map
from datagen.scene.materials import Conductor, Dielectric, Diffuse, SolidTexture
from datagen.scene.rig import make_cameras
from datagen.scene.substances import index_of
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
    size_ratio: float = 1.0
    """Largest side of what Blender read over ours: 1 where both read the same lengths."""
    told: tuple[str, ...] = ()
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


def compare_with_cycles(file: Path, choices: ImportChoices, *, python: Path, size: Resolution, spp: int) -> Compared:
    """Renders a file with both; each picture is the mean of two halves, whose difference measures the noise.

    Args:
        python: interpreter of an environment with bpy.
    """
    if file.suffix.lower() not in READ_BY_BLENDER:
        raise HyalineError(f"{file}: Blender reads {', '.join(READ_BY_BLENDER)} of what hyaline imports")
    imported = import_scene(file, choices)
    config = DatasetConfig.even(imported.scene.name, size, VIEWS)
    cameras = make_cameras(imported.scene.cameras, config)["interpolating"]
    say(f"{file.name}: rendering with hyaline")
    truth = render_view(
        Renderer(imported.scene, max_depth=MAX_DEPTH), cameras, 0, spp=spp, view_seed=1, ceiling_db=None
    )
    say(f"{file.name}: rendering with Cycles")
    ours = [item for item in imported.scene.objects if not _is_added_ground(item)]
    added = [item for item in imported.scene.objects if _is_added_ground(item)]
    points = np.concatenate([item.mesh.vertices for item in ours]).astype(np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    told = _file_to_import(file, imported, low, high)
    drawn = draw_by_cycles(imported.scene, added, [cameras[0]], python, where=file, spp=spp, file=told)
    (halves,) = drawn.halves
    noise = np.mean((srgb_from_linear(halves[0]) - srgb_from_linear(halves[1])) ** 2) / 4
    return Compared(
        name=file.name,
        ours=truth.radiance,
        cycles=np.mean(halves, axis=0),
        noise_mse=truth.noise_mse + float(noise),
        size_ratio=max(drawn.size) / float((high - low).max()),
        told=tuple(imported.told()),
    )


def _file_to_import(file: Path, imported: Imported, low: np.ndarray, high: np.ndarray) -> dict[str, Json]:
    """How Blender imports a file to where hyaline places it; `low` and `high` are corners of its box in metres."""
    scale = cast(float, imported.record["scale"])
    turned = z_up_from(cast(Axis, imported.record["up"])) @ z_up_from(READ_BY_BLENDER[file.suffix.lower()]).T
    base = [*((low + high) / 2)[:2], low[2]]
    return {"file": str(file.resolve()), "scale": scale, "linear": (scale * turned).tolist(), "base": base}


@dataclass(frozen=True, kw_only=True, eq=False)
class Drawn:
    """What Cycles drew."""

    halves: list[list[Float[np.ndarray, "h w 3"]]]
    """Two independent pictures of each camera, linear."""
    size: list[float]
    """Of the imported file in metres."""
    version: str
    """Of Blender."""


def draw_by_cycles(
    scene: Scene,
    objects: Sequence[SceneObject],
    cameras: Sequence[Camera],
    python: Path,
    *,
    where: object,
    spp: int,
    max_depth: int = MAX_DEPTH,
    seeds: Sequence[Sequence[int]] = ((0, 1),),
    file: Mapping[str, Json] = MappingProxyType({}),
) -> Drawn:
    """Two pictures by each camera of a scene's sky, some of its objects, and an imported file.

    Args:
        where: what errors name.
        spp: samples per pixel of both pictures together.
        max_depth: longest light path in segments.
        seeds: of the two pictures, by camera.
    """
    with tempfile.TemporaryDirectory(prefix="hyaline-cycles-") as folder:
        root = Path(folder)
        views = [
            {
                "world_from_camera": camera.world_from_camera.tolist(),
                "seeds": list(pair),
                "pictures": [str(root / f"{view}{half}.npy") for half in "ab"],
            }
            for view, (camera, pair) in enumerate(zip(cameras, seeds, strict=True))
        ]
        job = {
            **file,
            "objects": [_write_object(scene, item, root) for item in objects],
            "sky": str(write_sky(scene, root)),
            "views": views,
            "fov_x": cameras[0].fov_x,
            "width": cameras[0].width,
            "height": cameras[0].height,
            "spp": max(1, spp // 2),
            "max_depth": max_depth,
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
            raise HyalineError(f"{where}: Blender {does} ({last})")
        answer = json.loads((root / "answer.json").read_text())
        halves = [[np.load(picture) for picture in view["pictures"]] for view in views]
    return Drawn(halves=halves, size=answer["size"], version=answer["version"])


def _is_added_ground(item: SceneObject) -> bool:
    return any(isinstance(texture, SolidTexture) for texture in item.material.textures().values())


def _write_object(scene: Scene, item: SceneObject, root: Path) -> dict[str, Json]:
    """An object as `blender_child.py` reads it: its mesh, and inputs of Blender's node for its material."""
    mesh, material = item.mesh, item.material
    path = root / f"{item.name}.npz"
    np.savez(path, vertices=mesh.vertices, faces=mesh.faces, normals=mesh.normals, uv=mesh.uv)
    inputs: dict[str, Json] = {}
    told: dict[str, Json] = {"type": type(material).__name__, "mesh": str(path), "inputs": inputs}
    if type(material) is Dielectric and material == Dielectric(ior=material.ior, absorption=material.absorption):
        inputs |= {"IOR": index_of(material.ior), "Roughness": 0.0}
        told["absorption"] = list(material.absorption)
        return told
    if not isinstance(material, Diffuse | Conductor):
        raise HyalineError(
            f"scene {scene.name}: object {item.name} is {type(material).__name__} that Cycles lacks; expected Diffuse, "
            "Conductor, or Dielectric without tint, priority and dispersion"
        )
    if isinstance(material, Conductor):
        inputs["Roughness"] = math.sqrt(material.roughness)
    if isinstance(material.color, tuple):
        inputs["Color"] = [*material.color, 1.0]
        return told
    return told | {"image": str(write_exr(root / f"{item.name}.exr", linear_texels(scene, mesh, material.color)))}


def write_sky(scene: Scene, root: Path) -> Path:
    """The sky as Blender maps it: the middle column is +x, and the columns run clockwise seen from above."""
    sky = scene.environment
    if isinstance(sky, EnvironmentMap) and sky.rotation_deg == 0:  # Mapped alike, so that not a pixel changes.
        radiance = read_map(image_bytes(scene, sky), where=f"scene {scene.name}: {sky.path}")
        return write_exr(root / "sky.exr", radiance * np.float32(sky.scale))
    theta = (np.arange(SKY_ROWS) + 0.5)[:, None] / SKY_ROWS * np.pi
    phi = np.pi - (np.arange(2 * SKY_ROWS) + 0.5)[None, :] / SKY_ROWS * np.pi
    around = np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta))
    return write_exr(root / "sky.exr", radiance_of_sky(scene, np.stack(around, axis=-1)))


def write_exr(path: Path, image: np.ndarray) -> Path:
    """Writes linear RGB (h, w, 3) in 32 bits, and returns the path."""
    path.write_bytes(float_exr(image))
    return path


def float_exr(image: np.ndarray) -> bytes:
    """Linear RGB (h, w, 3) as an EXR of 32 bits."""
    return encode_float_exr({name: np.ascontiguousarray(image[..., i], np.float32) for i, name in enumerate("RGB")})


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
