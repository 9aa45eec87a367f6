"""The web page of `paper` and `mlp-first`: what paper.glsl reads."""

from datagen.scene.description import Scene
from model.methods.page import MethodPage, feature_columns, layer_rows, package_text
from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.nets.cpu.fused_mlp import fold
from model.settings.network_parts import EXTRINSIC_CHANNELS


def draw_page(config: PaperConfig, renderer: PaperRenderer, scene: Scene) -> MethodPage:  # noqa: ARG001
    """The renderer; a layer of zeros behind all others changes nothing, and is left out."""
    features, told = config.texture_features, EXTRINSIC_CHANNELS[config.extrinsics]
    first, *others = [fold(layer) for layer in renderer.net.layers()]
    num_layers = first.weight.shape[1] // (features + told) - config.zero_layer
    columns = [at for layer in range(num_layers) for at in feature_columns(features, told, layer * (features + told))]
    return MethodPage(
        shader=package_text("model.methods.paper", "paper.glsl"),
        defines={"LAYERS_SEEN": num_layers, "EXTRINSICS": told, "WIDTH": config.width, "BLOCKS": config.blocks},
        textures=renderer.textures,
        weights=[
            *layer_rows(first.weight, first.bias, columns),
            *(rows for layer in others for rows in layer_rows(layer.weight, layer.bias)),
        ],
        samples=config.render_samples,
    )
