"""The integrator plugin ``aniso_pm``: parameters, Mitsuba's render() contract, statistics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, fields
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm.errors import Unsupported
from aniso_pm.rendering import progressive
from aniso_pm.rendering.controls import Controls
from aniso_pm.rendering.digest import scene_entries
from aniso_pm.rendering.film import pixel_weights as film_weights
from aniso_pm.rendering.layered import develop
from aniso_pm.rendering.pilot import USUAL, automatic_radius
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.schedule import with_passes
from aniso_pm.rendering.settings import Settings
from aniso_pm.rendering.state import Checkpoint


class AnisoPhotonMapper:
    r"""
    .. _integrator-aniso_pm:

    Anisotropic photon mapper (:monosp:`aniso_pm`)
    ----------------------------------------------

    .. pluginparameters::

     * - kernel
       - |string|
       - ``anisotropic``: where an eye path reaches a diffuse surface over an anisotropic glossy
         one, the density-estimation kernel follows the reflection lobe. ``isotropic``: discs
         everywhere, the conventional photon mapper. ``auto``: anisotropic, unless a pilot finds
         that kernels behind lobes make less than a third of the error, so that following lobes
         would not pay for itself; with ``photon_count``, ``initial_radius`` or ``size`` given it is
         always anisotropic. (Default: ``auto``)

     * - rule
       - |string|
       - Shape of the ellipse: ``lobe`` (covariance proportional to the lobe's), ``taylor`` (equal
         relative change of the lobe along both axes) or ``paper`` (the published formula).
         (Default: ``lobe``)

     * - guard
       - |bool|
       - Let no ellipse outgrow the footprint of the lobe that it stands for: narrow footprints get
         a disc. Without it kernels near the reflecting surface reach around objects and darken the
         image. (Default: |true|)

     * - size
       - |string|
       - ``bandwidth``: all kernels have the area of the disc of the current radius. ``epsilon``:
         the literal size of the rule, whatever number of photons that means.
         (Default: ``bandwidth``)

     * - epsilon
       - |float|
       - Relative change of the lobe that defines the axes of ``taylor`` and ``paper``, between
         1e-8 and 10. (Default: 0.02)

     * - max_aspect
       - |float|
       - Largest ratio of a kernel's axes, between 1 and 10,000. (Default: 24)

     * - map
       - |string|
       - ``global``: all indirect light is read from the photon map at the first receiver.
         ``caustic``: the map holds only light that reached a receiver over glass, mirrors and
         glossy surfaces; the rest is path traced, and scenes without caustics have no map.
         ``auto``: a pilot finds out which of the two, or path tracing without any photon, has
         the least error for the time in this scene, ``caustic`` only if that is a quarter less than
         with ``global``; path tracing only if that is a tenth less, if the pilot's eye paths
         have met most of the light of the caustics, or there is next to none, no light is a point
         or a direction, and neither ``photon_count`` nor ``initial_radius`` is given.
         Scenes without surfaces that light is traced over (glass, mirrors, smooth or coated metal)
         are path traced, those with lights that only photons find take ``global``.
         ``statistics["map"]`` tells which it was, or "none", and ``statistics["map_errors"]`` the
         relative mean squared errors that the pilot promised.
         (Default: ``auto``)

     * - final_gather
       - |bool|
       - Read only caustics at the first receiver and everything at the second one: smoother than
         ``map=global`` at the price of longer eye paths. (Default: |false|)

     * - gather_roughness
       - |float|
       - Roughness from which on a glossy surface is a receiver (each of its alphas has to be as
         large), with its BSDF evaluated for every photon; below it paths go on, and only sharp
         caustics are photons' too (where lamps are small, from 0.01 on). At least 0.01; a large
         number leaves receivers to diffuse surfaces and components. (Default: 0.2)

     * - photon_count
       - |int|
       - Light paths per pass. 0 chooses as many as a pilot finds worth their time beside the eye
         samples of a pass, between 10,000 and 5 million; the choice is in
         ``statistics["photon_count"]``. (Default: 0)

     * - passes
       - |int|
       - Number of passes with fresh photons and fresh eye paths; the samples per pixel are the
         total over all passes, shared evenly. 0 is automatic: as many as make passes of 32 samples
         per pixel (below 64 × 64 pixels of 131,072 eye samples) and of 524,288 eye samples at most
         (in large pictures of up to four a pixel, while these are no more than 2,097,152), for
         several small photon maps serve better than a large one; at least 16 in spectral variants;
         one where ``photon_count`` is given.
         Where ``time`` or ``target_error`` ends rendering, 0 is without limit, and each pass takes
         the samples per pixel that are given (at least 8 where only the scene's sampler says how
         many), but no more than above, fewer where it has many light paths, and at
         least one a pixel. (Default: 0)

     * - time
       - |float|
       - Seconds after which rendering ends, as near as whole passes allow. Compilation of kernels
         is not counted; the first pass is always finished. 0 is no limit. (Default: 0)

     * - target_error
       - |float|
       - Rendering ends once the relative standard error of the picture, estimated from the spread
         of at least four passes, is this small: the root of the mean over pixels of
         :math:`\sigma^2/(M^2+f^2)`, with a pixel's mean :math:`M` over its colours, the variance
         :math:`\sigma^2` of that mean, and a tenth :math:`f` of the median of the lit pixels. Noise
         only: bias is not in it. 0 is no target. (Default: 0)

     * - initial_radius
       - |float|
       - Kernel radius r of the first pass in world units: weight exp(-a²-b²) with half axes of
         :math:`|s \times t| = r^2`, cut at :math:`a^2+b^2=4`. 0 chooses the radius at which a
         kernel holds 60 photons, in the median over the light that the camera sees
         (``statistics["initial_radius"]``), and makes kernels narrower where the light that a pilot
         finds is not smooth, wider where it is: 1 to 32 widths of a pixel where the kernel is,
         between four times the radius of the pass and a sixteenth of it in the first sixteen
         passes, 1/(i+1) of it in pass i, counted from 0. (Default: 0)

     * - alpha
       - |float|
       - The kernel's area in pass :math:`i`, counted from 0, is :math:`(i+\alpha)/(i+1)` times that
         of the pass before; above 0 and at most 1. (Default: 2/3)

     * - gather_tolerance
       - |float|
       - Error that the sum over a kernel may have, as a share of the flux inside it, between 0 and
         1: small groups of photons inside a kernel count as one. Kernels of thousands of photons
         gain (twice as fast at 8,000 and 0.2), small ones nothing. Receivers that are not
         Lambertian are summed photon by photon. 0 is the exact sum. (Default: 0)

     * - edge_compensation
       - |bool|
       - Divide each estimate by the share of its kernel that lies on the surface, and end kernels
         at walls that stand on it, both found by short rays. Without it every edge is dark, and
         light leaks along the feet of walls. (Default: |true|)

     * - max_depth
       - |int|
       - Longest path depth, counted as :ref:`path <integrator-path>` does: segments of the whole
         path from light to camera. -1 is unlimited, 1 shows emitters only, 2 adds direct light.
         (Default: -1)

     * - rr_depth
       - |int|
       - Path depth at which Russian roulette begins. Light paths begin theirs after three segments
         at the latest. (Default: 5)

     * - max_memory
       - |float|
       - Memory in GiB that rendering may take beyond what the process holds before. Light paths
         and eye samples are traced in smaller wavefronts where it would be exceeded, which changes
         random numbers but nothing in the mean; what does not fit even so is refused before the
         first pass. An estimate: the peak may be half as much again. 0 takes three quarters of what
         is available, to this process's control group or on the CUDA device. (Default: 0)

     * - layers
       - |string|
       - Layers that are kept beside the picture, separated by commas. Light by how it came, the sum
         of which is the picture: ``direct`` (emitters that are seen, and what they light directly),
         ``caustic`` (over glass, mirrors and smooth metal alone) and ``indirect`` (the rest), each
         at the first receiver that the eye path meets. What is seen: ``albedo`` and ``normal``
         (world space) at that receiver, through mirrors, glass and glossy metal; ``depth``
         (distance from the camera) and ``position`` of the first surface. What was done:
         ``samples`` of each pixel, mean ``radius`` of its kernels (world units), and
         ``standard_error`` (two passes or more). ``denoising`` is what a denoiser needs: picture,
         albedo and normal as a box filter gives them and, from eight passes on, the picture's
         standard error, as the layers ``denoising_picture``, ``denoising_albedo``,
         ``denoising_normal`` and ``denoising_error``, besides ``denoising_filter``, the weights
         of the film's filter. All are in the attribute ``layers``, and in
         the EXR that :monosp:`aniso-pm render` writes. (Default: none)

     * - hide_emitters
       - |bool|
       - Hide directly visible emitters. (Default: |false|)

    Direct light comes from emitter sampling combined with BSDF sampling; of several emitters those
    are asked most that may give most at the place. Everything that reaches a receiver over two path
    segments or more comes from the photon map. Receivers are diffuse surfaces, the diffuse part of
    ``plastic`` and ``roughplastic``, and surfaces whose roughness is at least
    ``gather_roughness``. Photons and eye paths walk on all others, as ``path`` does.

    After ``render()`` the attribute ``statistics`` holds counts and timings, and ``layers`` the
    layers that were asked for, NumPy arrays (height × width × 1 or 3 channels) by name. After two
    passes or more ``variance`` holds the variance of the picture (NumPy array, height × width ×
    channels), estimated from the spread of the passes; its root is the standard error. Passes
    share one stratified sequence, so that their mean is better than their spread says: an upper
    estimate.

    Eye paths take their random numbers from an ``owen_sobol`` sequence that goes on from pass to
    pass, whatever the sampler of the scene, which says only how many samples there are. That number
    is a mean: pixels in which a pilot finds more noise for the work get up to eight times as many,
    others as few as a quarter, with weights that make up for it. Some of the eye paths of a pixel
    read the photon map for all of them, as many as the pilot finds worth their time
    (``statistics["share_of_gathers"]``). Light paths begin where the pilot has seen them matter,
    also with weights (``statistics["aim"]``).

    Before ``render()`` these attributes may be set: ``progress``, a function (done, total, text)
    that is called after each wavefront (see ``aniso_pm.progress.bar``); ``callback``, a function
    (pass_index, image, statistics) that is called after each pass with the picture so far, when
    ``layers`` holds those so far and ``variance`` the estimate after each of the first 20 passes,
    then after every twentieth of their number; ``checkpoint``, an ``aniso_pm.state.Checkpoint``
    that keeps the state of the rendering in a file from which it can be resumed; ``first_pass``,
    the number of the first pass. Pass i is the same whatever passes are rendered before or after
    it, or none; ``elsewhere``, who renders the passes instead of this process (see
    ``aniso_pm.distributed``).

    In spectral variants all photons and eye paths of a pass share four wavelengths, stratified over
    the passes: there should be at least 16.

    .. warning:: Participating media, polarized variants and derivatives are refused. The program
       :monosp:`mitsuba` cannot load plugins written in Python; use
       :monosp:`aniso-pm render`.

    .. tabs::
        .. code-tab:: xml

            <integrator type="aniso_pm">
                <integer name="photon_count" value="500000"/>
                <integer name="passes" value="16"/>
            </integrator>

        .. code-tab:: python

            'type': 'aniso_pm',
            'photon_count': 500_000,
            'passes': 16
    """

    hide_emitters: bool  # set by Mitsuba's own constructor

    def __init__(self, props):
        # Mitsuba's own complaint names neither the value nor what it may be.
        if "hide_emitters" in props and type(props["hide_emitters"]) is not bool:
            raise TypeError(
                'aniso_pm: parameter "hide_emitters" must be of type boolean, '
                f"got {props['hide_emitters']!r}"
            )
        mi.SamplingIntegrator.__init__(self, props)
        for name in ("timeout", "samples_per_pass", "block_size"):
            if name in props:
                raise ValueError(
                    f'aniso_pm: parameter "{name}" is not supported; remove it ("passes" and the '
                    "samples per pixel say how much is rendered)"
                )
        given = {f.name: props[f.name] for f in fields(Settings) if f.name in props}
        self.settings = Settings(**given)
        self.statistics: dict[str, Any] = {}
        self.variance: np.ndarray | None = None
        self.layers: dict[str, np.ndarray] = {}
        self.progress: Callable[[float, int | None, str], None] | None = None
        self.callback: Callable[[int, Any, dict], None] | None = None
        self.checkpoint: Checkpoint | None = None
        self.elsewhere: Callable[[progressive.Run], None] | None = None
        self.first_pass = 0
        self._contained = False  # in another integrator, which may call sample()
        self._last_map: tuple | None = None
        self._exposed: dict[str, Any] = {}

    # --- Mitsuba's interface ---

    def traverse(self, callback):
        """Numbers and switches are reachable through ``mi.traverse``; the names of kernel, rule,
        size and map change through the attribute ``settings``."""
        for name, value in asdict(self.settings).items():
            if not isinstance(value, str):
                array = {bool: mi.Bool, int: mi.Int32, float: mi.Float}[type(value)]
                self._exposed[name] = array(value)
                callback.put(name, self._exposed[name], mi.ParamFlags.NonDifferentiable)

    def parameters_changed(self, keys):
        """Take over what ``mi.traverse`` has changed; ValueError for a value out of range."""
        changed = {name: self._exposed[name][0] for name in keys if name in self._exposed}
        self.settings = self.settings.with_(**changed)

    def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
        """Render the scene; see ``mi.Integrator.render``. With several passes ``spp`` is their
        total, and without a limit to their number that of each."""
        if not isinstance(sensor, mi.Sensor):
            sensors = scene.sensors()
            if not 0 <= int(sensor) < len(sensors):
                raise IndexError(
                    f"aniso_pm: sensor {sensor}: the scene has {len(sensors)}, counted from 0"
                )
            sensor = sensors[int(sensor)]
        self.statistics, self.variance, self._last_map, self.layers = {}, None, None, {}
        with dr.suspend_grad():
            settings = with_passes(self.settings, spp, sensor)
            prepared = prepare(scene, settings, self.hide_emitters)
            so_far = partial(self._so_far, film_weights(sensor.film()))
            controls = Controls(
                self.first_pass,
                self.progress,
                self.callback,
                self.checkpoint,
                so_far,
                spread=self.settings.wants_spread,
                elsewhere=self.elsewhere,
            )
            done = progressive.render(
                prepared, sensor, _as_int(seed), spp, controls, self.statistics
            )
            so_far(done.variance, done.layers, done.passes)
            # Not where the scene holds this integrator: both would live for ever, map and all.
            if done.map and self._contained and scene.integrator() is not self:
                left = (done.scene, done.map, done.radius)
                self._last_map = (self._map_follows_from(scene), left)
            image = sensor.film().develop() if develop else mi.TensorXf()
            if evaluate:
                dr.eval(image)
                dr.sync_thread()
        return image

    def sample(self, scene, sampler, ray, medium=None, active=True):
        """Radiance along rays; see ``mi.SamplingIntegrator.sample``.

        For integrators that contain this one. ``aov`` calls render() and then sample(), which
        uses the map that render() has left, if nothing has changed since; ``moment`` calls
        sample() alone, and each call traces photons of its own.
        """
        (follows_from, left), self._last_map = self._last_map or (None, None), None
        if left is None or follows_from != self._map_follows_from(scene):
            prepared = prepare(scene, self.settings, self.hide_emitters)
            seed = int(mi.UInt32(sampler.next_1d() * 2**24)[0])
            if mi.is_spectral:
                raise Unsupported(
                    "aniso_pm: in spectral variants this integrator cannot be sampled by another "
                    "one that draws wavelengths of its own; render with it directly"
                )
            if self.settings.photon_count == 0:
                prepared = prepared.with_(photon_count=USUAL)
            radius = self.settings.initial_radius or automatic_radius(prepared, ray, seed)
            left = (prepared, prepared.photon_map(seed, 0), radius)
        prepared, map_, radius = left
        seed = int(mi.UInt32(sampler.next_1d() * 2**24)[0])
        seen = prepared.radiance(sampler, ray, map_, dr.opaque(mi.Float, radius), seed)
        return dr.select(active, seen.L, 0), seen.valid & active, []

    def aov_names(self):
        """None; only integrators that contain this one ask."""
        self._contained = True
        return []

    def render_forward(self, *args, **kwargs):
        raise NotImplementedError(_NO_DERIVATIVES)

    def render_backward(self, *args, **kwargs):
        raise NotImplementedError(_NO_DERIVATIVES)

    # --- Ours ---

    def __setattr__(self, name, value):
        if name in _PARAMETERS:
            raise AttributeError(
                f'aniso_pm: "{name}" is a parameter, not an attribute; write '
                f"integrator.settings = integrator.settings.with_({name}={value!r})"
            )
        mi.SamplingIntegrator.__setattr__(self, name, value)

    def _map_follows_from(self, scene):
        return id(scene), scene_entries(scene), self.parameters()

    def _so_far(self, weights, variance, sums, passes):
        names = self.settings.layer_names
        self.variance = variance
        self.layers = {} if sums is None else develop(names, sums, passes, weights)
        if "standard_error" in names and variance is not None:
            self.layers["standard_error"] = np.sqrt(variance[..., :3]).astype(np.float32)

    def stop_after(self, passes: int = 0, time: float = 0.0, target_error: float = 0.0) -> None:
        """Replace the stopping rules by these, whichever comes first; 0 is no limit, and without
        any the number of passes is automatic. Raises ValueError for values out of range."""
        self.settings = self.settings.with_(passes=passes, time=time, target_error=target_error)

    def parameters(self) -> dict[str, Any]:
        """All parameters with their values, as they would be given in a scene."""
        return asdict(self.settings) | {"hide_emitters": self.hide_emitters}

    def to_string(self):
        values = ",\n  ".join(f"{name} = {value}" for name, value in self.parameters().items())
        return f"AnisoPhotonMapper[\n  {values}\n]"


# What is an attribute as well holds the layers that were rendered.
_PARAMETERS = {field.name for field in fields(Settings)} - {"layers"}

_NO_DERIVATIVES = (
    "aniso_pm: derivatives are not supported (density estimation is not differentiable with "
    'respect to where photons land); use "prb" for gradients'
)


def _as_int(seed) -> int:
    return int(mi.UInt32(seed)[0])
