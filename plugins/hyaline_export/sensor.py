"""The depth that a structured-light camera measures where there is glass: holes, and the depth of what is behind.

A projector to the right of the camera casts a pattern. The camera looks for it, and triangulates as if every surface
were opaque and light went straight:

- Opaque surfaces have their own depth.
- Through glass, the camera finds the pattern on what the pixel's refracted path ends on, and takes its depth.
- There are holes where nothing returns: in the sky, in the projector's shadow, where glass dims the pattern (on both
  ways) below `MIN_RETURN`, and where refraction stretches or turns it by more than `MAX_STRETCH`.
- Depth has steps: disparity is measured in eighths of a pixel.

Noise, highlights, and the bending of the projector's own light are left out. The two limits are choices, not measured.

Source: Sajjan et al., "Clear Grasp", ICRA 2020: both errors on glass, missing depth and that of the background.
Khoshelham and Oude Elberink, "Accuracy and Resolution of Kinect Depth Data", Sensors 12(2), 2012: the steps.
"""

import numpy as np
from jaxtyping import Float32

from datagen.quantities import ViewQuantities

BASELINE = 0.075
"""Metres from the camera to the projector, as in the first Kinect."""
STEPS = 8
"""Steps of disparity in a pixel."""
MIN_RETURN = 0.3
"""Least share of the light that has to come through glass, there and back."""
MAX_STRETCH = 0.5
"""Most by which the refractive flow may change from one pixel to the next, in pixels."""
NUM_LAYERS = 8


def sensor_depth(found: ViewQuantities, *, baseline: float = BASELINE) -> Float32[np.ndarray, "h w"]:
    """Measured depth along the camera's viewing axis in metres; 0 in holes. Traces rays: needs Mitsuba."""
    ends, surfaces, camera = found.light_ends, found.surfaces, found.view.camera
    beside = np.pad(ends.flow, ((1, 1), (1, 1), (0, 0)), mode="edge")
    neighbours = (beside[:-2, 1:-1], beside[2:, 1:-1], beside[1:-1, :-2], beside[1:-1, 2:])
    stretch = np.abs(np.subtract(neighbours, ends.flow)).max(axis=(0, -1))
    share = ends.attenuation.mean(axis=-1)
    depth = np.where((stretch <= MAX_STRETCH) & (share**2 >= MIN_RETURN), ends.depth_along_axis, 0)
    depth = np.where(found.glass, depth, found.depth_along_axis)
    place = camera.world_from_camera[:3, 3] + baseline * camera.world_from_camera[:3, 0]
    # From the projector, through glass as if it bent no light, to the first opaque surface.
    towards = np.where(found.glass[..., None], ends.position, found.position).reshape(-1, 3) - place
    distance = np.linalg.norm(towards, axis=-1)
    hits = surfaces.peeler.trace(place.astype(np.float32), (towards / distance[:, None]).astype(np.float32), NUM_LAYERS)
    ids = surfaces.peeler.object_ids[hits.shape + 1]
    is_opaque = (ids > 0) & ~surfaces.is_glass[ids]
    blocks = is_opaque & (hits.t < 0.999 * distance - 1e-3)
    depth = np.where((depth > 0) & ~blocks.any(axis=0).reshape(depth.shape), depth, 0)
    at_a_metre = camera.focal * baseline
    disparity = np.rint(STEPS * at_a_metre / np.where(depth > 0, depth, np.inf)) / STEPS
    return np.where(disparity > 0, at_a_metre / np.maximum(disparity, 1 / STEPS), 0).astype(np.float32)
