"""The sampler plugin ``owen_sobol``: an Owen-scrambled Sobol sequence that goes on over passes."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


class OwenSobol:
    r"""
    .. _sampler-owen_sobol:

    Owen-scrambled Sobol sampler (:monosp:`owen_sobol`)
    ---------------------------------------------------

    .. pluginparameters::

     * - sample_count
       - |int|
       - Samples per pixel, any number; powers of two are best. (Default: 4)

     * - seed
       - |int|
       - Offset of the seed. (Default: 0)

    Pairs of dimensions are (0, 2)-sequences in base 2, shuffled and scrambled for every pixel and
    pair by hashes [Burley 2020]: every power of two of consecutive samples is stratified, and the
    sequence has no end. ``advance`` goes on with it. In Python ``begin`` takes the place of
    ``seed`` where lanes shall stand for other pixels and samples: the sequence of a pixel can be
    taken in parts, by one process or by several.

    .. tabs::
        .. code-tab:: xml

            <sampler type="owen_sobol">
                <integer name="sample_count" value="64"/>
            </sampler>

        .. code-tab:: python

            'type': 'owen_sobol',
            'sample_count': 64
    """

    def __init__(self, props):
        mi.Sampler.__init__(self, props)
        self._props = mi.Properties(props)
        self._base_seed = int(props.get("seed", 0))
        self._per_wavefront = 0  # as many as sample_count
        self._width = 0
        self.index = mi.UInt32(0)  # Of the sample in its pixel's sequence
        self.random = mi.UInt32(0)  # Of the pixel
        self.dimension = mi.UInt32(0)

    # --- Mitsuba's interface ---

    def fork(self):
        made = type(self)(self._props)
        made.set_sample_count(self.sample_count())
        made._per_wavefront = self._per_wavefront
        return made

    def clone(self):
        made = self.fork()
        made._width = self._width
        made.index, made.random = mi.UInt32(self.index), mi.UInt32(self.random)
        made.dimension = mi.UInt32(self.dimension)
        return made

    def set_samples_per_wavefront(self, spp):
        self._per_wavefront = int(spp)

    def wavefront_size(self):
        return self._width

    def seed(self, seed, wavefront_size=0xFFFFFFFF):
        if wavefront_size != 0xFFFFFFFF:
            self._width = wavefront_size
        lane = dr.arange(mi.UInt32, self._width)
        each = dr.opaque(mi.UInt32, self._each)
        pixel = lane // each
        self.begin(seed, pixel, lane - pixel * each)

    def begin(self, seed, pixel, sample):
        """Each lane at sample number ``sample`` of the sequence of its ``pixel`` (UInt32)."""
        self._width = max(dr.width(pixel), dr.width(sample))
        self.index = mi.UInt32(sample)
        # Evaluated, so that it is no part of the kernel's code.
        seed = mi.UInt32(seed) + self._base_seed
        dr.make_opaque(seed)
        self.random = mi.sample_tea_32(pixel, seed)[0]
        self.dimension = mi.UInt32(0)
        dr.eval(self.index, self.random)

    def advance(self):
        self.index += dr.opaque(mi.UInt32, self._each)
        self.dimension = mi.UInt32(0)

    def schedule_state(self):
        dr.schedule(self.index, self.random, self.dimension)

    def next_1d(self, active=True):
        a, b, _ = self._next()
        return _unit(_scrambled(dr.brev(_scrambled(self.index, a)), b))

    def next_2d(self, active=True):
        a, b, c = self._next()
        index = _scrambled(self.index, a)
        return mi.Point2f(
            _unit(_scrambled(dr.brev(index), b)), _unit(_scrambled(_second(index), c))
        )

    @property
    def _each(self) -> int:
        """Samples of a pixel in a wavefront. Mitsuba's integrators take all without telling."""
        return self._per_wavefront or self.sample_count()

    def _next(self):
        """Three random numbers of pixel and dimension."""
        a, b = mi.sample_tea_32(self.random, self.dimension, 4)
        self.dimension += 1
        return a, b, a ^ (b * 0x9E3779B9 + 0x7F4A7C15)

    def to_string(self):
        return f"OwenSobolSampler[\n  sample_count = {self.sample_count()}\n]"


def _scrambled(x, seed):
    """A random Owen scrambling: every bit is flipped depending on those above it [Laine and Karras
    2011, with the constants of Vegdahl 2021]."""
    x = dr.brev(x)
    x ^= x * 0x3D20ADEA
    x += seed
    x *= (seed >> 16) | 1
    x ^= x * 0x05526C56
    x ^= x * 0x53A22864
    return dr.brev(x)


def _second(index):
    """The second coordinate of Sobol's sequence: Pascal's triangle modulo 2 times the bits."""
    v = dr.brev(index)
    v ^= v << 16
    v ^= (v & 0x00FF00FF) << 8
    v ^= (v & 0x0F0F0F0F) << 4
    v ^= (v & 0x33333333) << 2
    v ^= (v & 0x55555555) << 1
    return v


def _unit(bits):
    """[0, 1): 24 bits, which single precision holds exactly."""
    return mi.Float(bits >> 8) * 2.0**-24
