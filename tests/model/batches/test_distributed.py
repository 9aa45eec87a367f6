"""Tests training by several processes: it ends where one process does, writes once, resumes, and refuses the rest."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.synthetic import write_synthetic_dataset
from support.training import SMALL, call, run_bytes

from datagen.data.dataset import Dataset
from datagen.data.geometries import read_meshes
from datagen.data.paths import TRUTH
from datagen.data.png import read_png
from datagen.disk.errors import HyalineError
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.scene.materials import Conductor
from model.batches.distributed import SharedGenerator, Team, join, own_device
from model.methods.authors_code.config import AuthorsConfig
from model.methods.dnr.config import DnrConfig
from model.run.checkpoint import load_state
from model.run.run_folder import TrainConfig
from model.run.train import check_team
from model.settings.losses import LossConfig

QUICK = ("--steps", "20", "--batch", "255", "--device", "cpu")
EVERY = {"evaluate_every": 5, "checkpoint_every": 4}
RUNS = {
    "plain": ("--method", "paper", "--width", "32", "--texture-size", "16", "--norm", "none", "--zero-layer"),
    "norm": ("--method", "paper", "--width", "32", "--texture-size", "16", "--zero-layer"),
    "light-path": ("--method", "light-path", "--render-rays", "1", "--environment", "8"),
}

# Two processes of one thread each, started as torchrun starts them: they check batch norm, then train one run after the
# other. Both die before step `last` of the first one.
PROGRAM = """
import copy, json, multiprocessing, os, sys, time

def check_norm():
    import torch
    from torch import nn
    from model.batches.distributed import join
    with join(torch.device("cpu")) as team:
        torch.manual_seed(0)
        x, target = torch.randn(2, 255, 7, dtype=torch.float64)
        whole = nn.Sequential(nn.Linear(7, 7), nn.BatchNorm1d(7)).double()
        shared = copy.deepcopy(whole)
        team.share_norms(shared)
        shared.double()
        inputs = [x.clone().requires_grad_() for _ in range(2)]
        (whole(inputs[0] + 100) - target).square().mean().backward()
        own = team.share(len(x))
        rows = slice(own.start, own.stop)
        loss = (shared(inputs[1][rows] + 100) - target[rows]).square().mean()
        team.weigh(loss, len(x)).backward()
        team.sum_gradients(shared)
        pairs = list(zip(whole.parameters(), shared.parameters()))
        pairs = [(a.grad, b.grad) for a, b in pairs] + list(zip(whole.buffers(), shared.buffers()))
        pairs.append((inputs[0].grad[rows], inputs[1].grad[rows]))
        assert len(pairs) == 8
        for one, several in pairs:
            assert torch.allclose(one, several, rtol=1e-6, atol=1e-9), (one - several).abs().max()

def work(rank, ports, last, every, runs):
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": "2", "OMP_NUM_THREADS": "1",
                   "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(ports[0])}
    check_norm()
    import model.cli, model.run.run_folder, model.run.train
    model.run.run_folder.TrainConfig.__init__.__kwdefaults__ |= every
    check = model.run.train.check_finite
    def die(loss, renderer, *, step, out):
        if step == last:
            os._exit(9)
        check(loss, renderer, step=step, out=out)
    model.run.train.check_finite = die
    for port, words in zip(ports[1:], runs):
        os.environ["MASTER_PORT"] = str(port)
        sys.argv = ["model", "train", *words]
        model.cli.main()

def free_ports(count):
    import socket
    sockets = [socket.socket() for _ in range(count)]
    for each in sockets: each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets: each.close()
    return ports

if __name__ == "__main__":
    last, every, runs = json.loads(sys.argv[1])
    context = multiprocessing.get_context("spawn")
    ports = free_ports(1 + len(runs))
    processes = [context.Process(target=work, args=(rank, ports, last, every, runs)) for rank in range(2)]
    for process in processes: process.start()
    while any(process.is_alive() for process in processes):
        time.sleep(0.05)
        if any(process.exitcode for process in processes):  # As torchrun does it.
            for process in processes: process.kill()
    for process in processes: process.join()
    sys.exit(max(abs(process.exitcode) for process in processes))
"""


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return write_synthetic_dataset(tmp_path_factory.mktemp("model") / "data" / "synthetic")


def words_of(dataset: Dataset, out: Path, name: str) -> list[str]:
    return ["--dataset", str(dataset.root), "--out", str(out), "--name", "it", *QUICK, *RUNS[name]]


def train_in_two(folder: Path, runs: list[list[str]], *, stop_at: int = -1) -> subprocess.CompletedProcess[str]:
    (folder / "two.py").write_text(PROGRAM)
    command = [sys.executable, str(folder / "two.py"), json.dumps([stop_at, EVERY, runs])]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)


@pytest.fixture(scope="module")
def two(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder with each of `RUNS`, trained by two processes, and what they said."""
    folder = tmp_path_factory.mktemp("two")
    answer = train_in_two(folder, [words_of(dataset, folder / name, name) for name in RUNS])
    assert answer.returncode == 0, answer.stderr
    assert answer.stdout == "".join(f"{folder / name}\n" for name in RUNS)
    return folder, answer.stderr


def weights(out: Path) -> dict[str, torch.Tensor]:
    return load_state(out / "weights.pt")["renderer"]  # pyright: ignore[reportReturnType]


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_two_processes_end_where_one_does(
    two: tuple[Path, str], dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    for key, value in EVERY.items():
        monkeypatch.setitem(TrainConfig.__init__.__kwdefaults__, key, value)  # pyright: ignore
    assert call(monkeypatch, "train", *words_of(dataset, tmp_path / "one", name)) == 0
    one, both = tmp_path / "one", two[0] / name
    assert sorted(run_bytes(one)) == sorted(run_bytes(both))
    assert run_bytes(one)["run.json"] == run_bytes(both)["run.json"]

    expected, found = weights(one), weights(both)
    assert list(expected) == list(found)
    for key, value in expected.items():
        # A linear layer's bias before a batch norm has no effect and so a gradient of nothing but rounding, of which
        # Adam makes whole steps; the norm's running mean follows it.
        if name == "norm" and (key.endswith("running_mean") or ("linear.bias" in key)):
            assert (found[key] - value).abs().max() < 20 * 2 * 0.001
            continue
        difference = (found[key] - value).double().abs()
        # With batch norm a texel that is hardly met has a gradient near rounding, too.
        limit, largest = (1e-4, 2e-2) if name == "norm" else (1e-5, 1e-5)
        assert difference.mean() <= limit * value.double().abs().mean(), key
        assert difference.max() <= largest * value.double().abs().max(), key
    lines = [(out / "metrics.jsonl").read_text().splitlines() for out in (one, both)]
    for before, after in zip(*(map(json.loads, text) for text in lines), strict=True):
        assert after["step"] == before["step"]
        assert after["loss"] == pytest.approx(before["loss"], rel=1e-5)
        # As above: the running mean is behind the bias, by other steps.
        tolerance = 0.1 if name == "norm" else 1e-3
        assert after["held_out_psnr"] == pytest.approx(before["held_out_psnr"], abs=tolerance)
    if name != "norm":
        for path in one.glob("predictions/*/*.png"):
            pixels, others = (read_png(out / path.relative_to(one)).astype(int) for out in (one, both))
            assert np.abs(pixels - others).max() <= 1


@pytest.mark.slow
def test_only_the_first_process_speaks(two: tuple[Path, str]) -> None:
    folder, said = two
    assert said.count("next: eval report") == len(RUNS)
    assert said.count(f"{folder / 'plain'}: rendered 4 views\n") == 1
    assert said.count(" training views and 1 held out, ") == len(RUNS)


@pytest.mark.slow
def test_two_processes_that_were_killed_go_on_to_the_same_bytes(
    two: tuple[Path, str], dataset: Dataset, tmp_path: Path
) -> None:
    words = words_of(dataset, tmp_path / "norm", "norm")
    assert train_in_two(tmp_path, [words], stop_at=11).returncode == 9
    assert (tmp_path / "norm/checkpoint.pt").is_file()
    answer = train_in_two(tmp_path, [words])
    assert answer.returncode == 0, answer.stderr
    assert answer.stderr.count("goes on from step 8 of 20\n") == 1
    assert run_bytes(tmp_path / "norm") == run_bytes(two[0] / "norm")


@pytest.mark.parametrize("batch", [3, 16, 255])
def test_the_shares_of_all_processes_are_the_batch_and_its_draws(batch: int) -> None:
    teams = [Team(rank=rank, size=3) for rank in range(3)]
    assert [place for team in teams for place in team.share(batch)] == list(range(batch))
    alone = np.random.default_rng([4, 7])
    several = [team.generator([4, 7], batch) for team in teams]
    own = [len(team.share(batch)) for team in teams]
    for _ in range(2):
        parts = [rng.integers(1000, size=count) for rng, count in zip(several, own)]
        assert np.array_equal(np.concatenate(parts), alone.integers(1000, size=batch))
        parts = [rng.random((count * 4, 2)) for rng, count in zip(several, own)]
        assert np.array_equal(np.concatenate(parts), alone.random((batch * 4, 2)))
        seed = alone.integers(1 << 31)
        assert [rng.integers(1 << 31) for rng in several] == [seed] * 3
    assert type(Team().generator([4, 7], batch)) is np.random.Generator
    assert isinstance(several[0], SharedGenerator)


def test_a_share_of_the_rays_meets_the_facets_that_it_meets_among_all(dataset: Dataset) -> None:
    if use_mitsuba(quiet=True).startswith("scalar"):
        pytest.skip("light paths need a vectorised variant of Mitsuba")
    from datagen.trace.light_path import LightPathTracer

    rough = Conductor(color=(0.9, 0.8, 0.7), roughness=0.4)
    tracer = LightPathTracer(read_meshes(dataset, TRUTH), (rough, rough))
    origins = np.tile(np.float32([0, 0, 3]), (64, 1))
    directions = np.tile(np.float32([0.1, 0, -1]) / np.float32(np.sqrt(1.01)), (64, 1))
    facets = np.random.default_rng(1).random((64, 2), np.float32)
    whole = tracer.trace(origins, directions, seed=5, facets=facets).end_direction[1]
    part = tracer.trace(origins[20:], directions[20:], seed=5, facets=facets[20:]).end_direction[1]
    assert len(np.unique(whole.round(4), axis=0)) > 30, "the facets differ"
    assert np.array_equal(part, whole[20:])
    assert not np.array_equal(tracer.trace(origins, directions, seed=5).end_direction[1], whole)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"method": "dnr", "net": DnrConfig()},
            "dnr: its steps look at whole patches, pictures or dropout, which several processes",
        ),
        ({"method": "authors-code", "net": AuthorsConfig()}, "train it without torchrun"),
        ({"loss": LossConfig(adversarial=0.01)}, "with losses of pixels alone"),
        ({"batch": 2}, "batch: is 2; expected at least a pixel for each of 3 processes"),
    ],
)
def test_what_cannot_be_shared_is_refused(change: dict[str, object], message: str) -> None:
    config = dataclasses.replace(SMALL, **change)  # pyright: ignore
    check_team(config, Team())
    with pytest.raises(HyalineError, match=message):
        check_team(config, Team(rank=1, size=3))


def test_without_torchrun_a_process_is_alone() -> None:
    with join(torch.device("cpu")) as team:
        assert team == Team() and team.is_first
        assert team.agree(True) and not team.agree(False)
    assert own_device(torch.device("cuda")) == torch.device("cuda")
