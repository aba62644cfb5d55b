"""What rule and guard do to the metal of the two scenes: ``python tools/measure_rules.py``.

One pass at the automatic bandwidth, every kernel with the same photons and the same eye paths,
over several seeds. For the pixels that show metal, relative to R² + 0.01: variance, bias² (product
of the errors of two independent halves of the seeds against the two halves of the reference, so
that no noise is left in its mean), and the energy of the indirect light relative to the isotropic
kernel.
"""

import argparse

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm.instruments.report import reference as references
from aniso_pm.instruments.report.metrics import weights
from make_pictures import CLOSE_UPS, SCENES, render

KERNELS = [("isotropic", "lobe", True)] + [
    ("anisotropic", rule, guard) for rule in ("lobe", "taylor", "paper") for guard in (True, False)
]


def metal_pixels(scene):
    """Mask of the pixels whose centre shows a glossy surface."""
    sensor = scene.sensors()[0]
    width, height = sensor.film().crop_size()
    index = dr.arange(mi.UInt32, width * height)
    centre = mi.Point2f((index % width + 0.5) / width, (index // width + 0.5) / height)
    ray, _ = sensor.sample_ray(0, 0.5, centre, mi.Point2f(0.5))
    flags = scene.ray_intersect(ray).bsdf().flags()
    return mi.has_flag(flags, mi.BSDFFlags.Glossy).numpy().reshape(height, width)


def measure(name, seeds, spp):
    scene = mi.load_file(str(SCENES / f"{name}.xml"), optimize=False)
    mask = metal_pixels(scene)
    reference = references.read(SCENES / "references" / f"{name}.exr")
    first, second = (half[mask] for half in reference.halves)
    # Not 1/(R² + 0.01) of the same noisy pixel: its error would weigh itself.
    weight = weights(reference.halves)[mask]
    base = {"type": "aniso_pm", "photon_count": 100_000}
    direct = [render(scene, base | {"max_depth": 2}, spp, s)[0][mask].mean() for s in range(seeds)]
    print(
        f"\n{name}: {seeds} seeds, {spp} spp, {mask.mean():.0%} of the pixels show metal; ", end=""
    )
    print(
        f"variance of the reference {np.mean(weight * reference.half_difference[mask] ** 2):.1e}\n"
    )
    print("| kernel | rule | guard | variance | bias² | energy, indirect | fallbacks |")
    print("|---|---|---|---|---|---|---|")
    isotropic = None
    for kernel, rule, guard in KERNELS:
        parameters = {"kernel": kernel, "rule": rule, "guard": guard}
        images, fallbacks = [], 0.0
        for seed in range(seeds):
            image, plugin = render(scene, base | parameters, spp, seed)
            images.append(image[mask])
            counts = plugin.statistics
            acted = sum(counts[f"gather_points_{k}"] for k in ("clamped", "capped", "degenerate"))
            fallbacks = acted / max(1, counts["gather_points"])
        half = seeds // 2
        a, b = np.mean(images[:half], axis=0), np.mean(images[half:], axis=0)
        energy = np.array([i.mean() for i in images]) - direct
        isotropic = energy if isotropic is None else isotropic
        ratios = energy / isotropic
        spread = ratios.std(ddof=1) / seeds**0.5
        print(
            f"| {kernel} | {rule if kernel != 'isotropic' else '–'} "
            f"| {('on' if guard else 'off') if kernel != 'isotropic' else '–'} "
            f"| {np.mean(weight * np.var(images, axis=0, ddof=1)):.4f} "
            f"| {np.mean(weight * (a - first) * (b - second)):.5f} "
            f"| {ratios.mean():.4f} ± {spread:.4f} | {fallbacks:.1%} |",
            flush=True,
        )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=6)
    parser.add_argument("--spp", type=int, default=16)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    for scene_name in CLOSE_UPS:
        measure(scene_name, arguments.seeds, arguments.spp)
