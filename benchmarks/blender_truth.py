"""Blender's Cycles as a rival in rendering truth: a scene rebuilt in Blender, and pictures drawn there on demand."""

import json
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from benchmarks.blender import write_exr, write_sky
from benchmarks.blender_child import NOT_INSTALLED
from datagen.data.cameras import Camera
from datagen.disk.errors import HyalineError
from datagen.render.mitsuba_scene import linear_texels
from datagen.scene.description import RectangleLight, Scene, SceneObject
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Material, Plastic
from datagen.scene.substances import index_of
from datagen.scene.textures import ImageTexture, SolidTexture

CHILD = Path(__file__).with_name("blender_truth_child.py")

KNOWN: tuple[type[Material], ...] = (Diffuse, Plastic, Conductor, Dielectric)
"""Materials that `blender_truth_child.py` makes; frosted glass is not among them."""


class Cycles:
    """A Blender that holds a scene and one camera, in a process of its own, until it is closed.

    Meshes, uv, baked textures, sky, lamps, glass and matt surfaces are the same as ours. The base below a coat loses as
    much light as there, but on its way in as if that came from all around.
    """

    def __init__(self, scene: Scene, camera: Camera, *, python: Path, max_depth: int) -> None:
        """Starts Blender.

        Args:
            python: interpreter of an environment with bpy; it needs no hyaline.

        Raises:
            HyalineError: it has no bpy, or the scene has materials that are not rebuilt.
        """
        for item in scene.objects:
            if type(item.material) not in KNOWN:
                kinds, found = ", ".join(kind.__name__ for kind in KNOWN), type(item.material).__name__
                raise HyalineError(f"--cycles: {item.name} is {found}; only {kinds} are rebuilt in Blender")
        self.cpu_seconds = 0.0
        """Of all pictures so far, all threads."""
        self._folder = tempfile.TemporaryDirectory(prefix="hyaline-cycles-")
        root = Path(self._folder.name)
        job = {
            "objects": [_write_object(scene, item, root / str(place)) for place, item in enumerate(scene.objects)],
            "lamps": [_describe_lamp(light) for light in scene.lights],
            "sky": str(write_sky(scene, root)),
            "world_from_camera": camera.world_from_camera.tolist(),
            "fov_x": camera.fov_x,
            "width": camera.width,
            "height": camera.height,
            "spp": 1,
            "max_depth": max_depth,
        }
        (root / "job.json").write_text(json.dumps(job))
        try:
            self._child = subprocess.Popen(
                [python.absolute(), "-E", "-s", CHILD, root / "job.json"],
                cwd=root,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,  # Blender talks.
                stderr=subprocess.PIPE,
                text=True,
            )
        except OSError as error:
            self._folder.cleanup()
            raise HyalineError(f"--cycles: {python} does not run ({error.strerror}); expected an interpreter") from None
        self._python = python

    def radiance(self, *, spp: int, seed: int) -> tuple[np.ndarray, int]:
        """Linear radiance (h, w, 3), and `spp`."""
        picture = Path(self._folder.name) / "picture.npy"
        assert self._child.stdin is not None and self._child.stderr is not None
        try:
            self._child.stdin.write(json.dumps({"spp": spp, "seed": seed % (1 << 31), "picture": str(picture)}) + "\n")
            self._child.stdin.flush()
        except BrokenPipeError:
            pass  # Its last line says why.
        told = ""
        while line := self._child.stderr.readline():
            if line.startswith("drawn in "):
                self.cpu_seconds += float(line.removeprefix("drawn in "))
                return np.load(picture), spp
            told = line.strip() or told
        if self._child.wait() == NOT_INSTALLED:
            raise HyalineError(
                f"--cycles: {self._python} has no bpy; `{self._python} -m pip install bpy` brings Blender"
            )
        raise HyalineError(f"--cycles: Blender failed ({told or f'exit status {self._child.returncode}'})")

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._child.kill()
        self._child.communicate()
        self._folder.cleanup()


def _write_object(scene: Scene, item: SceneObject, root: Path) -> dict[str, object]:
    """The object's files, and its material by the words of `blender_truth_child.py`."""
    material = item.material
    root.mkdir()
    mesh = item.mesh
    np.savez(root / "mesh.npz", vertices=mesh.vertices, faces=mesh.faces, uv=mesh.uv, normals=mesh.normals)
    described: dict[str, object] = {"kind": type(material).__name__}
    if isinstance(material, Dielectric | Plastic):
        described["ior"] = index_of(material.ior)
    if isinstance(material, Plastic | Conductor):
        described["alpha"] = material.roughness
    if not isinstance(material, Dielectric):
        assert isinstance(material, Diffuse | Plastic | Conductor)
        color = material.color
        has_texels = isinstance(color, SolidTexture | ImageTexture)
        reflectance = linear_texels(scene, mesh, color) if has_texels else np.array(color)
        if isinstance(material, Plastic):
            reflectance = below_coat(reflectance, index_of(material.ior))
        if has_texels:
            described["image"] = str(write_exr(root / "color.exr", reflectance))
        else:
            described["color"] = reflectance.tolist()
    return {"name": item.name, "mesh": str(root / "mesh.npz"), "material": described}


def below_coat(color: np.ndarray, ior: float) -> np.ndarray:
    """The share of diffuse light that a base of this colour sends back through its coat, but for what the coat reflects
    on the way out; light is reflected back and forth between both.

    Source: the nonlinear `plastic` of Mitsuba's manual.
    """
    cosine = (np.arange(1000) + 0.5) / 1000
    refracted = np.sqrt(1 - (1 - cosine**2) / ior**2)
    across = (cosine - ior * refracted) / (cosine + ior * refracted)
    along = (ior * cosine - refracted) / (ior * cosine + refracted)
    # Reflectance for light from all around: half of the sum, weighted by twice the cosine.
    outside = float(np.mean((across**2 + along**2) * cosine))
    inside = 1 - (1 - outside) / ior**2
    return (1 - outside) * color / (ior**2 * (1 - inside * color))


def _describe_lamp(light: RectangleLight) -> dict[str, object]:
    u, v = np.array(light.edge_u, float), np.array(light.edge_v, float)
    return {
        "center": (np.array(light.corner) + (u + v) / 2).tolist(),
        "u": u.tolist(),
        "v": v.tolist(),
        "radiance": list(light.radiance),
    }
