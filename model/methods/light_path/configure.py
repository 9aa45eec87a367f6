"""From what a user chose to the configuration of `light-path`."""

import dataclasses

from datagen.data.dataset import Dataset
from datagen.data.paths import TRUTH
from model.methods.light_path.config import LightPathConfig, default_light_path
from model.methods.light_path.pixels import share_texels
from model.settings.choices import LightPathChoices


def configure_light_path(
    choices: LightPathChoices,
    dataset: Dataset,
    geometry: str,
    num_layers: int,  # noqa: ARG001
) -> LightPathConfig:
    """The configuration that a user's choices make on a dataset; paths are traced to see how texels are shared.

    Raises:
        HyalineError: a choice that cannot be.
    """
    sizes = share_texels(dataset, geometry, choices.texture_size or dataset.config.resolution)
    known = default_light_path(sizes, is_proxy=geometry != TRUTH)
    refined = choices.refined_rays
    if refined is None:  # Who asks for a number of rays gets that many.
        refined = known.refined_samples if choices.render_rays is None else choices.render_rays
    return dataclasses.replace(
        known,
        texture_levels=choices.texture_levels,
        sees_directions=known.sees_directions if choices.directions is None else choices.directions == "on",
        position_octaves=choices.position_octaves,
        composite=choices.compositing == "physics",
        stack_hidden=known.stack_hidden if choices.stack is None else choices.stack,
        straight_layers=known.straight_layers if choices.straight_layers is None else choices.straight_layers,
        shells=known.shells if choices.shells is None else choices.shells,
        relief=known.relief if choices.relief is None else choices.relief == "on",
        environment_size=choices.environment,
        sky_lobes=0 if choices.environment == 1 else choices.sky_lobes,
        branches=choices.branches,
        train_samples=known.train_samples if choices.rays is None else choices.rays,
        paired_rays=choices.debias > 0,
        render_samples=known.render_samples if choices.render_rays is None else choices.render_rays,
        refined_samples=refined,
    )
