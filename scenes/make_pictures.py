"""Render the pictures of the README and the references they are compared with.

``python scenes/make_pictures.py references [--spp N]`` renders both scenes with ``path`` into
``scenes/references`` (half an hour at the default); ``python scenes/make_pictures.py pictures``
renders them with ``aniso_pm``, compares, prints a table and writes ``scenes/pictures``. Needs
matplotlib, which the extra ``dev`` brings.
"""

import argparse
from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np

HERE = Path(__file__).resolve().parent
# The close-up of each scene: left, top, right, bottom in pixels.
SCENES = {"teapot": (165, 230, 325, 350), "fry_pan": (60, 90, 260, 240)}
WAVE = 64  # samples per pixel at a time


def render(scene, integrator, spp, seed):
    plugin = mi.load_dict(integrator)
    image = np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed), dtype=np.float64)
    return image[..., :3], plugin


def make_reference(name, spp):
    """Two independent halves, kept in one file: their difference is the reference's own noise."""
    scene = mi.load_file(str(HERE / f"{name}.xml"))
    halves = [0.0, 0.0]
    waves = max(2, 2 * (spp // (2 * WAVE)))
    for i in range(waves):
        image, _ = render(scene, {"type": "path", "rr_depth": 12}, WAVE, 10_000 + i)
        halves[i % 2] += image / (waves / 2)
        print(f"\r{name}: {(i + 1) * WAVE} spp", end="", flush=True)
    print()
    write_reference(name, halves, waves * WAVE)


def write_reference(name, halves, spp):
    import OpenEXR

    channels = {
        f"{layer}.{c}": half[..., k].astype(np.float16)
        for layer, half in zip(("first", "second"), halves, strict=True)
        for k, c in enumerate("RGB")
    }
    header = {
        "compression": OpenEXR.DWAB_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "integrator": "path",
        "spp": spp,
    }
    OpenEXR.File(header, channels).write(str(HERE / "references" / f"{name}.exr"))


def read_reference(name):
    """(mean of the halves, difference of the halves / 2)."""
    import OpenEXR

    channels = OpenEXR.File(str(HERE / "references" / f"{name}.exr"), separate_channels=True)
    channels = channels.channels()
    first, second = (
        np.stack([channels[f"{layer}.{c}"].pixels for c in "RGB"], -1).astype(np.float64)
        for layer in ("first", "second")
    )
    return (first + second) / 2, (first - second) / 2


def relative_rmse(difference, reference):
    """√ mean d²/(R² + 0.01): every pixel counts by its relative error, dark ones do not explode."""
    return float(np.sqrt(np.mean(difference**2 / (reference**2 + 0.01))))


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
    for row, name in enumerate(SCENES):
        scene = mi.load_file(str(HERE / f"{name}.xml"))
        reference, noise = read_reference(name)
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
                picture = HERE / "pictures" / f"{name}.png"
                mi.util.write_bitmap(str(picture), mi.TensorXf(image.astype(np.float32)))
        own = relative_rmse(noise, reference)
        columns.append((f"path, reference (own error {100 * own:.1f} %)", reference))
        print(f"{name}: error of the reference itself {own:.4f}")
        left, top, right, bottom = SCENES[name]
        for column, (title, image) in enumerate(columns):
            shown = srgb(image)
            axes[2 * row, column].imshow(shown)
            axes[2 * row, column].set_title(title, fontsize=11)
            axes[2 * row + 1, column].imshow(shown[top:bottom, left:right], interpolation="nearest")
    for ax in axes.flat:
        ax.set_axis_off()
    figure.tight_layout(pad=0.4)
    figure.savefig(HERE / "pictures" / "comparison.png", dpi=100, pil_kwargs={"optimize": True})


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["references", "pictures"])
    parser.add_argument("--spp", type=int, default=4096)
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    if arguments.what == "references":
        for scene_name in SCENES:
            make_reference(scene_name, arguments.spp)
    else:
        make_pictures()
