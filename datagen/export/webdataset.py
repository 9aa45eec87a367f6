"""WebDataset: shards of samples, one a view, with every quantity that a view has.

    train-000000.tar, val-..., interpolating-..., extrapolating-...     VIEWS views each
    dataset.json                                                        objects, materials, near, far, conventions

A sample NAME (such as train_0003) has the files NAME.png, NAME.depth.npy, ... of datagen/export/samples.py;
dataset.json has the convention of each.
"""

import io
import tarfile
from collections.abc import Iterator

from datagen.export.plan import Part, Plan
from datagen.export.samples import about_samples, sample_files, sample_groups
from datagen.export.source import ExportView, Source

VIEWS = 32
"""Of a shard: what is made at once."""


def plan_webdataset(source: Source) -> Plan:
    """All shards, and what they have in common."""
    about = Part(name="about", files=("dataset.json",), make=lambda: {"dataset.json": about_samples(source)})
    hint = "python -c \"import webdataset; print(next(iter(webdataset.WebDataset('OUT/train-000000.tar'))).keys())\""
    return Plan(parts=(*_shards(source), about), hint=hint)


def _shards(source: Source) -> Iterator[Part]:
    for name, items in sample_groups(source).items():
        for shard, first in enumerate(range(0, len(items), VIEWS)):
            yield _shard_part(f"{name}-{shard:06d}", items[first : first + VIEWS], flow=source.flow)


def _shard_part(name: str, items: list[ExportView], *, flow: bool) -> Part:
    file = f"{name}.tar"
    return Part(name=name, files=(file,), make=lambda: {file: _tar(items, flow=flow)})


def _tar(items: list[ExportView], *, flow: bool) -> bytes:
    """The same views give the same bytes: no time, no owner."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w", format=tarfile.USTAR_FORMAT) as archive:
        for item in items:
            for name, data in sample_files(item, flow=flow).items():
                entry = tarfile.TarInfo(f"{item.name}.{name}")
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))
    return buffer.getvalue()
