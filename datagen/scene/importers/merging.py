"""Many small surfaces as few: those of one material become one object."""

import numpy as np

from datagen.scene.importers.foreign import ForeignMaterial, ForeignObject
from datagen.scene.importers.remarks import Remarks
from datagen.scene.materials import Material


def merged_by_material(parts: tuple[ForeignObject, ...], remarks: Remarks, *, where: str) -> tuple[ForeignObject, ...]:
    """One object for each material, and for whether it brings normals and uv."""
    groups: dict[tuple[ForeignMaterial | Material, bool, bool], list[ForeignObject]] = {}
    for part in parts:
        groups.setdefault((part.material, part.normals is None, part.uv is None), []).append(part)
    remarks.note(where, f"its {len(parts):,} objects became {len(groups)}, one a material")
    return tuple(_merged(group) for group in groups.values())


def _merged(group: list[ForeignObject]) -> ForeignObject:
    first = group[0]
    if len(group) == 1:
        return first
    starts = np.cumsum([0, *(len(part.positions) for part in group)])
    normals = [part.normals for part in group if part.normals is not None]
    uv = [part.uv for part in group if part.uv is not None]
    name = first.material.name if isinstance(first.material, ForeignMaterial) else first.name
    return ForeignObject(
        name=name,
        positions=np.concatenate([part.positions for part in group]),
        faces=np.concatenate([part.faces + start for part, start in zip(group, starts)]),
        normals=np.concatenate(normals) if normals else None,
        uv=np.concatenate(uv) if uv else None,
        material=first.material,
    )
