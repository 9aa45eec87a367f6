"""How far a geometry is from the truth, and the figure of quality against that distance."""

import math
from dataclasses import dataclass

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_proxy_records
from datagen.data.paths import TRUTH


@dataclass(frozen=True, kw_only=True)
class ProxyError:
    """How far a geometry is from the true surfaces."""

    mean_mm: float
    """Mean over objects of the mean distance from points on an object's proxy to its surface, in millimetres."""
    max_mm: float
    """Largest such distance of any object, in millimetres."""


def proxy_error(dataset: Dataset, geometry: str) -> ProxyError:
    """The error of a geometry, from what was measured when it was made; 0 of the truth.

    Raises:
        HyalineError: the proxies are not there any more, or are damaged.
    """
    if geometry == TRUTH:
        return ProxyError(mean_mm=0.0, max_mm=0.0)
    numbers = [record.statistics for record in read_proxy_records(dataset, geometry)]
    return ProxyError(
        mean_mm=1000 * math.fsum(item.mean_distance for item in numbers) / len(numbers),
        max_mm=1000 * max(item.max_distance for item in numbers),
    )
