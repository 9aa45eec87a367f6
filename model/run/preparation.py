"""What a run has before its first step: the renderer, its record, the views to train on."""

import torch

from datagen.data.geometries import NO_GEOMETRY
from datagen.disk.errors import HyalineError
from model.batches.distributed import Processes
from model.batches.pixel_cache import choose_memory
from model.batches.rays import PixelSource
from model.methods.protocol import Inputs
from model.methods.renderer import ParameterGroup, Renderer
from model.run.again import words_again
from model.run.run_folder import RUN_VERSION, RunRecord, TrainConfig, describe_knowledge
from model.settings.run_flags import Memory


def check_inpainting(config: TrainConfig) -> None:
    """Raises a HyalineError where in-painting is asked for and cannot tell which texels training visits."""
    if config.loss.inpaint and config.net.traces_layers:
        raise HyalineError(
            "inpaint: counts which texels the stored layers' rays visit; expected paper with one ray "
            "per pixel, or another method that reads straight layers"
        )


def build_renderer(config: TrainConfig, inputs: Inputs, *, device: torch.device) -> Renderer:
    """The network and textures before any step; their numbers depend on the seed alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        renderer = config.net.build(inputs)
    return renderer.to(device)


def count_parameters(groups: list[ParameterGroup]) -> dict[str, int]:
    """How many numbers the network has, and its textures."""
    return {
        kind: sum(value.numel() for group in groups if group.counts_as == kind for value in group.parameters)
        for kind in ("network", "textures")
    }


def describe_run(config: TrainConfig, inputs: Inputs, *, label: str, num_parameters: dict[str, int]) -> RunRecord:
    """The record of a run: what is trained on what."""
    method, dataset = config.net, inputs.dataset
    knowledge = method.knowledge
    if method.uses_geometry:
        knowledge = describe_knowledge(dataset, config.geometry, method.knowledge, config.loss.describe())
    return RunRecord(
        version=RUN_VERSION,
        method=config.method,
        geometry=config.geometry if method.uses_geometry else NO_GEOMETRY,
        knowledge=knowledge,
        dataset=dataset.root.as_posix(),
        dataset_seal=dataset.seal,
        layers_seal=inputs.layers_seal,
        seed=config.seed,
        num_parameters=num_parameters["network"],
        num_texture_parameters=num_parameters["textures"],
        num_layers=inputs.num_layers or None,
        label=label,
        config=config,
        flags=words_again(config, inputs),
        torch=torch.__version__,
    )


def choose_held_out(num_views: int, at_most: int) -> list[int]:
    """The training views that only measure: evenly spread, and no more than a fifth of all."""
    number = min(at_most, num_views // 5)
    return [(2 * index + 1) * num_views // (2 * number) for index in range(number)]


def load_training(
    config: TrainConfig, inputs: Inputs, views: list[int], *, processes: Processes, memory: Memory, device: torch.device
) -> PixelSource:
    """The pixels of the views to train on, in memory or mapped from a cache on disk."""
    method = config.net
    is_mapped = choose_memory(
        memory,
        num_pixels=len(views) * inputs.dataset.config.resolution.pixels,
        num_layers=0 if method.traces_layers else inputs.num_layers,
        processes=processes.count_here,
        device=device,
    )
    if not is_mapped:
        return method.load(inputs, "train", views, with_images=True).to(device)
    with processes.in_turn():
        return method.load(inputs, "train", views, with_images=True, mapped=True).to(device)
