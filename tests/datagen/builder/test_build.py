"""Tests the making of a dataset end to end: same bytes whatever happens, and every flipped bit found."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.builds import build, command, tree
from support.commands import call, run
from support.synthetic import write_synthetic_dataset

from datagen.builder.build import peel_dataset, summary
from datagen.builder.verify import verify_dataset
from datagen.data.dataset import open_dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError


@pytest.mark.promise("R8")
def test_neither_workers_threads_nor_another_process_change_a_byte(
    built: Path, scene_folder: Path, tmp_path: Path
) -> None:
    run(build(scene_folder, tmp_path / "workers", "--workers 2"))
    assert tree(tmp_path / "workers") == tree(built)
    program = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); from datagen.cli import main; main()"
    arguments = command(build(scene_folder, tmp_path / "one"))[3:]
    subprocess.run([sys.executable, "-c", program, *arguments], check=True, capture_output=True)
    assert tree(tmp_path / "one") == tree(built)


def test_other_settings_need_overwrite_and_name_the_difference(built: Path, scene_folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "copy"
    shutil.copytree(built, out)
    answer = call(build(scene_folder, out, "--seed 3"))
    assert answer.status == 1
    assert "(seed is 0 there and 3 here); pass --overwrite" in answer.error
    assert tree(out) == tree(built)
    run(build(scene_folder, out, "--seed 3 --overwrite"))
    assert open_dataset(out).config.seed == 3
    assert verify_dataset(out).problems == []


@pytest.mark.promise("R5")
def test_a_full_disk_is_one_line_and_loses_nothing(built: Path, scene_folder: Path, tmp_path: Path) -> None:
    program = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1200, -1)); from datagen.cli import main; main()"
    )
    out = tmp_path / "full"
    environment = {**os.environ, "DRJIT_CACHE_DIR": str(tmp_path)}
    arguments = [sys.executable, "-c", program, *command(build(scene_folder, out))[3:]]
    answer = subprocess.run(arguments, capture_output=True, text=True, check=False, env=environment)
    assert answer.returncode == 1
    assert answer.stderr.splitlines()[-1].startswith("error: ")
    assert f"{out}/" in answer.stderr.splitlines()[-1]
    assert "file too large; raise the limit" in answer.stderr
    assert "Traceback" not in answer.stderr
    run(build(scene_folder, out))
    assert tree(out) == tree(built)


def test_where_many_rays_meet_more_than_is_kept_the_command_that_keeps_more_is_named(tmp_path: Path) -> None:
    dataset = write_synthetic_dataset(tmp_path / "a b", resolution=8, train_views=2)
    with pytest.raises(HyalineError, match=r"peeled into 4 layers, not 1; pass --overwrite, or --num-layers 4"):
        peel_dataset(dataset, TRUTH, num_layers=1, overwrite=False)
    peel_dataset(dataset, TRUTH, num_layers=1, overwrite=True)
    cut = summary(dataset, TRUTH)
    assert cut[0].startswith("train: ") and cut[0].endswith(" of rays cross more surfaces than the 1 that are stored")
    found = re.fullmatch(r"`datagen (.*)` stores more", cut[-1])
    assert found is not None
    run(f"datagen {found[1]}")
    again = open_dataset(dataset.root)
    assert again.view("train", 0).layers().uv.shape[0] == 2
    assert [" 0.00 % of rays" in line for line in summary(again, TRUTH)] == [True] * 3
