"""hyaline from Python: scenes of transparent objects, path-traced datasets of them, methods that learn from these.

    scene = hy.Scene(objects=[hy.Object("vase", mesh, hy.Dielectric(ior=1.5)), ...])
    dataset = hy.build(scene, "data/vase", preset="demo")
    proxies = hy.make_proxies(dataset, "ellipsoid")
    run = hy.train("light-path", dataset, steps=500)
    hy.report([run])
    layers = hy.layers(dataset, camera)

>>> import hyaline as hy
>>> dataset = hy.open_dataset("glass_table")            # data/glass_table, or a folder
>>> view = dataset.view("interpolating", 0)
>>> view.image.shape, view.image.dtype                  # h w 3, 8-bit sRGB
((32, 32, 3), dtype('uint8'))
>>> view.layers().object_id.shape                       # layer h w, nearest first; 0 where a layer is empty
(4, 32, 32)
>>> hy.score(view.image, view.image).psnr_db
inf

Lengths are metres, +z is up, cameras are world_from_camera in the OpenGL convention. Everything is read from disk when
it is accessed, and verified by its checksum. Whatever is wrong raises a `HyalineError`, which says what to do.
PyTorch and Mitsuba are imported when something needs them.
"""

from typing import TYPE_CHECKING

from datagen.data.cameras import Camera, Cameras, look_at
from datagen.data.config import SPLITS, TEST_SPLITS, Split
from datagen.data.dataset import Dataset, View
from datagen.data.layers import Layers
from datagen.data.meshes import Mesh
from datagen.disk.errors import HyalineError
from datagen.quantities.view_quantities import LightEnds, ViewQuantities, quantities
from datagen.scene.description import CameraRig, Card, EnvironmentMap, Lobe, RectangleLight, SoftEnvironment, WalkPoint
from datagen.scene.materials import Conductor, Dielectric, Diffuse, Plastic, RoughDielectric, ThinDielectric
from datagen.scene.textures import ImageTexture, SolidTexture
from datagen.terminal.distribution import VERSION, naming_parts
from hyaline.cameras import camera_from_intrinsics, orbit
from hyaline.datasets import build, layers, list_datasets, open_dataset
from hyaline.pictures import show
from hyaline.proxies import Proxies, make_proxies
from hyaline.reports import Report, report
from hyaline.runs import Run, list_runs, open_run, train
from hyaline.scenes import Hemisphere, Object, Scene
from hyaline.scores import Scores, score

if TYPE_CHECKING:
    from hyaline.tensors import RayDataset, ViewDataset

__version__ = VERSION

__all__ = [
    "SPLITS",
    "TEST_SPLITS",
    "Camera",
    "CameraRig",
    "Cameras",
    "Card",
    "Conductor",
    "Dataset",
    "Dielectric",
    "Diffuse",
    "EnvironmentMap",
    "Hemisphere",
    "HyalineError",
    "ImageTexture",
    "Layers",
    "LightEnds",
    "Lobe",
    "Mesh",
    "Object",
    "Plastic",
    "Proxies",
    "RayDataset",
    "RectangleLight",
    "Report",
    "RoughDielectric",
    "Run",
    "Scene",
    "Scores",
    "SoftEnvironment",
    "SolidTexture",
    "Split",
    "ThinDielectric",
    "View",
    "ViewDataset",
    "ViewQuantities",
    "WalkPoint",
    "__version__",
    "build",
    "camera_from_intrinsics",
    "layers",
    "list_datasets",
    "list_runs",
    "look_at",
    "make_proxies",
    "open_dataset",
    "open_run",
    "orbit",
    "quantities",
    "report",
    "score",
    "show",
    "train",
]


def __getattr__(name: str) -> object:
    """Imports PyTorch when `RayDataset` or `ViewDataset` is accessed."""
    if name in ("RayDataset", "ViewDataset"):
        with naming_parts(f"hyaline.{name}"):
            from hyaline import tensors

        return getattr(tensors, name)
    raise AttributeError(f"module 'hyaline' has no attribute {name!r}")


def __dir__() -> list[str]:
    """The public names only, so that completion offers no modules beside the functions of the same names."""
    return __all__
