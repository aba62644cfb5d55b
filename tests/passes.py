"""Renderings of a few small passes, for the tests of passes and of their states."""

import mitsuba as mi
import numpy as np
from rooms import room_with_plate

SMALL = {"type": "aniso_pm", "map": "global", "photon_count": 3000, "initial_radius": 0.15}


def integrator(**parameters):
    return mi.load_dict(SMALL | parameters)


def load(size=8, filter_="box", make=room_with_plate):
    definition = make(size)
    definition["sensor"]["film"]["rfilter"] = {"type": filter_}
    # Merged meshes come in the order of their addresses, and random decisions with them.
    return mi.load_dict(definition, optimize=False)


def render(scene, plugin, spp, seed=1, first_pass=0, checkpoint=None):
    plugin.first_pass, plugin.checkpoint = first_pass, checkpoint
    return np.array(plugin.render(scene, seed=seed, spp=spp), dtype=np.float64)


def close(a, b):
    """Equal up to the order of float sums, in which threads add photons and samples."""
    np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4)
