"""The definitions once more, in 50 digits (mpmath), one lobe at a time.

Derivatives are finite differences of ln G itself along geodesics, the warp is the second
derivative of the half-vector's exponent pulled back through the reflection: nothing is shared with
the closed forms of the modules. Inputs are single-precision numbers, exactly as the modules see
them; directions are made unit here, frames are taken as they are.
"""

from __future__ import annotations

import numpy as np

try:
    import mpmath
except ImportError as error:
    raise ImportError("the 50-digit references need mpmath: pip install mpmath") from error

# A context of our own: the caller's precision stays what it is.
mp = mpmath.mp.clone()
mp.dps = 50
mpf = mp.mpf


def mp_vec(a):
    return mp.matrix([mpf(float(c)) for c in np.asarray(a).reshape(3)])


def mp_dot(a, b):
    return sum(a[i] * b[i] for i in range(3))


def mp_unit(a):
    return a / mp.sqrt(mp_dot(a, a))


def mp_cross(a, b):
    return mp.matrix(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def mp_basis(v):
    """Two unit vectors that make an orthonormal basis with the unit vector v."""
    helper = mp.matrix([1, 0, 0]) if abs(v[0]) < 0.6 else mp.matrix([0, 1, 0])
    e = mp_unit(mp_cross(v, helper))
    return e, mp_cross(v, e)


def floats(a):
    """mpmath vector → float64 array."""
    return np.array([float(c) for c in a])


# --- The lobe ------------------------------------------------------------------------------------


def mp_log_g(lobe, i):
    """v → ln G of the i-th lobe; v unit. lobe: arrays x, y, z (n, 3) and lam, mu (n)."""
    x, y, z = mp_vec(lobe.x[i]), mp_vec(lobe.y[i]), mp_vec(lobe.z[i])
    lam, mu = mpf(float(lobe.lam[i])), mpf(float(lobe.mu[i]))
    return lambda v: mp.log(mp_dot(v, z)) - lam * mp_dot(v, x) ** 2 - mu * mp_dot(v, y) ** 2


def mp_geodesic_differences(function, v, d, step):
    """First and second central difference of `function` along v cos t + d sin t at t = 0.
    v, d are made exactly orthonormal."""
    v = mp_unit(v)
    d = mp_unit(d - v * mp_dot(d, v))
    step = mpf(step)
    cosine, sine = mp.cos(step), mp.sin(step)
    plus, zero, minus = (
        function(v * cosine + d * sine),
        function(v),
        function(v * cosine - d * sine),
    )
    return (plus - minus) / (2 * step), (plus - 2 * zero + minus) / step**2


def _step(lobe, i, r):
    """A step far below both scales of ln G: the standard deviation and the height r·z. With 50
    digits truncation (1e-20 relative) and rounding are below double precision."""
    height = abs(mp_dot(r, mp_vec(lobe.z[i])))
    sigma = 1 / mp.sqrt(2 * mpf(float(max(lobe.lam[i], lobe.mu[i]))) + 2)
    return mpf("1e-10") * min(height, sigma)


def _gradient_and_hessian(lobe, i, r, e, f, step):
    function = mp_log_g(lobe, i)
    g1, h11 = mp_geodesic_differences(function, r, e, step)
    g2, h22 = mp_geodesic_differences(function, r, f, step)
    _, mixed = mp_geodesic_differences(function, r, e + f, step)
    return mp.matrix([g1, g2]), mp.matrix(
        [[h11, mixed - (h11 + h22) / 2], [mixed - (h11 + h22) / 2, h22]]
    )


def _curvature(lobe, i, r, d, step):
    """(∂²G/∂d²)/G from G itself, relative to its value at r."""
    function = mp_log_g(lobe, i)
    centre = function(r)
    return mp_geodesic_differences(lambda w: mp.exp(function(w) - centre), r, d, step)[1]


def mp_taylor_axes(lobe, i, r, epsilon):
    """The rule "taylor": eigenvectors of g gᵀ/ε² + |H|/(2ε), lengths
    l(d) = 2ε/(|g·d| + √((g·d)² + 2ε|κ(d)|)). Returns u, v (mpmath)."""
    r, epsilon = mp_unit(mp_vec(r)), mpf(float(np.float32(epsilon)))
    step = _step(lobe, i, r)
    e, f = mp_basis(r)
    g, hessian = _gradient_and_hessian(lobe, i, r, e, f, step)
    values, q = mp.eigsy(hessian)
    positive = q * mp.diag([abs(values[0]), abs(values[1])]) * q.T
    _, q = mp.eigsy(g * g.T / epsilon**2 + positive / (2 * epsilon))
    axes = []
    for k in (1, 0):
        d = e * q[0, k] + f * q[1, k]
        slope = abs(mp_geodesic_differences(mp_log_g(lobe, i), r, d, step)[0])
        curvature = abs(_curvature(lobe, i, r, d, step))
        axes.append(d * (2 * epsilon / (slope + mp.sqrt(slope**2 + 2 * epsilon * curvature))))
    return axes


def mp_paper_axes(lobe, i, r, epsilon):
    """The rule "paper", as printed: l_u = ε/|g|, l_v = 2ε/|(∂²G/∂v²)/G|. Needs g ≠ 0."""
    r, epsilon = mp_unit(mp_vec(r)), mpf(float(np.float32(epsilon)))
    step = _step(lobe, i, r)
    e, f = mp_basis(r)
    g, _ = _gradient_and_hessian(lobe, i, r, e, f, step)
    norm = mp.sqrt(g[0] ** 2 + g[1] ** 2)
    u_d = (e * g[0] + f * g[1]) / norm
    v_d = mp_cross(r, u_d)
    return [u_d * (epsilon / norm), v_d * (2 * epsilon / abs(_curvature(lobe, i, r, v_d, step)))]


def mp_lobe_axes(lobe, i, r, epsilon):
    """The rule "lobe": √(ε/λ), √(ε/μ) along x, y turned by the smallest rotation z → r."""
    r, epsilon = mp_unit(mp_vec(r)), mpf(float(np.float32(epsilon)))
    z = mp_unit(mp_vec(lobe.z[i]))
    axis, cosine = mp_cross(z, r), mp_dot(z, r)
    axes = []
    for w, bandwidth in ((lobe.x[i], lobe.lam[i]), (lobe.y[i], lobe.mu[i])):
        w = mp_vec(w)
        turned = w * cosine + mp_cross(axis, w) + axis * (mp_dot(axis, w) / (1 + cosine))
        axes.append(turned * mp.sqrt(epsilon / mpf(float(bandwidth))))
    return axes


MP_AXES = {"taylor": mp_taylor_axes, "paper": mp_paper_axes, "lobe": mp_lobe_axes}


# --- The warp ------------------------------------------------------------------------------------


def mp_warped_axes(lobe, i, o):
    """Axes of the reflected lobe of the i-th NDF lobe at the viewer o: unit eigenvectors of its
    quadratic form divided by √(eigenvalue), the steeper one first (mpmath), and the mirror
    direction."""
    o, n = mp_unit(mp_vec(o)), mp_unit(mp_vec(lobe.z[i]))
    x, y = mp_vec(lobe.x[i]), mp_vec(lobe.y[i])
    lam, mu = mpf(float(lobe.lam[i])), mpf(float(lobe.mu[i]))
    mirror = n * (2 * mp_dot(o, n)) - o
    e, f = mp_basis(mirror)

    def exponent(r):
        h = mp_unit(r + o)
        return lam * mp_dot(h, x) ** 2 + mu * mp_dot(h, y) ** 2

    step = mpf("1e-12") * mp_dot(o, n)
    m11, m22, both = (
        mp_geodesic_differences(exponent, mirror, d, step)[1] * weight
        for d, weight in ((e, mpf(0.5)), (f, mpf(0.5)), (e + f, mpf(0.5)))
    )
    m12 = both - (m11 + m22) / 2
    values, q = mp.eigsy(mp.matrix([[m11, m12], [m12, m22]]))
    axes = [(e * q[0, k] + f * q[1, k]) / mp.sqrt(values[k]) for k in (1, 0)]
    return axes, mirror


# --- Planes --------------------------------------------------------------------------------------


def mp_project(u, v, r, n, distance):
    """s, t = τ(w − (w·n / r·n) r) for w = u, v: the literal projection."""
    r, n = mp_unit(mp_vec(r)), mp_unit(mp_vec(n))
    inv = 1 / mp_dot(r, n)
    return [(w - r * (mp_dot(w, n) * inv)) * mpf(float(distance)) for w in (u, v)]


def mp_coordinates(d, s, t, n):
    """(a, b) with d = a s + b t + c n: the 3×3 system solved."""
    columns = [s, t, mp_unit(mp_vec(n))]
    system = mp.matrix([[column[i] for column in columns] for i in range(3)])
    solution = mp.lu_solve(system, d)
    return solution[0], solution[1]


def mp_kernel(lobe, i, r, n, distance, radius, epsilon, rule, guard, max_aspect, size, cos_min):
    """The integrator's kernel as ``kernel.guarded_axes`` documents it: half axes (long, short) on
    the plane, and whether clamp and cap acted. Matrices instead of the module's shortcuts."""
    axes = MP_AXES[rule](lobe, i, r, epsilon)
    own = mp_lobe_axes(lobe, i, r, 1.0)
    distance, radius = mpf(float(distance)), mpf(float(radius))
    if guard and (rule != "lobe" or size == "bandwidth"):
        # c (u uᵀ + v vᵀ) inside a aᵀ + b bᵀ: in coordinates of (a, b) the right side is 1.
        w = mp.matrix([[mp_dot(p, q) / mp_dot(q, q) for q in own] for p in axes])
        largest = max(mp.eigsy(w.T * w, eigvals_only=True))
        fit = 1 / mp.sqrt(largest)
        axes = [p * (min(fit, 1) if size == "epsilon" else fit) for p in axes]

    r, n = mp_unit(mp_vec(r)), mp_unit(mp_vec(n))
    cosine = mp_dot(r, n)
    clamped = abs(cosine) < cos_min
    inv = 1 / (cosine if not clamped else (mpf(cos_min) if cosine >= 0 else -mpf(cos_min)))
    e, f = mp_basis(n)
    flat = [(w - r * (mp_dot(w, n) * inv)) * distance for w in axes]
    w = mp.matrix([[mp_dot(p, e), mp_dot(p, f)] for p in flat])
    m = w.T * w
    if guard and size == "bandwidth":
        m += mp.eye(2) * radius**2
    values, q = mp.eigsy(m)  # ascending
    area = mp.sqrt(values[0] * values[1])
    aspect = mp.sqrt(values[1] / values[0])
    mean = radius if size == "bandwidth" else mp.sqrt(area)
    capped = aspect > max_aspect
    stretch = mp.sqrt(min(aspect, mpf(max_aspect)))
    long = (e * q[0, 1] + f * q[1, 1]) * mean * stretch
    short = (e * q[0, 0] + f * q[1, 0]) * mean / stretch
    return [long, short], clamped, capped
