"""Small renderings of one pass."""

import mitsuba as mi
import numpy as np

SMALL = {"type": "aniso_pm", "map": "global", "photon_count": 5000, "initial_radius": 0.1}


def integrator(**parameters):
    return mi.load_dict(SMALL | parameters)


def array(image):
    return np.array(image, dtype=np.float64)


def camera_with_alpha(size):
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba"}
    return {"type": "perspective", "film": film | {"rfilter": {"type": "box"}}}
