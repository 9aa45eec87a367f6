"""Tests that an imported Mitsuba scene looks, from its own sensor, as Mitsuba itself renders its file."""

import math
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from datagen.data.cameras import Cameras, look_at
from datagen.data.images import srgb_from_linear
from datagen.machine.mitsuba_variant import use_mitsuba
from datagen.render.truth import Renderer, render_view
from datagen.scene.finding import ImportChoices
from hyaline_import.importing import import_scene

WIDTH, HEIGHT = 30, 20
SPP = 256
SENSOR = f"""<integrator type="volpath"><integer name="max_depth" value="24"/><integer name="rr_depth" value="50"/>
</integrator><sensor type="perspective"><float name="fov" value="42"/><string name="fov_axis" value="smaller"/>
<transform name="to_world"><lookat origin="1.2,-4,2.2" target="0.1,0,0.4" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="{WIDTH}"/><integer name="height" value="{HEIGHT}"/>
<rfilter type="box"/></film></sensor>"""
MAP = '<texture type="bitmap" name="{}"><string name="filename" value="wood.png"/></texture>'
INDICES = '<float name="int_ior" value="1.5"/><float name="ext_ior" value="1"/>'
GGX = '<string name="distribution" value="ggx"/><float name="alpha" value="0.2"/>'
FLOOR = f"""<shape type="rectangle" id="floor"><transform name="to_world"><scale value="2.5"/></transform>
<bsdf type="diffuse">{MAP.format("reflectance")}</bsdf></shape>"""
BALL = """<shape type="sphere" id="{}"><point name="center" x="{}" y="{}" z="0.52"/>
<float name="radius" value="0.5"/>{}</shape>"""
MEDIUM = """<medium name="interior" type="homogeneous"><rgb name="sigma_t" value="0.1,0.4,0.8"/>
<float name="scale" value="3"/>
<float name="albedo" value="0"/></medium>"""
SKY = '<emitter type="constant"><rgb name="radiance" value="0.3,0.35,0.4"/></emitter>'
LAMP = """<shape type="rectangle"><transform name="to_world"><scale value="0.8"/><rotate x="1" angle="180"/>
<translate x="-1" y="-1" z="3.5"/></transform>
<emitter type="area"><rgb name="radiance" value="6,5.5,5"/></emitter></shape>"""
CASES = {
    "glass with absorption, and thin": LAMP
    + SKY
    + BALL.format("ball", -0.6, 0, f'<bsdf type="dielectric">{INDICES}</bsdf>{MEDIUM}')
    + f"""<shape type="rectangle" id="pane"><transform name="to_world"><scale value="0.5"/><rotate x="1" angle="90"/>
<translate x="0.9" y="-0.3" z="0.6"/></transform><bsdf type="thindielectric">{INDICES}</bsdf></shape>""",
    "rough glass and rough metal": LAMP
    + SKY
    + BALL.format("frosted", -0.6, 0, f'<bsdf type="roughdielectric">{INDICES}{GGX}</bsdf>')
    + BALL.format(
        "metal",
        0.7,
        0.2,
        f'<bsdf type="roughconductor">{GGX}<string name="material" value="none"/>'
        '<rgb name="specular_reflectance" value="0.9,0.6,0.3"/></bsdf>',
    ),
    "a lamp, plastic and a mirror": LAMP
    + SKY
    + BALL.format(
        "plastic",
        -0.6,
        0,
        f'<bsdf type="twosided"><bsdf type="roughplastic">{INDICES}{GGX}<boolean name="nonlinear" value="true"/>'
        '<rgb name="diffuse_reflectance" value="0.1,0.3,0.6"/></bsdf></bsdf>',
    )
    + BALL.format("mirror", 0.7, 0.2, '<bsdf type="conductor"><string name="material" value="none"/></bsdf>'),
}


def write_picture(folder: Path) -> None:
    """A coarse picture."""
    y, x = np.mgrid[:32, :32]
    rings = 0.5 + 0.4 * np.sin(0.7 * x + 0.2 * y)
    picture = (255 * np.stack([rings, 0.8 * rings, 0.2 + 0.4 * y / 32], axis=-1)).astype(np.uint8)
    Image.fromarray(picture).save(folder / "wood.png")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.full if name.startswith("glass") else ()) for name in CASES]
)
def test_a_file_looks_from_its_own_sensor_as_mitsuba_renders_it(name: str, tmp_path: Path) -> None:
    use_mitsuba()
    import mitsuba as mi

    write_picture(tmp_path)
    path = tmp_path / "scene.xml"
    path.write_text(f'<scene version="3.0.0">{SENSOR}{FLOOR}{CASES[name]}</scene>')
    scene = import_scene(path, ImportChoices()).scene
    pose = look_at(np.array([1.2, -4, 2.2]), np.array([0.1, 0, 0.4]))[None]
    fov_x = 2 * math.atan(math.tan(math.radians(21)) * WIDTH / HEIGHT)
    cameras = Cameras(world_from_camera=pose, fov_x=fov_x, width=WIDTH, height=HEIGHT)
    ours = render_view(Renderer(scene, max_depth=24), cameras, 0, spp=SPP, view_seed=0, ceiling_db=None).radiance
    theirs = np.array(mi.render(mi.load_file(str(path)), spp=SPP), np.float64)[..., :3]
    pictures = [srgb_from_linear(np.asarray(picture, np.float64)) for picture in (ours, theirs)]
    assert pictures[1].std() > 0.1
    assert -10 * np.log10(np.mean((pictures[0] - pictures[1]) ** 2)) > 35
