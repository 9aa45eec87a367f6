"""Blender's Cycles as a rival in rendering truth: a scene rebuilt in Blender, and pictures drawn there on demand."""

# Mitsuba's stubs describe no variant: what is a number in one is an array in another.
# pyright: reportArgumentType=false

import json
import subprocess
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

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
    """A Blender that holds a scene and one camera, in a process of its own; `open_cycles` starts and ends it."""

    def __init__(self, child: "subprocess.Popen[str]", picture: Path, python: Path) -> None:
        self.cpu_seconds = 0.0
        """Processor time of all threads over all pictures drawn so far."""
        self._child, self._picture, self._python = child, picture, python

    def radiance(self, *, spp: int, seed: int) -> tuple[np.ndarray, int]:
        """Linear radiance (h, w, 3), and `spp`.

        Raises:
            HyalineError: the interpreter has no bpy, or Blender failed.
        """
        assert self._child.stdin is not None and self._child.stderr is not None
        asked = {"spp": spp, "seed": seed % (1 << 31), "picture": str(self._picture)}
        try:
            self._child.stdin.write(json.dumps(asked) + "\n")
            self._child.stdin.flush()
        except BrokenPipeError:
            pass  # The process has ended, and what it printed last says why.
        told = ""
        while line := self._child.stderr.readline():
            if line.startswith("drawn in "):
                self.cpu_seconds += float(line.removeprefix("drawn in "))
                return np.load(self._picture), spp
            told = line.strip() or told
        if self._child.wait() == NOT_INSTALLED:
            raise HyalineError(
                f"--cycles: {self._python} has no bpy; `{self._python} -m pip install bpy` brings Blender"
            )
        raise HyalineError(f"--cycles: Blender failed ({told or f'exit status {self._child.returncode}'})")


@contextmanager
def open_cycles(scene: Scene, camera: Camera, *, python: Path, max_depth: int) -> Iterator[Cycles]:
    """Blender with a scene, until the block is left.

    Meshes, uv, baked textures, sky, lamps, glass and matt surfaces are the same as ours. Plastic is approximate: the
    coat's loss of incoming light is averaged over all directions. Call `use_mitsuba` first.

    Args:
        python: interpreter of an environment with bpy; it needs no hyaline.

    Raises:
        HyalineError: it does not run, or the scene has materials that are not rebuilt.
    """
    for item in scene.objects:
        if type(item.material) not in KNOWN:
            kinds, found = ", ".join(kind.__name__ for kind in KNOWN), type(item.material).__name__
            raise HyalineError(f"--cycles: {item.name} is {found}; only {kinds} are rebuilt in Blender")
    with tempfile.TemporaryDirectory(prefix="hyaline-cycles-") as folder:
        root = Path(folder)
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
            child = subprocess.Popen(
                # Not -I, since the child imports the file beside it.
                [python.absolute(), "-E", "-s", CHILD, root / "job.json"],
                cwd=root,
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,  # Blender's own messages.
                stderr=subprocess.PIPE,
                text=True,
            )
        except OSError as error:
            raise HyalineError(f"--cycles: {python} does not run ({error.strerror}); expected an interpreter") from None
        try:
            yield Cycles(child, root / "picture.npy", python)
        finally:
            child.kill()
            child.communicate()


def _write_object(scene: Scene, item: SceneObject, root: Path) -> dict[str, object]:
    """Writes the object's files, and describes its material as `blender_truth_child.py` expects it."""
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
    """The diffuse reflectance of a base of this colour below a clear coat, for light from all directions.

    Includes interreflection between base and coat, but not the coat's Fresnel loss towards the viewer, which depends on
    the angle. Call `use_mitsuba` first. Source: Mitsuba's documentation of `plastic`, nonlinear.
    """
    import mitsuba as mi

    outside = np.array(mi.fresnel_diffuse_reflectance(mi.Float(ior)), float).item()
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
