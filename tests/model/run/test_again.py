"""Tests of the words that ask for a run again: they configure the same, and say nothing that is usual."""

import pytest
from support.training import configured

from datagen.data.dataset import Dataset
from model.methods.table import open_inputs
from model.run.preparation import words_again

ASKED = (
    "paper",
    "paper-best",
    "paper --extrinsics none --hidden 256 --blocks 2 --norm none --seed 7",
    "paper-best --zero-layer --features 8 --lr-decay none --steps 10 --texture-lr 0.5",
    "paper --extrinsics sh",
    "paper --vgg-weights random --adversarial 0.01 --inpaint",
    "mlp-first --updates 2",
    "light-path --branches 2 --stack 32 --straight-layers 2 --rays 1",
    "light-path --environment 1 --sky-lobes 3 --sky-lr 0.5 --debias 0.5",
    "dnr-authors --features 8 --crop 0",
)


@pytest.mark.parametrize("asked", ASKED)
def test_the_words_of_a_run_ask_for_the_same_run(dataset: Dataset, asked: str) -> None:
    method, *flags = asked.split()
    config = configured(dataset, method, *flags)
    words = words_again(config, open_inputs(config.net, dataset, config.geometry))
    assert configured(dataset, method, *words) == config
    assert set(flags) >= {word for word in words if word.startswith("--")}


def test_what_is_usual_needs_no_words(dataset: Dataset) -> None:
    for asked in ((), ("--seed", "3", "--steps", "10")):
        config = configured(dataset, "paper-best", *asked)
        assert words_again(config, open_inputs(config.net, dataset, config.geometry)) == asked


def test_no_blocks_have_words_although_the_usual_ones_do_not_fit_their_width(dataset: Dataset) -> None:
    for hidden in ((), ("--hidden", "33")):
        config = configured(dataset, "paper", "--blocks", "0", *hidden)
        words = words_again(config, open_inputs(config.net, dataset, config.geometry))
        assert configured(dataset, "paper", *words) == config
