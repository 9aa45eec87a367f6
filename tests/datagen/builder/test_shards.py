"""Tests builds in parts: at once, killed, sent off as jobs; each ends in the bytes of one build."""

import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from support.builds import build, command, tree
from support.commands import call, run
from support.synthetic import synthetic_scene

from datagen.builder.build import open_or_start
from datagen.data.config import DatasetConfig, square
from datagen.data.geometries import geometry_hash
from datagen.data.layers import start_layers
from datagen.data.paths import TRUTH, layers_root
from datagen.scene.rig import make_cameras


def test_a_killed_part_and_a_build_without_parts_end_in_the_same_bytes(
    built: Path, scene_folder: Path, tmp_path: Path
) -> None:
    out = tmp_path / "killed"
    part = build(scene_folder, out, "--shard 1/2")
    process = subprocess.Popen(command(part), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while process.poll() is None and not list(out.glob("records/*/*.json")):
        time.sleep(0.002)
    process.kill()
    process.wait()
    # What a part that was killed in a commit leaves.
    (out / "records/train/0000.json.0123456789abcdef.hyaline-tmp").write_bytes(b"half a rec")
    answer = call(part)
    assert answer.status == 0, answer.err
    assert "part 1/2 is done; without --shard, the same command makes the rest, and stereo pairs" in answer.err
    assert (out / "records/train/0000.json.0123456789abcdef.hyaline-tmp").is_file(), "a part deletes nothing"
    run(build(scene_folder, out))
    assert tree(out) == tree(built)


@pytest.mark.full
def test_the_launcher_makes_all_parts_as_jobs_of_this_machine(built: Path, scene_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "jobs"
    answer = call(build(scene_folder, out, "--launcher local --shards=2"))
    assert answer.status == 0, answer.err
    assert answer.out.strip() == str(out)
    assert "part 2/2: done" in answer.err and "noise ceiling" in answer.err
    assert tree(out) == tree(built)
    logs = list((tmp_path / "jobs-jobs").glob("*.err"))
    assert len(logs) == 2 and all("views with" in log.read_text() for log in logs)


def test_any_number_of_writers_may_start_one_dataset_at_once(tmp_path: Path) -> None:
    config = DatasetConfig.even("s", square(8), 3, spp=2)
    scene = synthetic_scene()
    cameras = make_cameras(scene.cameras, config)

    def start(root: Path) -> str:
        dataset = open_or_start(scene, root, config, cameras, overwrite=False)
        root, meshes_hash = layers_root(dataset.root, TRUTH), geometry_hash(dataset, TRUTH)
        start_layers(root, config.resolution, num_layers=4, geometry_hash=meshes_hash)
        return dataset.seal

    (tmp_path / "alone").mkdir()
    seal = start(tmp_path / "alone")
    for attempt in range(4):
        root = tmp_path / f"at-once-{attempt}"
        root.mkdir()
        with ThreadPoolExecutor(8) as pool:
            assert set(pool.map(start, [root] * 8)) == {seal}
        assert tree(root) == tree(tmp_path / "alone")
