"""nerfbaselines: COLMAP's model, lists of both splits, and nb-info.json, which says how to load them.

    nb-info.json      loader, scene, and the range of depths in metres
    ...               everything of `colmap`

Its loader of transforms.json turns points about, as those of nerfstudio's own COLMAP runs need it; that of COLMAP does
not, and reads the lists of names.
"""

from datagen.disk.storage import dump_json
from datagen.export.colmap import colmap_parts
from datagen.export.plan import Part, Plan
from datagen.export.source import Source


def plan_nerfbaselines(source: Source) -> Plan:
    """The whole folder."""
    info = Part(name="info", files=("nb-info.json",), make=lambda: {"nb-info.json": _info(source)})
    return Plan(parts=(*colmap_parts(source), info), hint="nerfbaselines train --method nerfacto --data OUT")


def _info(source: Source) -> bytes:
    return dump_json(
        {
            "loader": "colmap",
            "id": f"hyaline-{source.dataset.name}",
            "scene": source.dataset.name,
            "license": source.dataset.license,
            "evaluation_protocol": "default",
            "depth_range": [source.bounds.near, source.bounds.far],
        }
    )
