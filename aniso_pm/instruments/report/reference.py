"""References: pictures by an independent unbiased integrator, and how far they can be trusted.

A reference is two pictures of the same scene with different random numbers and equally many
samples. Their mean R is the reference. Half their difference, d = (R1 − R2)/2, has the variance of
R's own error, pixel by pixel, whatever its cause; and since R1 and R2 are independent, the mean of
(I − R1)(I − R2) is the squared error of a picture I without that of the reference.

On disk a reference is an OpenEXR file with the layers ``first`` and ``second`` and, in its header,
what made it and what it depends on (:func:`depends_on`): scene, camera, film, ``max_depth`` and
``hide_emitters``. Nothing else of the scene's own integrator is in that, nor the number of samples.
:func:`find` looks for one that fits beside the scene, then in the cache.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from aniso_pm.errors import InputError, one_line
from aniso_pm.instruments.doctor import versions
from aniso_pm.pictures import output
from aniso_pm.rendering import digest

# Samples traced at once, and samples per pixel at once: two waves are what a reference grows by.
_LANES = 1 << 20
_MOST = 64
_UNLIMITED = 0xFFFFFFFF


@dataclass(frozen=True)
class Reference:
    """A reference picture.

    mean             height × width × 3, double precision, linear colours R, G, B.
    half_difference  of the same shape: (first − second)/2.
    record           what made it: ``integrator``, ``seed``, ``spp`` (samples per pixel, both halves
                     together), ``seconds``, ``waves``, ``variant``, ``versions``, ``depends_on``.
    path             the file it was read from, None where it was made now.
    """

    mean: np.ndarray
    half_difference: np.ndarray
    record: dict[str, Any]
    path: Path | None = None

    @property
    def halves(self) -> tuple[np.ndarray, np.ndarray]:
        """The two independent pictures."""
        return self.mean + self.half_difference, self.mean - self.half_difference

    @property
    def own_error(self) -> float:
        """Relative RMSE of the mean, √ mean d²/(R² + 0.01), estimated from the halves."""
        return relative_rmse(self.half_difference, self.mean)


def relative_rmse(difference: np.ndarray, reference: np.ndarray) -> float:
    """√ mean d²/(R² + 0.01): every pixel counts by its relative error, dark ones do not explode."""
    return float(np.sqrt(np.mean(difference**2 / (reference**2 + 0.01))))


def depends_on(world, sensor) -> dict[str, Any]:
    """What a reference depends on, entry by entry (see ``digest``): the scene, camera and film (no
    converged picture depends on a sampler), the colours of the variant, and which paths the scene's
    own integrator counts."""
    limits = path_limits(world.integrator())
    return {
        "colours": "mono" if mi.is_monochromatic else "spectral" if mi.is_spectral else "rgb",
        **{f'parameter "{name}"': value for name, value in limits.items()},
        **digest.camera_entries(sensor, with_sampler=False),
        **digest.scene_entries(world),
    }


def path_limits(integrator) -> dict[str, Any]:
    """The longest path and whether emitters are hidden, of any integrator."""
    if hasattr(integrator, "parameters"):
        found = integrator.parameters()
        return {name: found[name] for name in ("max_depth", "hide_emitters")}
    # Mitsuba's own tell the depth by their text only.
    said = re.search(r"\bmax_depth = (-?\d+)", str(integrator))
    depth = int(said[1]) if said else -1
    hidden = bool(getattr(integrator, "hide_emitters", False))
    return {"max_depth": -1 if depth == _UNLIMITED else depth, "hide_emitters": hidden}


# --- Making ---


def make(
    world,
    sensor,
    integrator: str = "path",
    seconds: float | None = None,
    spp: int | None = None,
    seed: int = 0,
    start: Reference | None = None,
    progress: Callable[[float, float | None, str], None] | None = None,
) -> Reference:
    """A reference of what ``sensor`` sees of ``world``; arguments and errors as of :func:`grow`.

    progress    called as progress(done, total, text) after each wave: seconds, or samples per pixel
                where ``seconds`` is not given.
    """
    made = start
    for made in grow(world, sensor, integrator, seconds, spp, seed, start):
        if progress:
            progress(*state_of(made, seconds, spp, start))
    assert made is not None  # without a start there is one pair of waves at least
    return made


def state_of(
    made: Reference, seconds: float | None, spp: int | None, start: Reference | None
) -> tuple[float, float, str]:
    """(done, total, text) for a progress bar."""
    text = f"{made.record['spp']} spp, own error {made.own_error:.2%}"
    if seconds is None:
        return made.record["spp"], spp or 0, text
    return made.record["seconds"] - (start.record["seconds"] if start else 0.0), seconds, text


def grow(
    world,
    sensor,
    integrator: str = "path",
    seconds: float | None = None,
    spp: int | None = None,
    seed: int = 0,
    start: Reference | None = None,
) -> Iterator[Reference]:
    """The reference after each two more waves of samples, one for each half.

    integrator  name of a Mitsuba integrator that is unbiased and shares nothing with this library.
                "ptracer" darkens the edges of the film unless its filter is "box".
    seconds     add waves for so long, compilation included, and at least one for each half.
    spp         end when the samples per pixel, those of ``start`` included, are at least so many.
    start       go on from there; it must have been made from the same scene, with the same
                integrator and seed.

    Raises InputError for an integrator that cannot be used, a ``start`` that does not fit (naming
    what differs), and pictures with values that are not finite.
    """
    if seconds is None and spp is None:
        raise InputError("a reference needs a time or a number of samples per pixel to end at")
    if mi.has_flag(sensor.film().flags(), mi.FilmFlags.Special):
        raise InputError(f"film {sensor.film().class_name()}: a reference needs an hdrfilm")
    plugin = _independent(integrator, path_limits(world.integrator()))
    fixed = {"integrator": integrator, "seed": seed, "depends_on": depends_on(world, sensor)}
    if start is None:
        before: dict[str, Any] = {"spp": 0, "seconds": 0.0, "waves": 0}
    else:
        before = start.record
        _check_same(start, fixed)

    sampler = sensor.sampler()
    sampler_count = sampler.sample_count()
    width, height = sensor.film().crop_size()
    wave = max(1, min(_MOST, _LANES // (width * height)))
    if spp is not None:
        wave = max(1, min(wave, (spp - before["spp"] + 1) // 2))
    sums = [np.zeros((height, width, 4)), np.zeros((height, width, 4))]
    began, spent = time.perf_counter(), 0.0
    pairs = added = 0
    try:
        while spp is None or before["spp"] + added < spp:
            # As near to the time as whole pairs allow, and one always.
            if seconds is not None and pairs and spent * (pairs + 0.5) / pairs > seconds:
                return
            for k, half in enumerate(sums):
                number = before["waves"] + 2 * pairs + k
                half += _wave(plugin, world, sensor, _wave_seed(seed, number), wave)
                added += sampler.sample_count()  # samplers may round it up
            pairs += 1
            spent = time.perf_counter() - began
            record = fixed | {
                "spp": before["spp"] + added,
                "seconds": before["seconds"] + spent,
                "waves": before["waves"] + 2 * pairs,
                "variant": mi.variant(),
                "versions": versions(),
            }
            yield _reference(sums, record, start, added)
    finally:
        sampler.set_sample_count(sampler_count)


def _independent(name: str, limits: dict[str, Any]):
    """The integrator ``name`` with the limits of the scene's own."""
    if name == "aniso_pm":
        raise InputError("aniso_pm cannot be its own reference; name another integrator, say path")
    given = {
        key: value for key, value in limits.items() if value != {"max_depth": -1}.get(key, False)
    }
    try:
        found = mi.load_dict({"type": name, **given})
    except Exception as error:
        raise InputError(f'integrator "{name}" cannot be used here: {one_line(error)}') from error
    if not isinstance(found, mi.Integrator):
        raise InputError(f'"{name}" is no integrator')
    return found


def _wave_seed(seed: int, number: int) -> int:
    return mi.sample_tea_32(seed, number)[0]


def _wave(plugin, world, sensor, seed: int, spp: int) -> np.ndarray:
    """Sums over the samples of a wave: R, G, B and the weight of each pixel."""
    film = sensor.film()
    image = np.array(plugin.render(world, sensor=sensor, seed=seed, spp=spp), dtype=np.float64)
    sums = np.array(film.develop(raw=True), dtype=np.float64)[..., [0, 1, 2, -1]]
    if not sums[..., 3].any():
        # Integrators that start at the lights have no weights: a wave is one picture.
        sums[..., :3], sums[..., 3] = image[..., :3], 1
    bad = int((~np.isfinite(sums)).any(-1).sum())
    if bad:
        kind = plugin.class_name()
        raise InputError(f"{kind} left {bad} pixels that are not finite; use another integrator")
    return sums


def _reference(sums, record: dict[str, Any], start: Reference | None, added: int) -> Reference:
    first, second = (s[..., :3] / np.where(s[..., 3:] != 0, s[..., 3:], 1) for s in sums)
    mean, half_difference = (first + second) / 2, (first - second) / 2
    if start is not None:
        share = added / record["spp"]
        mean = share * mean + (1 - share) * start.mean
        half_difference = share * half_difference + (1 - share) * start.half_difference
    return Reference(mean, half_difference, record)


def _check_same(start: Reference, fixed: dict[str, Any]) -> None:
    was, is_ = (
        {key: record[key] for key in ("integrator", "seed")} | record["depends_on"]
        for record in (start.record, fixed)
    )
    found = digest.differences(was, is_)
    if found:
        more = f" and {len(found) - 4} more" if len(found) > 4 else ""
        raise InputError(
            f"{start.path or 'reference'}: cannot go on from it: {'; '.join(found[:4])}{more}; "
            "undo that, or write to another file"
        )


# --- On disk ---


def write(path: Path, reference: Reference, compact: bool = False) -> None:
    """Write ``reference``, atomically. Raises ``output.OutputError``.

    compact  half precision and lossy compression (DWAB), which changes a picture by about 0.2 %,
             for references that are worse than that; otherwise single precision without loss.
    """
    import OpenEXR

    kind = np.float16 if compact else np.float32
    channels = {
        f"{layer}.{colour}": np.ascontiguousarray(half[..., k].astype(kind))
        for layer, half in zip(("first", "second"), reference.halves, strict=True)
        for k, colour in enumerate("RGB")
    }
    record = reference.record | {
        "own_error": reference.own_error,
        "stored": "float16, DWAB" if compact else "float32, ZIP",
    }
    record = output.plain(record)
    header = {
        "compression": OpenEXR.DWAB_COMPRESSION if compact else OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "aniso_pm": json.dumps(record, ensure_ascii=False),
        "integrator": record["integrator"],
        "spp": record["spp"],
    }
    with output.replacing(Path(path)) as partial:
        OpenEXR.File(header, channels).write(str(partial))


def read(path: Path) -> Reference:
    """Read what :func:`write` wrote. Raises InputError naming the file where that is not so."""
    import OpenEXR

    record = read_record(path)
    channels = OpenEXR.File(str(path), separate_channels=True).channels()
    first, second = (
        np.stack([channels[f"{layer}.{c}"].pixels for c in "RGB"], -1).astype(np.float64)
        for layer in ("first", "second")
    )
    return Reference((first + second) / 2, (first - second) / 2, record, Path(path))


def read_record(path: Path) -> dict[str, Any]:
    """The record of a reference, without its pixels; errors as of :func:`read`."""
    import OpenEXR

    try:
        header = OpenEXR.File(str(path), header_only=True).header()
        names = {channel.name for channel in header["channels"]}
        record = json.loads(header["aniso_pm"])
        known = "depends_on" in record and {"first.R", "second.B"} <= names
    except Exception as error:
        raise InputError(f"{path}: cannot be read as a reference ({one_line(error)})") from error
    if not known:
        raise InputError(f"{path}: a picture, but not a reference (aniso-pm reference makes one)")
    return record


# --- Finding ---


def find(scene_file: Path, world, sensor) -> Reference | None:
    """The reference of ``world`` as ``sensor`` sees it with the least error of its own: any
    ``references/NAME*.exr`` beside NAME.xml that fits, else the cache's, else None."""
    wanted = depends_on(world, sensor)
    fitting = []
    for path in [*beside(scene_file), cache_path(scene_file, wanted)]:
        if not path.is_file():
            continue
        try:
            record = read_record(path)
        except InputError:
            continue
        if not digest.differences(record["depends_on"], wanted):
            fitting.append((record["own_error"], path))
    return read(min(fitting)[1]) if fitting else None


def require(file: Path, world, sensor) -> Reference:
    """The reference of a scene. Raises InputError with the remedy where there is none."""
    found = find(file, world, sensor)
    if found is None:
        width, height = sensor.film().crop_size()
        raise InputError(
            f"{file}: no reference fits this scene at {width} x {height} pixels; make one with "
            f"'aniso-pm reference {file} --time SECONDS' and the same -D, -m and -s"
        )
    return found


def beside(scene_file: Path) -> list[Path]:
    """Files beside a scene that may be references of it, for one film size or another."""
    scene_file = Path(scene_file)
    return sorted((scene_file.parent / "references").glob(f"{scene_file.stem}*.exr"))


def cache_path(scene_file: Path, wanted: dict[str, Any]) -> Path:
    """Where the cache keeps, or would keep, the reference that depends on ``wanted``."""
    text = json.dumps(output.plain(wanted), sort_keys=True)
    name = f"{Path(scene_file).stem}-{hashlib.sha256(text.encode()).hexdigest()[:16]}.exr"
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "aniso_pm" / "references" / name
