"""The words that ask `model train` for a run again."""

import contextlib
import dataclasses

from datagen.data.paths import TRUTH
from datagen.disk.errors import HyalineError
from model.methods.protocol import Inputs
from model.run.run_folder import TrainConfig
from model.settings.flags import words_of


def words_again(config: TrainConfig, inputs: Inputs) -> tuple[str, ...]:
    """What has to stand behind `model train METHOD --dataset DATASET`: a flag for each choice that is not usual."""
    kind = type(config.net)
    presets = [item.name for item in dataclasses.fields(kind) if item.metadata.get("is_preset")]
    usual = kind(**{name: getattr(config.net, name) for name in presets}).usual(config.geometry)
    optimisation = usual.optimisation()
    with contextlib.suppress(HyalineError):  # What is usual may not fit this dataset; what is asked for does.
        usual = usual.complete(inputs)
    return (
        *([] if config.geometry == TRUTH else ["--geometry", config.geometry]),
        *([] if config.seed == TrainConfig.seed else ["--seed", str(config.seed)]),
        *words_of(config.net, usual),
        *words_of(config, optimisation),
    )
