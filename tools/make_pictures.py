"""Render the pictures of the README: ``python tools/make_pictures.py``.

Renders both scenes with ``aniso_pm``, compares with their references, prints a table and writes
``scenes/pictures``. Needs matplotlib, which the extra ``dev`` brings.
"""

from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
from aniso_pm.report import reference as references
from aniso_pm.report.reference import relative_rmse

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


def make_pictures():
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        4, 3, figsize=(12, 13.4), height_ratios=[3, 2.25, 3, 2.25], dpi=100, facecolor="white"
    )
    for row, name in enumerate(CLOSE_UPS):
        scene = mi.load_file(str(SCENES / f"{name}.xml"))
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


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    make_pictures()
