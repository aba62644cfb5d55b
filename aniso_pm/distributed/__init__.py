"""One picture on many machines: its passes rendered by the workers of a Dask cluster.

Pass i is a function of scene, parameters, seed and i, and passes add up. Here workers of
``dask.distributed`` (the extra ``aniso_pm[distributed]``) render them, several in a task, and add
them up among themselves; the client keeps the ledger of pass numbers, the state on disk and the
picture. Scheduling, transport and failure detection are Dask's.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from aniso_pm.errors import Failed, InputError, one_line
from aniso_pm.rendering.state import Checkpoint

from .cluster import require
from .dispatch import Elsewhere
from .options import Options
from .parcel import Parcel

__all__ = ["Elsewhere", "Options", "Parcel", "Result", "render"]


@dataclasses.dataclass(frozen=True)
class Result:
    """A picture rendered elsewhere.

    image       height × width × channels, as the film develops it.
    variance    of the picture (height × width × channels), None after one pass.
    statistics  as an integrator's.
    layers      that the integrator was asked for, by their names.
    """

    image: np.ndarray
    variance: np.ndarray | None
    statistics: dict[str, Any]
    layers: dict[str, np.ndarray]


def render(
    scene: str | Path | Mapping[str, Any],
    client,
    *,
    spp: int = 0,
    seed: int = 0,
    passes: int = 0,
    time: float = 0.0,
    target_error: float = 0.0,
    first_pass: int = 0,
    sensor: int = 0,
    defines: Mapping[str, str] | None = None,
    checkpoint: Checkpoint | None = None,
    progress: Callable[[float, int | None, str], None] | None = None,
    callback: Callable[[int, Any, dict], None] | None = None,
    options: Options | None = None,
):
    """Render a scene on the workers of ``client`` (a ``distributed.Client``).

    scene     an XML file, or a dictionary as ``mi.load_dict`` takes it; its integrator is an
              ``aniso_pm``. It travels with all the files that it names.
    spp       samples per pixel in all, of each pass where their number is open; 0: the scene's.
    passes, time, target_error  as ``stop_after`` takes them; if none is given, the scene's.
    defines   values of the parameters of an XML scene.
    callback  called after each batch of passes that comes home, with the number of its last.
    options   how to use the cluster.

    Returns a Result, or something to await where the client is asynchronous. Ctrl-C ends it with
    the picture so far, ``statistics["interrupted"]`` being true. The variant is the one that is
    set.

    Raises InputError for a scene that cannot be loaded or sent, ``Failed`` where workers or
    scheduler are gone: with the picture so far, if there is one, as the attribute ``result``.
    """
    require()
    arguments = dict(locals())
    arguments.pop("client")
    if client.asynchronous:
        return _awaited(client, arguments)
    return _render(client, **arguments)


async def _awaited(client, arguments) -> Result:
    """In a thread, with a blocking client of its own to the same scheduler."""
    from distributed import Client

    def blocking() -> Result:
        address, security = client.scheduler.address, client.security
        with Client(address, security=security, set_as_default=False) as own:
            return _render(own, **arguments)

    return await asyncio.to_thread(blocking)


def _render(
    client, scene, sensor, defines, seed, spp, options, passes, time, target_error, **attributes
) -> Result:
    defines = dict(defines or {})
    parcel = Parcel.of(scene, defines)
    try:
        # Unmerged: merged meshes come in the order of their addresses.
        if isinstance(scene, Mapping):
            world = mi.load_dict(dict(scene), optimize=False)
        else:
            world = mi.load_file(str(scene), optimize=False, **defines)
    except RuntimeError as error:
        raise InputError(one_line(error)) from error
    integrator = world.integrator()
    if not hasattr(integrator, "elsewhere"):
        kind = integrator.class_name() if integrator else "none"
        raise InputError(f"only aniso_pm renders on workers; the scene's integrator is {kind}")
    if passes or time or target_error:
        integrator.stop_after(passes, time, target_error)
    for name, value in attributes.items():
        setattr(integrator, name, value)
    integrator.elsewhere = Elsewhere(client, parcel, sensor, options)
    image = integrator.render(world, sensor=sensor, seed=seed, spp=spp)
    result = Result(np.array(image), integrator.variance, integrator.statistics, integrator.layers)
    if failure := result.statistics.get("failure"):
        failed = Failed(
            f"{failure}; {result.statistics['passes']} passes are in the picture so far"
        )
        failed.result = result  # type: ignore[attr-defined]
        raise failed
    return result
