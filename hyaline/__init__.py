"""hyaline from Python: datasets of transparent objects, their views, trained runs, and scores of pictures.

>>> import hyaline
>>> dataset = hyaline.open_dataset("glass_table")       # data/glass_table, or a folder
>>> view = dataset.view("interpolating", 0)
>>> view.image.shape, view.image.dtype                  # h w 3, 8-bit sRGB
((32, 32, 3), dtype('uint8'))
>>> view.layers().object_id.shape                       # layer h w, nearest first; 0 where a layer is empty
(4, 32, 32)
>>> hyaline.score(view.image, view.image).psnr_db
inf

Lengths are metres, +z is up, cameras are world_from_camera in the OpenGL convention. Everything is read from disk when
it is asked for, and verified by its checksum. `open_run` opens a trained run, which renders what any camera sees.
PyTorch is imported by what needs it: `ViewDataset`, `RayDataset`, and a run's first picture.
"""

from typing import TYPE_CHECKING

from datagen.data.cameras import Camera, Cameras, look_at
from datagen.data.config import SPLITS, TEST_SPLITS, Split
from datagen.data.dataset import Dataset, View
from datagen.data.layers import Layers
from datagen.disk.errors import HyalineError
from datagen.quantities.view_quantities import LightEnds, ViewQuantities, quantities
from datagen.terminal.distribution import VERSION, naming_parts
from hyaline.cameras import camera_from_intrinsics, orbit
from hyaline.datasets import list_datasets, open_dataset
from hyaline.runs import Run, list_runs, open_run
from hyaline.scores import Scores, score

if TYPE_CHECKING:
    from hyaline.tensors import RayDataset, ViewDataset

__version__ = VERSION

__all__ = [
    "SPLITS",
    "TEST_SPLITS",
    "Camera",
    "Cameras",
    "Dataset",
    "HyalineError",
    "Layers",
    "LightEnds",
    "RayDataset",
    "Run",
    "Scores",
    "Split",
    "View",
    "ViewDataset",
    "ViewQuantities",
    "__version__",
    "camera_from_intrinsics",
    "list_datasets",
    "list_runs",
    "look_at",
    "open_dataset",
    "open_run",
    "orbit",
    "quantities",
    "score",
]


def __getattr__(name: str) -> object:
    """PyTorch is imported when somebody asks for what needs it."""
    if name in ("RayDataset", "ViewDataset"):
        with naming_parts(f"hyaline.{name}"):
            from hyaline import tensors

        return getattr(tensors, name)
    raise AttributeError(f"module 'hyaline' has no attribute {name!r}")
