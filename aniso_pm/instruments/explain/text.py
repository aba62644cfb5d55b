"""An explanation in words."""

from __future__ import annotations

from .record import Facts, Vertex


def as_text(found: Facts) -> str:
    x, y = found.pixel
    lines = [f"pixel {x},{y}: {found.sentence}", ""]
    if found.radius is not None:
        lines += [
            _row("photon map", f"pass {found.pass_index}, seed {found.seed}"),
            _row("", f"{found.photon_count:,} light paths, bandwidth {found.radius:.4g}"),
        ]
    lines.append(_row("eye paths", f"{found.samples} through this pixel"))
    if found.gather_points:
        lines += [
            _row("", f"{found.gather_points} gather points, {found.following} follow a lobe"),
            _row("map's radiance", f"{_vector(found.pixel_radiance)} (mean of these paths)"),
        ]
    if found.path:
        lines += ["", f"eye path {found.sample}"]
        lines += [_vertex(v) for v in found.path]
    if found.lobe:
        lobe = found.lobe
        lines += [
            "",
            _row("lobe", f"lam {lobe.lam:.4g}, mu {lobe.mu:.4g} (1/rad²)"),
            _row("", f"standard deviations {lobe.sigma[0]:.3g}° and {lobe.sigma[1]:.3g}°"),
            _row("", f"x {_vector(lobe.x)}, y {_vector(lobe.y)}, z {_vector(lobe.z)}"),
            _row("r", f"{_vector(lobe.r)}, {lobe.off:.2f} standard deviations off z"),
            _row("distance", f"{lobe.distance:.4g}"),
        ]
    if found.kernel:
        kernel = found.kernel
        lines += [
            "",
            _row("kernel", kernel.why),
            _row("half axes", f"|s| {_length(kernel.s):.4g}, |t| {_length(kernel.t):.4g}"),
            _row("", f"s {_vector(kernel.s)}, t {_vector(kernel.t)}"),
            _row("aspect", f"{kernel.aspect:.3g}"),
            _row("area", f"{kernel.area:.4g}"),
            _row("photons inside", f"{found.photons_inside}"),
            _row("contribution", f"{_vector(found.contribution)} W/m²/sr"),
        ]
        fallbacks = {
            "seen edge-on, |r·n| clamped": kernel.clamped,
            "aspect capped": kernel.capped,
            "no part of the kernel was found on the surface": kernel.off_surface,
        }
        lines += [_row("fallback", words) for words, acted in fallbacks.items() if acted]
    return "\n".join(line.rstrip() for line in lines)


def _row(name: str, text: str) -> str:
    return f"  {name:16s} {text}"


def _vertex(vertex: Vertex) -> str:
    alpha = ""
    if vertex.roughness:
        u, v = vertex.roughness
        alpha = f", alpha {u:.3g}" + (f" × {v:.3g}" if u != v else "")
    gathers = "; reads the photon map" if vertex.gathers else ""
    place = f"  {vertex.depth}. {vertex.shape} at {_vector(vertex.p)}"
    return f"{place}\n       {vertex.scatters}{alpha}{gathers}"


def _vector(values) -> str:
    return "(" + ", ".join(f"{value + 0.0:.4g}" for value in values) + ")"  # no -0


def _length(vector) -> float:
    return sum(c * c for c in vector) ** 0.5
