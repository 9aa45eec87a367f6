"""Tests of the presets of `paper`: what they configure, which flags override them, and how runs of them are called."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from support.commands import call, run
from support.training import build, configured

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.disk.records import to_json
from model.batches.layers import load_pixels
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.nets.texture import TexturePyramid
from model.run.run_folder import is_drawn, read_run
from model.run.train_flags import configure, folder_name, parse_train
from model.settings import LossConfig, PixelOptimisation


def test_the_published_preset_is_the_paper_and_the_default(dataset: Dataset) -> None:
    config = configured(dataset, "paper")
    assert config.net == PaperConfig(width=dataclasses.asdict(config.net)["width"], texture_size=16)
    assert (config.batch, config.lr, config.texture_lr, config.lr_decay) == (8192, 0.001, None, "linear")


def test_the_best_preset_sets_network_textures_rays_and_rates(dataset: Dataset) -> None:
    config = configured(dataset, "paper-best")
    net = config.net
    assert isinstance(net, PaperConfig) and (net.width, net.norm) == (128, "none")
    assert (net.texture_levels, net.finer_counts) == (5, 0.5)
    assert (net.train_samples, net.render_samples) == (4, 16)
    assert (config.batch, config.lr, config.texture_lr, config.lr_decay) == (1024, 0.003, 0.02, "cosine")
    assert config.loss == LossConfig(softness=0.03)
    assert config.optimizer == "muon"
    # Fewer rays than the published form trains on.
    published = PixelOptimisation()
    assert config.steps * config.batch * net.train_samples == 0.7 * published.steps * published.batch
    assert net.texture_size == 32


def test_flags_override_the_best_preset(dataset: Dataset) -> None:
    words = (
        str(dataset.root), "--hidden", "64", "--norm", "batch", "--texture-size", "24",
        "--texture-levels", "2", "--rays", "1", "--lr", "0.5", "--texture-lr", "0.25", "--batch", "64",
        "--lr-decay", "none", "--steps", "2500",
    )  # fmt: skip
    asked = parse_train("paper-best", words)
    config = configure("paper-best", asked, dataset)
    net = config.net
    assert isinstance(net, PaperConfig)
    assert (net.width, net.norm, net.texture_size, net.texture_levels) == (64, "batch", 24, 2)
    assert (net.train_samples, net.render_samples) == (1, 16)
    assert (config.lr, config.texture_lr, config.batch, config.lr_decay) == (0.5, 0.25, 64, "none")
    assert folder_name("paper-best", asked) == (
        "paper-best-w64-batch-norm-t24-1-rays-2-levels-batch64-lr0.5-texture-lr0.25-no-decay-2500-steps"
    )


def test_finer_levels_count_less(dataset: Dataset) -> None:
    config = PaperConfig(width=16, texture_size=16, extrinsics="none", texture_levels=3, finer_counts=0.5)
    renderer = build(config, dataset)
    assert isinstance(renderer.textures, TexturePyramid)
    with torch.no_grad():
        for table in renderer.textures.tables():
            table.fill_(1.0)
    rays = load_pixels(dataset, TRUTH, "train", [0]).take(torch.arange(1024), None)
    features = renderer.textures(rays.uv, rays.object_id)
    assert torch.equal(features, 1.75 * (rays.object_id != 0)[..., None].float().expand_as(features))


@pytest.mark.parametrize("share", [0.0, 1.5])
def test_finer_levels_cannot_count_more_than_coarser_ones_or_nothing(share: float) -> None:
    with pytest.raises(HyalineError, match=f"finer_counts: is {share}; expected 0.001 to 1"):
        PaperConfig(width=16, texture_size=16, finer_counts=share)


def test_a_run_of_the_best_preset_is_called_so_and_records_every_choice(dataset: Dataset, tmp_path: Path) -> None:
    run(f"model train paper-best {dataset.root} --steps 3 --batch 64 --device cpu")
    (out,) = (tmp_path / "runs" / "synthetic").iterdir()
    assert out.name == "paper-best-batch64-3-steps" and is_drawn(out, dataset)
    record = read_run(out)
    assert record.label == out.name
    assert record.config.net == configured(dataset, "paper-best").net
    assert json.loads((out / "run.json").read_text())["config"] == to_json(record.config)
    renderer = build(record.config.net, dataset)
    assert isinstance(renderer, PaperRenderer)
    assert record.num_parameters == sum(value.numel() for value in renderer.net.parameters())


@pytest.mark.parametrize(
    ("words", "defaults"),
    [
        ("paper", {"--steps": 2500, "--batch": 8192, "--rays": 1, "--norm": "batch", "--lr": 0.001}),
        ("paper-best", {"--steps": 3500, "--batch": 1024, "--rays": 4, "--norm": "none", "--lr": 0.003}),
        ("dnr-authors", {"--features": 8, "--batch": 16384}),
        ("light-path", {"--batch": 2048, "--stack": 32, "--fill-in,": "on"}),
        ("light-path --geometry box", {"--batch": 2048, "--stack": 96, "--relief,": "on"}),
    ],
)
def test_help_tells_the_defaults_of_the_method_and_its_preset(words: str, defaults: dict[str, object]) -> None:
    told = " ".join(call(f"model train {words} --help").out.replace("│", " ").split())
    for flag, default in defaults.items():
        text = told[told.index(f" {flag} ", told.index("options")) :]
        assert text[text.index("(default: ") :].startswith(f"(default: {default})"), flag
