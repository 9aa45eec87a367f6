"""Owns the tests of what `model train` can be told: flags, configurations, names of run folders."""

import dataclasses

import pytest

from datagen.disk.errors import HyalineError
from model.cli import main
from model.methods.table import METHODS
from model.settings.choices import (
    CHOICES,
    CommonChoices,
    LightPathChoices,
    MethodChoices,
    PaperChoices,
    flags_of,
    folder_name,
    named_method,
    refuse_foreign_flags,
)


@pytest.mark.parametrize(
    ("common", "choices", "name"),
    [
        ({}, PaperChoices(), "paper"),
        ({"geometry": "box", "steps": 10, "seed": 2}, PaperChoices(), "paper-box-10-steps-seed2"),
        (
            {},
            PaperChoices(extrinsics="none", width="256", blocks=2, norm="none", textures="scene"),
            "paper-no-extrinsics-w256-2-blocks-no-norm-scene-texture",
        ),
        (
            {},
            PaperChoices(extrinsics="sh", texture_size=64, zero_layer=True, rays=4, render_rays=1),
            "paper-sh-t64-zero-layer-4-rays-1-render-rays",
        ),
        (
            {"method": "light-path", "geometry": "box"},
            LightPathChoices(texture_size=9, rays=1, branches=2, compositing="stack", stack=32, straight_layers=0),
            "light-path-box-t9-1-rays-2-branches-stack-stack32-0-straight",
        ),
        (
            {"method": "light-path"},
            LightPathChoices(
                environment=1, sky_lobes=3, sky_lr=0.5, refined_rays=9, position_octaves=3, texture_levels=1
            ),
            "light-path-9-refined-rays-sky1-3-lobes-sky-lr0.5-3-octaves-1-levels",
        ),
        (
            {"batch": 64, "lr": 0.1, "texture_lr": 0.5, "lr_decay": "none", "steps": 10, "seed": 2},
            PaperChoices(layers="2"),
            "paper-2-layers-batch64-lr0.1-texture-lr0.5-no-decay-10-steps-seed2",
        ),
        ({"lr_decay": "cosine", "updates": 2}, PaperChoices(), "paper-2-updates-cosine-decay"),
    ],
)
def test_folders_are_named_as_ever(common: dict, choices: MethodChoices, name: str) -> None:
    """The names of runs that exist; what differs in any choice that changes results lies in folders of its own."""
    assert folder_name(CommonChoices(**{"method": "paper", **common}), choices) == name


def test_each_method_has_its_choices_and_no_flag_means_two_things() -> None:
    assert CHOICES.keys() == METHODS.keys()
    for record in CHOICES.values():
        assert not flags_of(record) & flags_of(CommonChoices)
        for item in dataclasses.fields(record):
            assert "suffix" in item.metadata or dataclasses.is_dataclass(item.type), item.name


def test_the_last_method_on_the_command_line_counts() -> None:
    assert named_method(["train", "--method", "paper", "--method=light-path"]) == "light-path"
    assert named_method(["train", "--method"]) is None


def test_flags_of_other_methods_are_refused_and_unknown_ones_left_to_the_parser() -> None:
    refuse_foreign_flags("paper", ["--zero-layer", "--texture_size=3", "--seed", "-1", "--unheard-of"])
    with pytest.raises(HyalineError, match=r"--branches: method paper has no such choice \(light-path has\); leave it"):
        refuse_foreign_flags("paper", ["--branches=3"])


def test_help_flows_over_the_lines_of_a_docstring(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["model", "train", "--method", "dnr", "--help"])
    with pytest.raises(SystemExit):
        main()
    lines = [line.strip("│ ") for line in capsys.readouterr().out.splitlines()]
    start = next(place for place, line in enumerate(lines) if line.startswith("--method"))
    shown = lines[start + 1 : lines.index("(required)", start)]
    assert len(shown) > 5
    assert min(map(len, shown)) > 45  # Where a line of the docstring ended, only a word or two stood.
