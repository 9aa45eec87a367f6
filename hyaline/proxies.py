"""Proxies of a dataset: coarse closed meshes that stand in for its objects."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from datagen.data.dataset import Dataset
from datagen.data.meshes import Mesh
from datagen.data.paths import PROXY_KINDS
from datagen.disk.checked import checked
from datagen.terminal.parsing import choose
from datagen.terminal.plugins import naming_parts
from hyaline.datasets import NUM_LAYERS, open_dataset

if TYPE_CHECKING:
    from proxies.make import ProxyReport


@dataclass(frozen=True, kw_only=True, eq=False)
class Proxies:
    """The proxies of one geometry; `make_proxies` makes them."""

    dataset: Dataset
    geometry: str
    """The name to train with: `train(..., geometry=proxies.geometry)`."""
    reports: "tuple[ProxyReport, ...]" = field(repr=False)
    """For each object: kind, number of triangles, volume ratio, distances, and any problem of its proxy."""

    @property
    def meshes(self) -> tuple[Mesh, ...]:
        """One for each object, in the dataset's order."""
        from datagen.data.geometries import read_meshes

        return read_meshes(self.dataset, self.geometry)


@checked
@naming_parts("proxies")
def make_proxies(
    dataset: Dataset | Path | str,
    kind: str = "ellipsoid",
    *,
    num_layers: int = NUM_LAYERS,
    workers: int = 1,
    overwrite: bool = False,
) -> Proxies:
    """Fits a proxy to every object and peels the proxies for every view; images are not rendered again.

        proxies = hyaline.make_proxies(dataset, "ellipsoid")
        run = hyaline.train("paper", dataset, geometry=proxies.geometry)

    Args:
        dataset: a dataset, its name under data/, or its folder.
        kind: box, ellipsoid, hull or wrap.
        num_layers: layers kept per ray.
        workers: parallel processes that peel.
        overwrite: replace existing proxies and layers; they are kept otherwise.

    Raises:
        HyalineError: an unknown kind, or an object that cannot have a proxy of it.
    """
    from proxies.make import make_and_peel

    choose("kind", kind, PROXY_KINDS)
    if isinstance(dataset, (str, Path)):
        dataset = open_dataset(dataset)
    reports = make_and_peel(dataset, kind, num_layers=num_layers, workers=workers, overwrite=overwrite)
    return Proxies(dataset=dataset, geometry=kind, reports=reports)
