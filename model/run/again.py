"""The words that ask `model train` for a run again."""

import contextlib

from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from datagen.terminal.parsing import flag_words
from model.methods.protocol import Inputs
from model.run.run_folder import TrainConfig


def words_again(config: TrainConfig, inputs: Inputs) -> tuple[str, ...]:
    """The flags to type after `model train METHOD DATASET`: one for each choice that is not usual."""
    usual = config.net.usual(config.geometry)
    optimisation = usual.optimisation()
    with contextlib.suppress(HyalineError):  # What is usual may not fit this dataset; what is asked for does.
        usual = usual.complete(inputs)
    return (
        *([] if config.geometry == TRUTH else ["--geometry", config.geometry]),
        *([] if config.seed == TrainConfig.seed else ["--seed", str(config.seed)]),
        *flag_words(config.net, usual),
        *flag_words(config, optimisation),
    )
