"""Quantities: a file for each quantity of each view, beside the pictures, as NumPy and any viewer of PNGs open them.

train/NAME.png, train/NAME.depth.npy, ...     also val, interpolating, extrapolating; the endings are those of
                                              datagen/export/samples.py
dataset.json                                  objects, materials, near, far, box; what each file says, and in what unit
"""

from datagen.export.plan import Part, Plan
from datagen.export.samples import FILES, FLOW_FILES, about_samples, sample_files, sample_groups
from datagen.export.source import ExportView, Source


def plan_quantities(source: Source) -> Plan:
    """The whole folder."""
    about = Part(name="about", files=("dataset.json",), make=lambda: {"dataset.json": about_samples(source)})
    views = [
        _view_part(folder, item, flow=source.flow) for folder, items in sample_groups(source).items() for item in items
    ]
    first = views[0].files[list(FILES).index("depth.npy")]
    return Plan(parts=(*views, about), hint=f"python -c \"import numpy; print(numpy.load('OUT/{first}').shape)\"")


def _view_part(folder: str, item: ExportView, *, flow: bool) -> Part:
    stem = f"{folder}/{item.name}"
    return Part(
        name=f"{folder}-{item.name}",
        files=tuple(f"{stem}.{ending}" for ending in (*FILES, *(FLOW_FILES if flow else ()))),
        make=lambda: {f"{stem}.{ending}": data for ending, data in sample_files(item, flow=flow).items()},
    )
