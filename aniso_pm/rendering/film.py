"""Camera rays out of a film's pixels, and radiance back into them."""

from __future__ import annotations

import math
import re
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..arrays import own
from .splat import image as weighted

# Points at which a reconstruction filter is looked at.
_STEPS = 1000


def pixel_count(film) -> int:
    """Pixels that are sampled: the crop window, plus the filter's border if the film wants it."""
    width, height = sampled_size(film)
    return width * height


def sample_rays(sensor, sampler, pixel, wavelength):
    """Camera rays of one wavefront: (ray, weight, position on the film).

    pixel       of each lane, row by row through the pixels that are sampled.
    wavelength  the sample in [0, 1) that chooses wavelengths for all of them.
    """
    film = sensor.film()
    width, _ = sampled_size(film)
    row = pixel // width
    corner = mi.Point2i(mi.Int32(pixel - row * width), mi.Int32(row)) - border(film)
    corner += mi.Point2i(mi.ScalarPoint2i(film.crop_offset()))

    position = mi.Point2f(corner) + sampler.next_2d()
    ray, weight = rays_through(sensor, sampler, position, wavelength)
    return ray, weight, position


def rays_through(sensor, sampler, position, wavelength):
    """Camera rays through positions on the film (pixels): (ray, weight)."""
    film = sensor.film()
    scale = mi.ScalarVector2f(1 / film.crop_size().x, 1 / film.crop_size().y)
    normalised = (position - mi.ScalarPoint2f(film.crop_offset())) * scale
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    u = dr.opaque(mi.Float, wavelength)
    ray, weight = sample_ray(sensor, time, u, normalised, aperture)
    return one_each(ray, dr.width(position)), weight


def sample_ray(sensor, time, wavelength, position, aperture):
    """(ray, weight) of a sensor. Mitsuba's integrators ask for ray differentials, so that there are
    sensors which know nothing else (``irradiancemeter``)."""
    ray, weight = sensor.sample_ray_differential(time, wavelength, position, aperture)
    return mi.Ray3f(ray), weight


def one_each(ray, count: int):
    """As many rays: some sensors (``radiancemeter``, ``distant``) give one for all samples, but
    each sample goes a way of its own."""
    if dr.width(ray) == count:
        return ray
    return dr.gather(type(ray), ray, dr.zeros(mi.UInt32, count))


def wavelengths(sensor, u):
    """Wavelengths (nm) that a wavelength sample stands for, the same for all rays of a sensor."""
    centre = mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    ray, _ = sample_ray(sensor, time, mi.Float(u), centre, centre)
    return ray.wavelengths


def splat(film, lanes, position, radiance, valid, wavelengths):
    """One wavefront of samples as the film's own storage has it: TensorXf (height, width,
    channels), weighted by the reconstruction filter, the weight in the last channel.

    valid   alpha is 1 there, else 0.
    """
    alpha = dr.select(valid, mi.Float(1), mi.Float(0))
    if mi.has_flag(film.flags(), mi.FilmFlags.Special):
        count = film.create_block().channel_count()
        channels = film.prepare_sample(radiance, wavelengths, count, mi.Float(1), alpha)
    else:
        rgb = to_rgb(radiance, wavelengths)
        channels = [rgb.x, rgb.y, rgb.z]
        if mi.has_flag(film.flags(), mi.FilmFlags.Alpha):
            channels.append(alpha)
        channels.append(mi.Float(1))
    return weighted(film, lanes, position, channels)


def to_rgb(spectrum, wavelengths):
    """A value of each lane in linear sRGB. wavelengths: nm, in spectral variants."""
    if mi.is_spectral:
        return mi.spectrum_to_srgb(spectrum, wavelengths)
    return mi.Color3f(spectrum.x) if mi.is_monochromatic else spectrum


def begin(film, shown: bool):
    """An empty film. shown: pictures are put into it between passes; then it holds a black one from
    the beginning, because what is frozen is traced anew when a film's memory becomes another."""
    film.prepare([])
    if shown:
        size = film.crop_size()
        show_array(film, np.zeros((size.y, size.x, film.create_block().channel_count())))


def show(film, image):
    """Let the film hold ``image`` (as of :func:`splat`) and nothing else. What is left below zero
    after a few samples (see ``evening``) is black, where nothing but that can be below zero."""
    if not mi.is_spectral and not _undershoots(film.rfilter()):
        image = mi.TensorXf(dr.maximum(image.array, 0), image.shape)
    film.clear()
    film.put_block(mi.ImageBlock(image, mi.ScalarPoint2i(film.crop_offset())))
    film.schedule_storage()
    dr.eval()


def _undershoots(rfilter) -> bool:
    """Has the filter negative lobes?"""
    return dr.any(rfilter.eval(dr.linspace(mi.Float, 0, rfilter.radius(), 64)) < 0)[0]


def show_array(film, array):
    """As :func:`show`, from a NumPy array."""
    show(film, mi.TensorXf(own(mi.Float, array.astype(np.float32)), array.shape))


def describe(film) -> dict[str, Any]:
    """What :func:`from_description` needs to make a film that develops sums as this one would."""
    # Only its text tells the formats, and in short.
    formats = dict(re.findall(r"(pixel_format|component_format) = (\w+)", str(film)))
    long = {"y": "luminance", "ya": "luminance_alpha"}
    formats = {name: long.get(value, value) for name, value in formats.items()}
    return {
        "kind": film.class_name(),
        "size": [int(n) for n in film.size()],
        "crop_size": [int(n) for n in film.crop_size()],
        "crop_offset": [int(n) for n in film.crop_offset()],
        "formats": formats,
        "filter": pixel_weights(film),
    }


def from_description(description: dict[str, Any]):
    """A film without a scene, for the sums of one that was described by :func:`describe`. Raises
    ValueError for other kinds than hdrfilm."""
    if description["kind"] != "HDRFilm":
        raise ValueError(
            f"aniso_pm: the passes were rendered for a {description['kind']}; only those for an "
            "hdrfilm can be developed without their scene"
        )
    # Sums are filtered already. What is left to tell is whether they may be below zero.
    rfilter = "catmullrom" if min(description["filter"]) < 0 else "box"
    (width, height), crop = description["size"], description["crop_size"]
    offset = description["crop_offset"]
    film = mi.load_dict(
        {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "crop_width": crop[0],
            "crop_height": crop[1],
            "crop_offset_x": offset[0],
            "crop_offset_y": offset[1],
            "rfilter": {"type": rfilter},
            **description["formats"],
        }
    )
    film.prepare([])
    return film


def noise_share(film) -> float:
    """Variance of a pixel whose samples the reconstruction filter weights, as a share of that of
    the plain mean of a pixel's own ones: ∫f²/(∫f)² over the plane, in pixels; 1 for a box."""
    rfilter = film.rfilter()
    radius = rfilter.radius()
    x = (dr.arange(mi.Float, _STEPS) + 0.5) * (radius / _STEPS)
    f = np.broadcast_to(rfilter.eval(x).numpy().astype(np.float64), _STEPS)
    return float(((f**2).mean() / f.mean() ** 2 / (2 * radius)) ** 2)


def pixel_weights(film) -> list[float]:
    """Means of the reconstruction filter over whole pixels along a line, normalised, the middle
    one in the middle: [1] for a box."""
    rfilter = film.rfilter()
    reach = math.ceil(rfilter.radius() - 0.5 - 1e-4)
    steps = 2 * reach + 1
    x = (dr.arange(mi.Float, steps * _STEPS) + 0.5) / _STEPS - 0.5 * steps
    f = np.broadcast_to(rfilter.eval(x).numpy(), steps * _STEPS)
    mean = f.reshape(steps, _STEPS).mean(1, dtype=np.float64)
    return (mean / mean.sum()).tolist()


def border(film) -> int:
    """Pixels around the crop window that are sampled."""
    return film.rfilter().border_size() if film.sample_border() else 0


def sampled_size(film) -> tuple[int, int]:
    """(width, height) of the pixels that are sampled."""
    width, height = film.crop_size()
    return width + 2 * border(film), height + 2 * border(film)
