"""Tests that what a tool reads wrongly of an export is found, and, where tools are installed, that they read it right.

`HYALINE_PEERS=/path/to/python pytest benchmarks/tests/test_peers.py` opens every export with the real loaders that this
interpreter can import.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from support.traced_dataset import write_traced_dataset

from benchmarks.exports import (
    PEERS,
    PLACES,
    Places,
    Read,
    compare,
    find_places,
    peers_table,
    survey_peers,
)
from datagen.data.dataset import Dataset, open_dataset
from datagen.disk.storage import sha256
from hyaline_export.source import Source


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    root = tmp_path_factory.mktemp("source") / "glasses"
    write_traced_dataset(root)
    return open_dataset(root)


@pytest.fixture(scope="module")
def source(dataset: Dataset) -> Source:
    return Source(dataset=dataset, num_points=50, flow=False)


@pytest.fixture(scope="module")
def places(source: Source) -> dict[str, Places]:
    rng = np.random.default_rng(0)
    return {item.name: find_places(item, rng) for item in source.pictures}


def read_rightly(source: Source, places: dict[str, Places]) -> Read:
    """What a loader answers that makes no mistake: each view's rays, by its camera."""
    items = sorted(source.pictures, key=lambda item: item.name)
    origins, directions = [], []
    for item in items:
        camera, pixels = item.view.camera, places[item.name].pixels
        x, y = ((pixels - camera.intrinsics[:2, 2]) / camera.intrinsics[0, 0]).T
        rotation, centre = camera.world_from_camera[:3, :3], camera.world_from_camera[:3, 3]
        directions.append(np.stack([x, -y, -np.ones_like(x)], axis=-1) @ rotation.T)
        origins.append(np.tile(centre, (PLACES, 1)))
    about = {
        "names": [item.name for item in items],
        "splits": {role: [item.name for item in source.of_role(role)] for role in ("train", "val", "test")},
        "sizes": [[item.view.camera.width, item.view.camera.height] for item in items],
        "channels": [3] * len(items),
        "hashes": [sha256(item.view.image.tobytes()) for item in items],
        "is_opaque": [True] * len(items),
        "near_far": [source.bounds.near, source.bounds.far],
        "track_px": 0.0,
        "versions": {},
    }
    arrays = {
        "origins": np.stack(origins),
        "directions": np.stack(directions),
        "depth": np.stack([places[item.name].depth for item in items]),
        "points": source.points.position,
        "colors": source.points.color,
    }
    return Read(about=about, arrays=arrays)


def wrong(source: Source, places: dict[str, Places], read: Read) -> list[str]:
    return [one.what for one in compare(source, places, read) if not one.passed]


def test_a_loader_that_makes_no_mistake_is_found_right(source: Source, places: dict[str, Places]) -> None:
    read = read_rightly(source, places)
    findings = compare(source, places, read)
    assert [one.what for one in findings] == [
        "splits",
        "pictures",
        "cameras",
        "points",
        "tracks",
        "depth",
        "near and far",
    ]
    assert all(one.passed for one in findings)
    assert findings[2].detail.startswith(f"{14 * PLACES} vertices, off by at most ")


MISTAKES = {
    "cameras": ("turned by half a pixel", "turned about", "moved"),
    "pictures": ("other colours", "width and height swapped", "seen through"),
    "splits": ("test views in train",),
    "points": ("points turned about", "points in another order of colours"),
    "depth": ("depth along the ray",),
    "near and far": ("near of 2",),
    "tracks": ("a track off by a pixel",),
}


@pytest.mark.parametrize("what, how", [(what, how) for what, ways in MISTAKES.items() for how in ways])
def test_each_mistake_of_a_loader_is_found(what: str, how: str, source: Source, places: dict[str, Places]) -> None:
    read = read_rightly(source, places)
    about, arrays = read.about, dict(read.arrays)
    names, lens = about["names"], source.pictures[0].view.camera.intrinsics[0, 0]
    match how:
        case "turned by half a pixel":
            right = [source.dataset.view(*_view(name)).camera.world_from_camera[:3, 0] for name in names]
            arrays["directions"] = arrays["directions"] + 0.5 / lens * np.stack(right)[:, None]
        case "turned about":
            arrays["directions"] = -arrays["directions"]
        case "moved":
            arrays["origins"] = arrays["origins"] + [0.05, 0, 0]
        case "other colours":
            about["hashes"][3] = sha256(b"")
        case "width and height swapped":
            about["sizes"][0] = [47, 48]
        case "seen through":
            about["is_opaque"][-1] = False
        case "test views in train":
            about["splits"]["train"] = [*about["splits"]["train"], about["splits"]["test"][0]]
        case "points turned about":
            arrays["points"] = arrays["points"][:, [0, 2, 1]]
        case "points in another order of colours":
            arrays["colors"] = arrays["colors"][:, ::-1]
        case "depth along the ray":
            arrays["depth"] = arrays["depth"] * 1.01
        case "near of 2":
            about["near_far"] = [2, 6]
        case "a track off by a pixel":
            about["track_px"] = 1.0
    assert wrong(source, places, Read(about=about, arrays=arrays)) == [what]


def _view(name: str) -> tuple:
    split, _, index = name.rpartition("_")
    return split, int(index)


@pytest.mark.skipif("HYALINE_PEERS" not in os.environ, reason="HYALINE_PEERS names no interpreter that has other tools")
@pytest.mark.parametrize("peer", PEERS)
def test_the_real_loader_reads_the_export_rightly(peer: str, dataset: Dataset) -> None:
    for report in survey_peers(dataset, Path(os.environ["HYALINE_PEERS"]), [peer], num_points=200):
        if report.missing:
            pytest.skip(report.missing)
        assert report.versions and len(report.findings) >= 4, peers_table([report])
        assert all(one.passed for one in report.findings), peers_table([report])
        (cameras,) = (one.detail for one in report.findings if one.what == "cameras")
        assert float(cameras.split()[-2]) < 1e-3  # Pixels.
