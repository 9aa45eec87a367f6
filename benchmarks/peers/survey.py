"""Exports of a dataset, opened by every tool that an environment has, and a table of what came out."""

import dataclasses
import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.peers.comparison import PEERS, PeerReport, ask, check_python, find_places, report_on
from datagen.data.dataset import Dataset
from datagen.export.formats import export_dataset
from datagen.export.source import Source
from datagen.terminal.command import say


def survey_peers(dataset: Dataset, python: Path, peers: Sequence[str], *, num_points: int) -> list[PeerReport]:
    """Exports into a folder that is gone afterwards, and opens each export with each tool that reads its format.

    Args:
        python: interpreter of the tools' environment.
        peers: names in `PEERS`.

    Raises:
        HyalineError: `python` is no interpreter.
    """
    check_python(python)
    source = Source(dataset=dataset, num_points=num_points, flow=False)
    rng = np.random.default_rng(0)
    places = {item.name: find_places(item, rng) for item in source.pictures}
    reports = []
    with tempfile.TemporaryDirectory(prefix="hyaline-peers-") as folder:
        for peer in peers:
            for form in PEERS[peer]:
                root = Path(folder) / form
                export_dataset(dataset, form, root, num_points=num_points, flow=False, overwrite=False)
                say(f"peers: {peer} opens {form}")
                answer = ask(python, peer, root, places, Path(folder))
                reports.append(report_on(peer, form, source, places, answer))
    return reports


def peers_table(reports: Sequence[PeerReport]) -> str:
    """A line for each thing that was compared."""
    lines = []
    for report in reports:
        versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
        state = f"not installed ({report.missing})" if report.missing else versions
        lines.append(f"{report.peer}, --format {report.form}: {state}")
        lines += [f"  {'ok   ' if one.passed else 'WRONG'} {one.what}: {one.detail}" for one in report.findings]
    return "\n".join(lines)


def peers_json(reports: Sequence[PeerReport]) -> str:
    """The same as JSON."""
    return json.dumps([dataclasses.asdict(report) for report in reports], indent=2)
