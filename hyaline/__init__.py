"""hyaline from Python: scenes of transparent objects, path-traced datasets of them, methods that learn from these.

    scene = hy.Scene(objects=[hy.Object("vase", mesh, hy.Dielectric(ior=1.5)), ...])
    dataset = hy.build(scene, "data/vase", preset="demo")
    proxies = hy.make_proxies(dataset, "ellipsoid")
    run = hy.train("light-path", dataset, steps=500)
    hy.report([run])
    layers = hy.layers(dataset, camera)

>>> import hyaline as hy
>>> dataset = hy.open_dataset("glass_table")            # data/glass_table, or a folder
>>> view = dataset.view("interpolating", 0)
>>> view.image.shape, view.image.dtype                  # h w 3, 8-bit sRGB
((32, 32, 3), dtype('uint8'))
>>> view.layers().object_id.shape                       # layer h w, nearest first; 0 where a layer is empty
(4, 32, 32)
>>> hy.score(view.image, view.image).psnr_db
inf

Lengths are metres, +z is up, cameras are world_from_camera in the OpenGL convention. Everything is read from disk when
it is accessed, and verified by its checksum. Whatever is wrong raises a `HyalineError`, which says what to do.
Everything is imported when it is first used: `__init__.pyi` lists all names and their homes.
"""

import lazy_loader

from datagen.terminal.plugins import VERSION, naming_parts

__version__ = VERSION

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """What the stub lists by this name; where a part of the distribution is missing, the error says how to get it."""
    with naming_parts(f"hyaline.{name}"):
        return _load(name)
