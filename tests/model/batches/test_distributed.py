"""Tests training by several processes: gradients are averaged, one process writes, runs resume, the rest is refused."""

import dataclasses
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support import commands
from support.training import SMALL, call, run_bytes

from datagen.data.dataset import Dataset
from datagen.disk.errors import HyalineError
from model.batches.distributed import Processes, join, see_own_gpu
from model.losses.patch_losses import Losses
from model.methods.deepvoxels.config import DeepVoxelsConfig
from model.methods.dnr.config import DnrConfig
from model.run.checkpoint import load_state
from model.run.run_folder import TrainConfig
from model.run.train import check_processes
from model.settings.losses import LossConfig

QUICK = ("--steps", "12", "--batch", "255", "--device", "cpu", "--hidden", "32", "--texture-size", "16", "--zero-layer")
EVERY = {"evaluate_every": 5, "checkpoint_every": 4}
RUNS = {"plain": ("--norm", "none"), "norm": ("--norm", "batch")}

# Two processes of one thread each, started as torchrun starts them. They train one run after the other; where a run is
# given a last step, both stop there as a Ctrl-C would stop them, before the optimiser.
PROGRAM = """
import json, multiprocessing, os, sys, time

def work(rank, ports, every, runs):
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1",
                   "MASTER_ADDR": "127.0.0.1"}
    import model.cli, model.run.run_folder, model.run.train
    model.run.run_folder.TrainConfig.__init__.__kwdefaults__ |= every
    check = model.run.train.read_finite
    for port, (last, words) in zip(ports, runs):
        def stop(loss, renderer, *, step, out, last=last):
            if step == last:
                raise KeyboardInterrupt
            return check(loss, renderer, step=step, out=out)
        model.run.train.read_finite = stop
        os.environ["MASTER_PORT"] = str(port)
        sys.argv = ["model", "train", *words]
        try:
            model.cli.main()
        except SystemExit as end:
            assert end.code == (0 if last is None else 130), end.code

def free_ports(count):
    import socket
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets: each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets: each.close()
    return ports

if __name__ == "__main__":
    every, runs = json.loads(sys.argv[1])
    context = multiprocessing.get_context("spawn")
    ports = free_ports(len(runs))
    processes = [context.Process(target=work, args=(rank, ports, every, runs)) for rank in range(2)]
    for process in processes: process.start()
    while any(process.is_alive() for process in processes):
        time.sleep(0.05)
        if any(process.exitcode for process in processes):  # As torchrun does it.
            for process in processes: process.kill()
    for process in processes: process.join()
    sys.exit(max(abs(process.exitcode) for process in processes))
"""


def words_of(dataset: Dataset, out: Path, name: str) -> list[str]:
    return ["paper", str(dataset.root), "--out", str(out), "--label", "it", *QUICK, *RUNS[name]]


@pytest.fixture(scope="module")
def two(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with each of `RUNS`, trained by two processes, `stopped` among them, which resumed; what they said."""
    folder = tmp_path_factory.mktemp("two")
    words = {name: words_of(dataset, folder / name, name) for name in RUNS}
    stopped = words_of(dataset, folder / "stopped", "norm")
    runs = [(None, words["plain"]), (None, words["norm"]), (7, stopped), (None, stopped)]
    (folder / "two.py").write_text(PROGRAM)
    command = [sys.executable, str(folder / "two.py"), json.dumps([EVERY, runs])]
    answer = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout == "".join(f"{folder / name}\n" for name in (*RUNS, "stopped"))
    return folder, answer.stderr


def weights(out: Path) -> dict[str, torch.Tensor]:
    return load_state(out / "weights.pt")["renderer"]  # pyright: ignore[reportReturnType]


@pytest.mark.slow
def test_two_processes_end_where_the_mean_of_their_two_gradients_leads(
    two: tuple[Path, str], dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    own_loss = Losses.loss

    def mean_of_both(self: Losses, own, renderer, training, batch: int, rng, *, step: int) -> torch.Tensor:
        assert batch == 255
        draws = [np.random.default_rng([0, step, 0, rank]) for rank in range(2)]
        parts = [own_loss(self, own, renderer, training, 127, draw, step=step) for draw in draws]
        return torch.stack(parts).mean()

    monkeypatch.setattr(Losses, "loss", mean_of_both)
    for key, value in EVERY.items():
        monkeypatch.setitem(inspect.unwrap(TrainConfig.__init__).__kwdefaults__, key, value)  # pyright: ignore
    assert call(monkeypatch, "train", *words_of(dataset, tmp_path / "one", "plain")) == 0
    one, both = tmp_path / "one", two[0] / "plain"
    assert sorted(run_bytes(one)) == sorted(run_bytes(both))
    assert run_bytes(one)["run.json"] == run_bytes(both)["run.json"]
    expected, found = weights(one), weights(both)
    assert list(expected) == list(found)
    for key, value in expected.items():
        assert (found[key] - value).abs().max() <= 1e-5 * value.abs().max(), key
    lines = [map(json.loads, (out / "metrics.jsonl").read_text().splitlines()) for out in (one, both)]
    for before, after in zip(*lines, strict=True):
        assert after["step"] == before["step"]
        assert after["loss"] == pytest.approx(before["loss"], rel=1e-5)
        assert after["held_out_psnr"] == pytest.approx(before["held_out_psnr"], abs=1e-3)


@pytest.mark.slow
def test_only_the_first_process_speaks(two: tuple[Path, str]) -> None:
    folder, said = two
    assert said.count("next: eval report") == len(RUNS) + 1
    assert said.count(f"{folder / 'plain'}: rendered 4 views\n") == 1
    assert said.count(" training views and 1 held out, ") == len(RUNS) + 2


@pytest.mark.slow
def test_two_processes_that_were_stopped_go_on_to_the_same_bytes(two: tuple[Path, str]) -> None:
    folder, said = two
    assert said.count("resuming after step 4 of 12\n") == 1
    assert run_bytes(folder / "stopped") == run_bytes(folder / "norm")


def test_each_process_draws_its_own_and_the_first_what_one_alone_would() -> None:
    several = [Processes(rank=rank, count=3) for rank in range(3)]
    assert [processes.share(256) for processes in several] == [85] * 3
    assert Processes().share(255) == 255
    drawn = {tuple(processes.generator(4, 7, 0).random(4)) for processes in several}
    assert len(drawn) == 3
    assert tuple(Processes().generator(4, 7, 0).random(4)) == tuple(np.random.default_rng([4, 7]).random(4))
    assert tuple(Processes().generator(4, 7, 0).random(4)) in drawn
    assert tuple(several[1].generator(4, 7, 1).random(4)) not in drawn


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"method": "deepvoxels", "net": DeepVoxelsConfig()}, "deepvoxels: has state besides its gradients"),
        ({"loss": LossConfig(adversarial=0.01)}, "adversarial: several processes do not share the discriminator"),
        ({"batch": 2}, "batch: is 2; expected at least one pixel per process and update"),
    ],
)
def test_what_several_processes_cannot_train_is_refused(change: dict[str, object], message: str) -> None:
    config = dataclasses.replace(SMALL, **change)  # pyright: ignore
    check_processes(config, Processes())
    with pytest.raises(HyalineError, match=message):
        check_processes(config, Processes(rank=1, count=3))


def test_patches_and_pictures_can_be_trained_by_several_processes() -> None:
    check_processes(dataclasses.replace(SMALL, method="dnr", net=DnrConfig()), Processes(rank=1, count=3))
    check_processes(dataclasses.replace(SMALL, loss=LossConfig(vgg_weights="random")), Processes(rank=1, count=3))


def test_without_torchrun_a_process_is_alone() -> None:
    with join(torch.device("cpu")) as processes:
        assert processes == Processes() and processes.is_first
        assert processes.broadcast(True) and not processes.broadcast(False)


@pytest.mark.parametrize(
    ("visible", "rank", "seen"), [(None, 1, "1"), ("3,5", 0, "3"), ("3,5", 1, "5"), ("GPU-a,GPU-b", 1, "GPU-b")]
)
def test_each_process_sees_a_gpu_of_its_own(
    monkeypatch: pytest.MonkeyPatch, visible: str | None, rank: int, seen: str
) -> None:
    """Dr.Jit always takes the first GPU that it sees, torch the one that it is told."""
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("LOCAL_RANK", str(rank))
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible or "")
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    see_own_gpu()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == seen


def test_numbers_of_processes_that_are_none_are_refused_and_empty_ones_count_as_unset(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "abc")
    answer = commands.call(f"model train paper {tmp_path}")
    assert answer.error == "error: WORLD_SIZE=abc: expected a whole number, as torchrun sets it; unset WORLD_SIZE"
    monkeypatch.setenv("WORLD_SIZE", "")
    with join(torch.device("cpu")) as processes:
        assert processes == Processes()


def test_more_processes_than_gpus_are_refused_by_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    monkeypatch.setenv("WORLD_SIZE", "3")
    monkeypatch.setenv("LOCAL_RANK", "2")
    answer = commands.call(f"model train paper {tmp_path}")
    assert answer.status == 1
    assert "process 3 of this machine finds 2 GPUs; expected one each" in answer.error
