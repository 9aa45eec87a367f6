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
from datagen.disk.records import to_json
from model.batches.layers import load_pixels
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.nets.texture import TexturePyramid
from model.run.run_folder import is_drawn, read_run


def test_the_published_preset_is_the_paper_and_the_default(dataset: Dataset) -> None:
    config = configured(dataset, "paper")
    assert config.net == PaperConfig(width=dataclasses.asdict(config.net)["width"], texture_size=16)
    assert (config.batch, config.lr, config.texture_lr, config.lr_decay) == (8192, 0.001, None, "linear")


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
        ("light-path --geometry box", {"--batch": 2048, "--stack": 96, "--relief,": "on"}),
    ],
)
def test_help_tells_the_defaults_of_the_method_and_its_preset(words: str, defaults: dict[str, object]) -> None:
    told = " ".join(call(f"model train {words} --help").out.replace("│", " ").split())
    for flag, default in defaults.items():
        text = told[told.index(f" {flag} ", told.index("options")) :]
        assert text[text.index("(default: ") :].startswith(f"(default: {default})"), flag
