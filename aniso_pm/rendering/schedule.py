"""What pass i takes: bandwidth, samples, wavelengths, each from i and the parameters alone."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mitsuba as mi

from .allotment import FEW, MOST
from .film import pixel_count
from .prepared import COLOUR, stream_seed
from .settings import Settings

# Eye samples of a pass where the number of passes is open: short against any budget. More where
# that would be less than FEW a pixel, up to LARGE_PASS.
OPEN_PASS, LARGE_PASS = 1 << 19, 1 << 21
# Samples of a pixel that have a number, were all pixels to get as many as one may.
LARGEST = int(2**32 / MOST)
# Samples per pixel of such a pass where nobody but the scene's sampler says how many: that of
# Mitsuba takes 4 by itself, and passes so small have up to half again the error after a time.
_SEVERAL = 8
# The most that they take in small pictures, unless these are so small that a pass would not have
# even so many eye samples: what it costs besides would count most.
_SHORT, SMALL_PASS = 32, 1 << 17
# Passes that make the colours of a spectral picture right within about a percent.
SPECTRAL_PASSES = 16


def bandwidth(initial_radius: float, alpha: float, index: int) -> float:
    """Kernel radius of pass ``index`` (0-based): r² of pass i >= 1 is (i + α)/(i + 1) times that of
    the pass before.

    ∏ (i + α)/(i + 1) for i = 1 … index is Γ(index + 1 + α) / (Γ(1 + α) Γ(index + 2)).
    """
    log_area = math.lgamma(index + 1 + alpha) - math.lgamma(1 + alpha) - math.lgamma(index + 2)
    return initial_radius * math.exp(0.5 * log_area)


@dataclass(frozen=True)
class Shares:
    """Samples per pixel of each pass."""

    each: int
    one_more: range  # passes that take one sample more than the others
    text: str

    def __call__(self, index: int) -> int:
        return self.each + (index in self.one_more)

    def before(self, index: int) -> int:
        """Samples per pixel of all passes from number 0 to that before ``index``."""
        more = min(max(index - self.one_more.start, 0), len(self.one_more))
        return index * self.each + more


def sample_count(settings: Settings, spp: int, sensor) -> int:
    """Samples per pixel to be shared: ``spp``, or, if that is 0, those of the sensor's sampler, but
    no fewer than _SEVERAL where passes go on until something ends them."""
    if spp:
        return spp
    count = sensor.sampler().sample_count()
    return max(count, _SEVERAL) if settings.endless else count


def with_passes(settings: Settings, spp: int, sensor) -> Settings:
    """The settings with a number of passes, where it is automatic: one where a number of light
    paths is given for it; else as many as make them as short as those of open end. At least two
    where their spread is asked for, and SPECTRAL_PASSES in spectral variants, if there are so many
    samples.

    spp  as for ``sample_count``.
    """
    if not settings.automatic_passes:
        return settings
    count = sample_count(settings, spp, sensor)
    passes = 2 if "standard_error" in settings.layer_names else 1
    if not settings.photon_count:
        passes = max(passes, -(-count // _most(pixel_count(sensor.film()))))
        if mi.is_spectral:
            passes = max(passes, SPECTRAL_PASSES)
    return settings.with_(passes=max(min(passes, count), 1))


def _most(pixels: int) -> int:
    """Samples per pixel of a pass. All of its gathers meet all of its photons; of several passes
    each has fewer, for the same noise of their mean."""
    short = max(_SHORT, SMALL_PASS // pixels)
    return max(1, min(short, OPEN_PASS // pixels), min(FEW, LARGE_PASS // pixels))


def shares(settings: Settings, spp: int, pixels: int, first_pass: int = 0) -> Shares:
    """How the passes share ``spp`` samples per pixel.

    With a fixed number of passes ``spp`` is the total, shared evenly. With ``passes = 0`` a pass
    takes ``spp`` samples, but no more than _SHORT a pixel or make SMALL_PASS eye samples in all, no
    more than make OPEN_PASS, or FEW a pixel if that is within LARGE_PASS, and at least one.

    Raises ValueError if there are fewer samples than passes, unless time or error may end them.
    """
    passes = settings.passes
    if passes == 0:
        each, rest = min(spp, _most(pixels)), 0
    elif spp >= passes:
        each, rest = divmod(spp, passes)
    elif settings.open_ended:
        each, rest = 1, 0
    else:
        raise ValueError(
            f"aniso_pm: {spp} samples per pixel cannot be shared by {passes} passes; "
            f'raise the sample count to {passes} or lower the parameter "passes"'
        )
    last = first_pass + max(passes, 1)
    if last * (each + bool(rest)) > LARGEST:
        remedy = "take less"
        if first_pass:
            remedy = "count them from a smaller number, with another seed"
        raise ValueError(
            f"aniso_pm: passes {first_pass} to {last - 1} of {each} samples per pixel go beyond "
            f"sample {LARGEST} of a pixel; {remedy}"
        )
    text = f"{spp} by {passes} from pass {first_pass}" if rest else str(each)
    return Shares(each, range(first_pass, first_pass + rest), text)


def wavelength_sample(seed: int, index: int) -> float:
    """Which wavelengths pass ``index`` takes: a van der Corput sequence from a random start. Each
    sample stands for four wavelengths a quarter apart, so it needs to cover a quarter only."""
    start = stream_seed(seed, COLOUR) / 2**32
    sequence = int(f"{index:032b}"[::-1], 2) / 2**32
    return (start + sequence / 4) % 1
