"""Tests that a build of many views needs no more memory than one of few."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import os, sys
sys.path[:0] = {folders!r}
from pathlib import Path
from support.synthetic import synthetic_scene
import datagen.builder.build as build
from datagen.data.config import DatasetConfig, SplitConfig
from datagen.data.config import square

def resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

def counting(task, name):
    def counted(job, view):
        task(job, view)
        done[name] = done.get(name, 0) + 1
        if done[name] in {marks!r}:
            print(name, done[name], resident(), flush=True)
    return counted

done = {{}}
build.render_task = counting(build.render_task, "render")
build.peel_task = counting(build.peel_task, "peel")
few = SplitConfig(views=1, spp=2)
config = DatasetConfig(scene="synthetic", preset="tiny", resolution=square(16), interpolating=few, extrapolating=few,
                       train=SplitConfig(views={views} - 2, spp=2))
build.build_dataset(synthetic_scene(), Path({out!r}), config, num_layers=4, workers=1,
                    overwrite=False)
"""

MOST = 30 << 20


@pytest.mark.promise("R12")
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="only Linux tells how much memory is held")
def test_many_views_need_no_more_memory_than_few(tmp_path: Path, is_full: bool) -> None:
    early, late = (50, 300) if is_full else (10, 50)
    root = Path(__file__).resolve().parents[3]
    folders = [str(root), str(root / "plugins"), str(root / "tests")]
    program = PROGRAM.format(folders=folders, marks=(early, late), views=late, out=str(tmp_path / "data"))
    answer = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert answer.returncode == 0, answer.stderr
    held = {tuple(line.split()[:2]): int(line.split()[2]) for line in answer.stdout.splitlines()}
    for name in ("render", "peel"):
        growth = held[name, str(late)] - held[name, str(early)]
        assert growth < MOST, f"{name}: {growth >> 20} MB more after {late} views than after {early}"
