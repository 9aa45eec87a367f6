"""What a run needs before its first step: settings of the process, its renderer, its record."""

from collections.abc import Mapping

import torch

from datagen.data.config import Resolution
from datagen.data.dataset import Dataset
from datagen.data.geometries import NO_GEOMETRY, read_materials
from datagen.data.paths import is_fitted
from datagen.disk.errors import HyalineError
from model.methods.protocol import Inputs
from model.methods.renderer import ParameterGroup, Renderer
from model.run.run_folder import RUN_VERSION, RunRecord, TrainConfig, describe_knowledge
from model.runtime import keep_freed_memory, sum_in_order_on_gpus, use_few_threads
from model.settings import LEAST_PATCH, PixelOptimisation


def check_losses(config: TrainConfig, resolution: Resolution) -> None:
    """Raises a HyalineError if the method cannot be trained with the losses that were asked for."""
    crop = getattr(config.net, "crop", None)  # Of U-Nets; 0: whole pictures.
    side = min(config.loss.patch if crop is None else crop or resolution.shorter, resolution.shorter)
    if config.loss.adversarial and side < LEAST_PATCH:
        raise HyalineError(
            f"adversarial: patches are {side} pixels wide; the discriminator needs at least {LEAST_PATCH}, so use "
            "larger crops or pictures"
        )
    if config.loss.inpaint or config.loss.vgg != "vgg16":
        raise HyalineError("loss: is one of an earlier version, with in-painting or VGG19; train without them")


def prepare_processor(config: TrainConfig, device: torch.device) -> None:
    """Settings of this process for training."""
    keep_freed_memory()
    if device.type == "cuda":
        sum_in_order_on_gpus()
    if isinstance(config.net.optimisation(), PixelOptimisation):
        use_few_threads(config.batch // config.updates)


def build_renderer(config: TrainConfig, inputs: Inputs, *, device: torch.device) -> Renderer:
    """The network and textures before any step; their values depend only on the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        renderer = config.net.build(inputs)
    return renderer.to(device)


def count_parameters(groups: list[ParameterGroup]) -> dict[str, int]:
    """The number of parameters in the network and in its textures."""
    return {
        kind: sum(value.numel() for group in groups if group.counts_as == kind for value in group.parameters)
        for kind in ("network", "textures")
    }


def describe_run(
    config: TrainConfig, inputs: Inputs, *, label: str, flags: Mapping[str, str], num_parameters: dict[str, int]
) -> RunRecord:
    """The content of run.json."""
    method, dataset = config.net, inputs.dataset
    knowledge = method.knowledge
    told: tuple[str, ...] = ()
    if method.uses_geometry:
        told = _told(config, dataset) if is_fitted(config.geometry) else ()
        materials = method.knowledge if told or not is_fitted(config.geometry) else ""  # Else a fit has found them.
        knowledge = describe_knowledge(dataset, config.geometry, materials, config.loss.describe())
    return RunRecord(
        version=RUN_VERSION,
        method=config.method,
        geometry=config.geometry if method.uses_geometry else NO_GEOMETRY,
        knowledge=knowledge,
        uses_materials=method.uses_geometry and bool(method.knowledge),
        told=told,
        dataset=dataset.root.as_posix(),
        dataset_seal=dataset.seal,
        layers_seal=inputs.layers_seal,
        seed=config.seed,
        num_parameters=num_parameters["network"],
        num_texture_parameters=num_parameters["textures"],
        num_layers=inputs.num_layers or None,
        label=label,
        config=config,
        flags=dict(flags),
        torch=torch.__version__,
    )


def _told(config: TrainConfig, dataset: Dataset) -> tuple[str, ...]:
    """Names of the objects of which a fitted geometry tells the method more than `model fit` found."""
    from datagen.scene.folder import open_scene  # Not before: training on other geometries needs no scene.
    from datagen.scene.materials import Diffuse

    uses_materials = bool(config.net.knowledge)
    materials = [item.material for item in open_scene(dataset, config.geometry).objects]
    found = read_materials(dataset, config.geometry)
    return tuple(
        item.name
        for item, material in zip(dataset.objects, materials, strict=True)
        if item.name not in found and (item.is_glass or (uses_materials and not isinstance(material, Diffuse)))
    )
