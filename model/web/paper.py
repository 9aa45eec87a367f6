"""`paper` as the page draws it: what paper.glsl reads."""

from model.methods.paper.config import PaperConfig
from model.methods.paper.renderer import PaperRenderer
from model.nets.cpu.fused_mlp import fold
from model.settings.network_parts import EXTRINSIC_CHANNELS
from model.web.drawn import Drawn
from model.web.texels import fours
from model.web.weights import feature_columns, layer_rows

SHADERS = ("rays.glsl", "networks.glsl", "paper.glsl", "picture.glsl")


def draw_paper(renderer: PaperRenderer, config: PaperConfig) -> Drawn:
    """The renderer; a layer of zeros behind all others changes nothing, and is left out."""
    features, told = config.texture_features, EXTRINSIC_CHANNELS[config.extrinsics]
    first, *others = [fold(layer) for layer in renderer.net.layers()]
    num_layers = first.weight.shape[1] // (features + told) - config.zero_layer
    columns = [at for layer in range(num_layers) for at in feature_columns(features, told, layer * (features + told))]
    return Drawn(
        shaders=SHADERS,
        defines={
            "LIGHT_PATH": 0,
            "NORMALS": 0,
            "RELIEF": 0,
            "LAYERS_SEEN": num_layers,
            "EXTRINSICS": told,
            "WIDTH": config.width,
            "BLOCKS": config.blocks,
            "NESTED": 0,
        },
        textures=renderer.textures,
        features=fours(config.texture_features),
        weights=[
            *layer_rows(first.weight, first.bias, columns),
            *(rows for layer in others for rows in layer_rows(layer.weight, layer.bias)),
        ],
        samples=config.render_samples,
        knows_materials=False,
    )
