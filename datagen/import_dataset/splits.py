"""Which of another project's views become training views, and which test views of either split."""

import re
from typing import cast

import numpy as np

from datagen.data.config import SPLITS, Split
from datagen.disk.errors import HyalineError
from datagen.import_dataset.foreign_dataset import ROLES, ForeignDataset, ForeignView

OURS = re.compile(r"(?:image_)?(train|interpolating|extrapolating)_(\d{4})")
"""Names of pictures in what `datagen export` writes."""
FAR_SHARE = 4
"""One in so many test views is for extrapolation."""


def split_views(foreign: ForeignDataset) -> tuple[dict[Split, tuple[ForeignView, ...]], list[str]]:
    """The views of each split, and what was decided, in a line each.

    Pictures that `datagen export` named get back their places. Otherwise the test views that stand farthest from all
    training cameras become the split `extrapolating`.

    Raises:
        HyalineError: there are none to train on, or none to test.
    """
    if (named := _by_name(foreign)) is not None:
        return named, []
    train, val, test = (foreign.views[role] for role in ROLES)
    lines = []
    if val and not test:
        test, lines = val, ["splits: there are no test pictures; those for validation take their place"]
    elif val:
        lines.append(f"splits: {len(val)} pictures for validation were left out")
    if not train or not test:
        raise HyalineError(
            f"{foreign.root}: has {len(train)} pictures to train on and {len(test)} to test; expected some of each"
        )
    if len(test) == 1:
        return {"train": train, "interpolating": test, "extrapolating": test}, [
            *lines,
            "splits: the only test picture is in both test splits",
        ]
    places = np.stack([view.world_from_camera[:3, 3] for view in train])
    away = np.array([np.linalg.norm(places - view.world_from_camera[:3, 3], axis=1).min() for view in test])
    far = {int(place) for place in np.argsort(-away, kind="stable")[: max(1, len(test) // FAR_SHARE)]}
    lines.append(
        f"splits: the {len(far)} test views that stand farthest from any training camera are in extrapolating, the "
        "other ones in interpolating"
    )
    near = tuple(view for place, view in enumerate(test) if place not in far)
    return {"train": train, "interpolating": near, "extrapolating": tuple(test[place] for place in sorted(far))}, lines


def _by_name(foreign: ForeignDataset) -> dict[Split, tuple[ForeignView, ...]] | None:
    """The views by the splits that their names tell; None unless every name tells one, and each split has some."""
    found: dict[Split, dict[int, ForeignView]] = {split: {} for split in SPLITS}
    for view in (view for role in ROLES for view in foreign.views[role]):
        match = OURS.fullmatch(view.picture.stem)
        if match is None:
            return None
        found[cast(Split, match[1])][int(match[2])] = view
    if not all(found.values()):
        return None
    return {split: tuple(views[number] for number in sorted(views)) for split, views in found.items()}
