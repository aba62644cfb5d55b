"""Photons where they have been left: columns of numbers in the order of a spatial index.

A map says what its light paths have left and how many there were; what a photon's word says is
``photon_word``'s business, which photons an ellipse holds ``index``'s, what they sum up to
``density``'s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import index as spatial
from .photon_word import decode, is_caustic


@dataclass(frozen=True)
class PhotonMap:
    """Photons in the order of their spatial index.

    emitted    light paths traced: the estimate divides by it.
    stored     photons in the map; 0 means that the arrays are None (but see ``numbered``).
    rejected   fluxes that were not finite and were dropped: photons, and light paths that end.
    index      index.Index, or None. The word of a point: see ``photon_word``.
    flux       W, interleaved channels, padded to a power of two.
    direction  where the light came from, 32 bits octahedral; None where no receiver needs it.
    emitter_density  q of glossy caustics (see ``glossy_caustics``), 0 of all other photons; None
               where there are none.
    wavelengths  nm, in spectral variants; the flux is W/nm then.
    sums       summed.Sums of the index's nodes, or None.
    origins    Origins, or None.
    """

    emitted: int
    stored: int
    rejected: int
    index: Any
    flux: Any
    direction: Any
    wavelengths: Any
    sums: Any = None
    origins: Origins | None = None
    emitter_density: Any = None

    def numbered(self) -> PhotonMap:
        """The same for gathering alone: what differs from map to map as arrays, which are no part
        of what is traced, and the rest left out (``stored``, ``rejected``: 0)."""
        index = self.index
        count, leaves = (dr.opaque(mi.UInt32, v) for v in (index.count, index.n_leaves))
        return replace(
            self,
            emitted=dr.opaque(mi.UInt32, self.emitted),
            stored=0,
            rejected=0,
            index=replace(index, count=count, n_leaves=leaves),
            origins=None,
        )


@dataclass(frozen=True)
class Origins:
    """Where the photons of a map come from.

    path     number of the light path that left the photon in each slot (mi.UInt32).
    numbers  the five random numbers with which each path began, (paths, 5).
    """

    path: Any
    numbers: np.ndarray


EMPTY = PhotonMap(0, 0, 0, None, None, None, None)


@dataclass
class Photons:
    """Columns that light paths fill, in any order; None where a scene needs no such column."""

    position: Any
    word: Any
    flux: Any
    direction: Any
    path: Any
    emitter_density: Any = None


def caustics(map_: PhotonMap) -> PhotonMap:
    """The caustic photons of a map that marks them, as a map of their own."""
    if map_.stored == 0:
        return map_
    point = _points(map_, dr.arange(mi.UInt32, map_.stored))
    word = dr.reinterpret_array(mi.UInt32, point.w)
    return _part(map_, dr.compress(is_caustic(word)), map_.emitted)


def thinned(map_: PhotonMap, light_paths: int) -> PhotonMap:
    """The photons of so many light paths of a map that knows its ``origins``, as a map of their
    own."""
    if map_.stored == 0 or light_paths >= map_.emitted:
        return map_
    assert map_.origins
    part = _part(map_, dr.compress(map_.origins.path < light_paths), light_paths)
    assert part.origins
    numbers = map_.origins.numbers[:light_paths]
    return replace(part, origins=replace(part.origins, numbers=numbers))


def _part(map_: PhotonMap, slot, emitted: int) -> PhotonMap:
    """The photons in these slots, as a map of so many light paths."""
    point = _points(map_, slot)
    photons = Photons(
        mi.Point3f(point.x, point.y, point.z),
        dr.reinterpret_array(mi.UInt32, point.w),
        photon_flux(map_, slot, True),
        None if map_.direction is None else dr.gather(mi.UInt32, map_.direction, slot),
        None if map_.origins is None else dr.gather(mi.UInt32, map_.origins.path, slot),
        None if map_.emitter_density is None else dr.gather(mi.Float, map_.emitter_density, slot),
    )
    dr.eval(photons)
    nothing = replace(
        map_,
        emitted=emitted,
        stored=0,
        index=None,
        flux=None,
        direction=None,
        sums=None,
        emitter_density=None,
    )
    return indexed(photons, dr.width(slot), nothing)


def _points(map_: PhotonMap, slot):
    return dr.gather(mi.Vector4f, map_.index.points, slot)


def indexed(photons: Photons, stored: int, nothing: PhotonMap) -> PhotonMap:
    """``nothing``, a map without photons, with the first ``stored`` of the columns in order."""
    if stored == 0:
        return nothing
    index, order = spatial.build_of([_cut(photons, name, stored) for name in ("position", "word")])
    # What has been put in order is dropped before the next column is.
    direction, origins, density = None, nothing.origins, None
    if photons.direction is not None:
        direction = dr.gather(mi.UInt32, _cut(photons, "direction", stored), order)
        dr.eval(direction)
    if photons.emitter_density is not None:
        density = dr.gather(mi.Float, _cut(photons, "emitter_density", stored), order)
        dr.eval(density)
    if origins is not None:
        origins = replace(origins, path=dr.gather(mi.UInt32, _cut(photons, "path", stored), order))
        dr.eval(origins.path)
    # As many entries as the index has, so that arrays of all maps are alike in length to what is
    # frozen, and not by chance in every eighth one.
    sorted_flux = dr.zeros(mi.Float, dr.width(index.points) // 4 * _flux_width())
    flux = dr.gather(mi.Spectrum, _cut(photons, "flux", stored), order)
    dr.scatter(sorted_flux, pack_flux(flux), dr.arange(mi.UInt32, stored))
    del order, flux
    dr.eval(sorted_flux)
    spatial.give_back(stored)
    return replace(
        nothing,
        stored=stored,
        index=index,
        flux=sorted_flux,
        direction=direction,
        origins=origins,
        emitter_density=density,
    )


def _cut(photons, name: str, entries: int):
    """A column without its spare room, taken out of ``photons``: who gets it has it alone."""
    column = getattr(photons, name)
    setattr(photons, name, None)
    if dr.depth_v(column) == 1:
        return dr.reshape(type(column), column, entries, shrink=True)
    return type(column)(*(dr.reshape(type(x), x, entries, shrink=True) for x in column))


def photon_flux(photons: PhotonMap, slot, active):
    """Flux (mi.Spectrum, W) of the photon in a slot."""
    return read_flux(photons.flux, slot, active)


def read_flux(column, slot, active):
    """An entry of a column of fluxes that ``pack_flux`` has made."""
    packed = dr.gather(_packet(), column, slot, active)
    return mi.Spectrum(*(packed[k] for k in range(dr.size_v(mi.Spectrum))))


def photon_direction(photons: PhotonMap, slot, active):
    """Unit vector from the photon in a slot to where its light came from."""
    return decode(dr.gather(mi.UInt32, photons.direction, slot, active), 16)


def _flux_width() -> int:
    return 1 if dr.size_v(mi.Spectrum) == 1 else 4


def flux_bytes() -> int:
    """Of the flux of one photon in the current variant."""
    return 4 * _flux_width()


def _packet():
    """Array type of one photon's flux: a power of two of channels is gathered at once."""
    return mi.Vector1f if _flux_width() == 1 else mi.Vector4f


def pack_flux(spectrum):
    """A flux as it is stored, padded."""
    channels = [spectrum[k] for k in range(dr.size_v(mi.Spectrum))]
    return _packet()(*(channels + [mi.Float(0)] * (_flux_width() - len(channels))))
