"""Make ``scenes/pictures``: ``python tools/make_pictures.py WHAT ...``.

comparison  teapot and pan as the scenes have them, with both kernels, beside their references.
gallery     all references.
bandwidth   how large the kernels behind each pixel are, beside the picture.
as_installed  the brushed tray by path and by the integrator without parameters, in equal seconds.

Prints what it measures. Needs matplotlib, which the extra ``dev`` brings.
"""

import argparse
import time
from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
from aniso_pm.instruments.report import reference as references
from aniso_pm.instruments.report.reference import relative_rmse

SCENES = Path(__file__).resolve().parents[1] / "scenes"
# The close-up of each scene: left, top, right, bottom in pixels.
CLOSE_UPS = {"teapot": (165, 230, 325, 350), "fry_pan": (60, 90, 260, 240)}


def render(scene, integrator, spp, seed):
    plugin = mi.load_dict(integrator)
    image = np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed), dtype=np.float64)
    return image[..., :3], plugin


def srgb(image):
    low = 12.92 * image
    return np.clip(
        np.where(image < 0.0031308, low, 1.055 * np.maximum(image, 1e-9) ** (1 / 2.4) - 0.055), 0, 1
    )


def comparison():
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        4, 3, figsize=(12, 13.4), height_ratios=[3, 2.25, 3, 2.25], dpi=100, facecolor="white"
    )
    for row, name in enumerate(CLOSE_UPS):
        scene = mi.load_file(str(SCENES / f"{name}.xml"), optimize=False)
        compared = references.read(SCENES / "references" / f"{name}.exr")
        reference = compared.mean
        columns = []
        for kernel in ("isotropic", "anisotropic"):
            parameters = scene.integrator().parameters() | {"type": "aniso_pm", "kernel": kernel}
            image, plugin = render(scene, parameters, 0, 1)
            error = relative_rmse(image - reference, reference)
            columns.append((f"{kernel}: relative RMSE {100 * error:.1f} %", image))
            seconds = plugin.statistics["seconds"]
            print(
                f"{name} {kernel}: relative RMSE {error:.4f}, mean-energy ratio "
                f"{image.mean() / reference.mean():.4f}, {sum(seconds.values()):.1f} s, "
                f"radius {plugin.statistics['initial_radius']:.3f}"
            )
            if kernel == "anisotropic":
                picture = SCENES / "pictures" / f"{name}.png"
                mi.util.write_bitmap(str(picture), mi.TensorXf(image.astype(np.float32)))
        own = compared.own_error
        columns.append((f"path, reference (own error {100 * own:.1f} %)", reference))
        print(f"{name}: error of the reference itself {own:.4f}")
        left, top, right, bottom = CLOSE_UPS[name]
        for column, (title, image) in enumerate(columns):
            shown = srgb(image)
            axes[2 * row, column].imshow(shown)
            axes[2 * row, column].set_title(title, fontsize=11)
            axes[2 * row + 1, column].imshow(shown[top:bottom, left:right], interpolation="nearest")
    for ax in axes.flat:
        ax.set_axis_off()
    figure.tight_layout(pad=0.4)
    figure.savefig(SCENES / "pictures" / "comparison.png", dpi=100, pil_kwargs={"optimize": True})


def gallery():
    """All references of 160 x 120 pixels, each as bright as its brightest twentieth allows."""
    from matplotlib import pyplot as plt

    found = {}
    for path in sorted((SCENES / "references").glob("*.exr")):
        reference = references.read(path)
        if reference.mean.shape == (120, 160, 3):
            found[path.stem.removesuffix("_160x120")] = reference
    figure, axes = plt.subplots(2, 4, figsize=(12.8, 5.3), dpi=100, facecolor="white")
    for ax, (name, reference) in zip(axes.flat, found.items(), strict=False):
        ax.imshow(srgb(0.8 * reference.mean / np.percentile(reference.mean, 95)))
        ax.set_title(f"{name} (own error {100 * reference.own_error:.1f} %)", fontsize=10)
    for ax in axes.flat:
        ax.set_axis_off()
    figure.tight_layout(pad=0.4)
    figure.savefig(SCENES / "pictures" / "gallery.png", dpi=100, pil_kwargs={"optimize": True})


def bandwidth():
    """Pictures above, the mean radius of each pixel's kernels below."""
    from matplotlib import colors
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        2, 2, figsize=(9.6, 7.3), dpi=100, facecolor="white", layout="constrained"
    )
    for (above, below), name in zip(axes.T, ("far_close", "glass_balls"), strict=True):
        scene = mi.load_file(str(SCENES / f"{name}.xml"), optimize=False, width=320, height=240)
        own = scene.integrator().parameters()
        plugin = {"type": "aniso_pm", "map": "global", "passes": 16, "layers": "radius"}
        image, plugin = render(scene, own | plugin, 16, 1)
        radii = np.array(plugin.layers["radius"], dtype=np.float64).squeeze()
        low, high = np.percentile(radii[radii > 0], (1, 99))
        first = plugin.statistics["initial_radius"]
        print(f"{name}: kernels of {low:.3g} to {high:.3g}, 60 photons within {first:.3g}")
        above.imshow(srgb(0.8 * image / np.percentile(image, 95)))
        above.set_title(name, fontsize=11)
        shown = below.imshow(np.where(radii > 0, radii, np.nan), norm=colors.LogNorm(low, high))
        below.set_title(f"radius; a disc of {first:.2g} holds 60 photons", fontsize=11)
        ticks = np.geomspace(low, high, 5)
        bar = figure.colorbar(shown, ax=below, orientation="horizontal", fraction=0.05, pad=0.02)
        bar.set_ticks(ticks, labels=[f"{tick:.2g}" for tick in ticks])
        bar.minorticks_off()
        bar.set_label("world units")
    for ax in axes.flat:
        ax.set_axis_off()
    figure.savefig(SCENES / "pictures" / "bandwidth.png", dpi=75, pil_kwargs={"optimize": True})


def as_installed(seconds=5.0):
    """Both integrators with the scene's sampler; compilation is not counted."""
    from matplotlib import pyplot as plt

    name = "brushed_tray"
    scene = mi.load_file(str(SCENES / f"{name}.xml"), optimize=False)
    reference = references.read(SCENES / "references" / f"{name}.exr")
    for seed in (1, 2):
        began = time.perf_counter()
        render(scene, {"type": "path"}, 512, seed)
    samples = int(512 * seconds / (time.perf_counter() - began))
    ours = {"type": "aniso_pm", "time": seconds}
    render(scene, ours, 0, 1)
    columns = []
    for title, plugin, spp in (("path", {"type": "path"}, samples), ("aniso_pm", ours, 0)):
        began = time.perf_counter()
        image, plugin = render(scene, plugin, spp, 3)
        took = time.perf_counter() - began
        spp = spp or plugin.statistics["spp"]
        error = 100 * relative_rmse(image - reference.mean, reference.mean)
        columns.append((f"{title}, {took:.1f} s: relative RMSE {error:.1f} %", image))
        print(
            f"{name} {title}: {took:.2f} s, {spp} samples, relative RMSE {error:.2f} %, "
            f"mean-energy ratio {image.mean() / reference.mean.mean():.4f}"
        )
    own = f"path, reference (own error {100 * reference.own_error:.1f} %)"
    columns.append((own, reference.mean))
    figure, axes = plt.subplots(1, 3, figsize=(12.8, 3.5), dpi=100, facecolor="white")
    scale = 1 / np.percentile(reference.mean, 98)
    for ax, (title, image) in zip(axes, columns, strict=True):
        ax.imshow(srgb(scale * image), interpolation="nearest")
        ax.set_title(title, fontsize=11)
        ax.set_axis_off()
    figure.tight_layout(pad=0.4)
    path = SCENES / "pictures" / "as_installed.png"
    figure.savefig(path, dpi=100, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    makers = {maker.__name__: maker for maker in (comparison, gallery, bandwidth, as_installed)}
    parser.add_argument("what", nargs="+", choices=list(makers))
    mi.set_variant("llvm_ad_rgb")
    for name in parser.parse_args().what:
        makers[name]()
