"""What a photon's word says, 32 bits: the normal of the side that it lies on (octahedral, 24 bits),
the number of its path's segments (6), whether it is there for glossy caustics alone, and whether it
is a caustic one (the highest); and whether that is the surface of another point.

Two points count as on one surface where a smooth one may go through both: on every quadric, flat or
curved, (n + n')·d = 0 for their normals n, n' and their distance d; between parallel sheets it is
twice their distance.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

# Cosine between normals from which two points may lie on the same surface.
NORMAL_COS = 0.75
# Share of their distance by which they may miss a smooth surface through both.
BEND = 0.05
# Segments that the word can tell apart: this number stands for itself and more.
SEGMENTS_MAX = 63
# Marks of photons.
GLOSSY_ALONE, CAUSTIC = 1 << 30, 1 << 31


def encode_normal(n):
    """Unit vector → 24 bits (octahedral, 12 bits a coordinate: within 0.07 degrees)."""
    return encode(n, 12)


def decode_normal(word):
    """Inverse of ``encode_normal``; higher bits of the word are ignored."""
    return decode(word, 12)


def faces(word, n, least=NORMAL_COS):
    """Is the cosine between the photon's normal and n above ``least`` (> 0)?"""
    v = _octahedral(word, 12)
    cosine = dr.dot(v, n)
    return (cosine > 0) & (dr.square(cosine) > least**2 * dr.squared_norm(v))


def one_sheet(word, n, d, rounding):
    """May a surface go smoothly from a point to the photon at the offset d from it? On quadrics
    (n + n')·d = 0, for the photon's normal n'; between parallel sheets at the distance h it is 2h.
    rounding: of offsets, world units."""
    v = _octahedral(word, 12)
    return _bends(dr.fma(dr.dot(v, d), dr.rsqrt(dr.squared_norm(v)), dr.dot(n, d)), d, rounding)


def smooth_between(n, other, d, rounding):
    """The same for a normal that is known."""
    return _bends(dr.dot(n + other, d), d, rounding)


def _bends(off, d, rounding):
    """Is (n + n')·d no more than a smooth surface may have?"""
    return dr.square(off) <= dr.square(BEND) * dr.squared_norm(d) + dr.square(rounding)


def encode(v, bits):
    """Unit vector → two octahedral coordinates of so many bits each."""
    v = v / (dr.abs(v.x) + dr.abs(v.y) + dr.abs(v.z))
    fold_x = dr.mulsign(1 - dr.abs(v.y), v.x)
    fold_y = dr.mulsign(1 - dr.abs(v.x), v.y)
    x, y = dr.select(v.z < 0, fold_x, v.x), dr.select(v.z < 0, fold_y, v.y)
    top = 2**bits - 1
    quantise = lambda c: mi.UInt32(dr.clip((0.5 * c + 0.5) * top + 0.5, 0, top))  # noqa: E731
    return quantise(x) | (quantise(y) << bits)


def decode(word, bits):
    """Inverse of :func:`encode`; higher bits are ignored."""
    return dr.normalize(_octahedral(word, bits))


def _octahedral(word, bits):
    """The decoded direction, not of unit length."""
    top = 2**bits - 1
    x = mi.Float(word & top) * (2 / top) - 1
    y = mi.Float((word >> bits) & top) * (2 / top) - 1
    z = 1 - dr.abs(x) - dr.abs(y)
    fold = dr.maximum(-z, 0)
    return mi.Vector3f(x - dr.mulsign(fold, x), y - dr.mulsign(fold, y), z)


def segments(word):
    """Number of path segments from the light to the photon (SEGMENTS_MAX: that many and more)."""
    return (word >> 24) & SEGMENTS_MAX


def is_caustic(word):
    """Did the photon come over walked parts of BSDFs only? (Maps that mark caustics.)"""
    return (word & CAUSTIC) != 0


def is_glossy_alone(word):
    """Is it there for glossy caustics alone (see ``glossy_caustics``)?"""
    return (word & GLOSSY_ALONE) != 0
