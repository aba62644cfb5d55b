"""Error against passes: ``python tools/measure_convergence.py``.

Each scene is rendered with several seeds in small passes, and the picture is kept after 1, 4, 16, …
passes. Errors count relative to R² + 0.01; R² is the mean of R1 R2 over 3 × 3 pixels of the two
independent halves R1, R2 of the reference, so that noise of a single pixel does not choose its own
weight. With pictures I, means over pixels and colours of

    MSE    the mean over seeds of (I − R1)(I − R2)
    bias²  the mean over pairs of different seeds of (I − R1)(I' − R2)

have no noise in their expectation, neither the reference's nor (bias²) that of the pictures. What
scatters is shown by a bootstrap over seeds and blocks of pixels: 95 % intervals. A point within
three of its standard errors of zero cannot be told from the reference's noise; it is drawn hollow
and does not count for the slope.

Writes ``scenes/pictures/convergence.svg`` and ``.json``. Needs matplotlib, which the extra ``dev``
brings.
"""

import argparse
import json
from dataclasses import dataclass

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
from aniso_pm.instruments.report import reference as references
from aniso_pm.instruments.report.metrics import weights
from make_pictures import SCENES

# What is looked at: left, top, width, height in pixels of the reference.
WINDOWS = {
    "teapot": (205, 308, 96, 72),
    "fry_pan": (150, 140, 96, 72),
    "glass_balls": (40, 25, 96, 72),
}
# Number of passes: seeds. Few passes are noisy and cheap.
SEEDS = {1: 32, 4: 32, 16: 16, 64: 5, 256: 3}
BLOCK = 8  # pixels
RESAMPLED = 400


@dataclass(frozen=True)
class Curve:
    """One quantity against the number of passes, with resampled values of it."""

    value: np.ndarray  # (counts)
    resampled: np.ndarray  # (resamplings, counts)

    @property
    def interval(self):
        return np.percentile(self.resampled, [2.5, 97.5], axis=0)

    @property
    def clear(self):
        """Which points stand clear of the noise."""
        return self.value > 3 * self.resampled.std(axis=0)

    def slope(self, counts):
        """(slope, lower end, upper end of the 95 % interval) of log value against log count."""
        use = self.clear
        if use.sum() < 2:
            return (float("nan"),) * 3
        x = np.log(np.asarray(counts)[use])
        x -= x.mean()
        y = np.log(np.maximum(np.vstack([self.value, self.resampled])[:, use], 1e-12))
        slopes = (y - y.mean(1, keepdims=True)) @ x / (x @ x)
        return float(slopes[0]), *map(float, np.percentile(slopes[1:], [2.5, 97.5]))


def load(name):
    """Scene with the window as its crop window, and the reference's halves there."""
    scene = mi.load_file(str(SCENES / f"{name}.xml"), optimize=False)
    left, top, width, height = WINDOWS[name]
    sensor = scene.sensors()[0]
    parameters = mi.traverse(sensor)
    parameters["film.crop_offset"] = [left, top]
    parameters["film.crop_size"] = [width, height]
    parameters.update()
    reference = references.read(SCENES / "references" / f"{name}.exr")
    rows, columns = slice(top, top + height), slice(left, left + width)
    halves = [half[rows, columns] for half in reference.halves]
    return scene, halves


def pictures(scene, counts, seed, parameters, spp):
    """Pictures after each of ``counts`` passes of ``spp`` samples a pixel: (counts, y, x, 3)."""
    plugin = mi.load_dict({"type": "aniso_pm", "passes": max(counts)} | parameters)
    kept = []

    def keep(index, image, statistics):
        if index + 1 in counts:
            kept.append(np.array(image, dtype=np.float64)[..., :3])

    plugin.callback = keep
    plugin.render(scene, seed=seed, spp=spp * max(counts))
    return np.array(kept)


def products(images, halves):
    """Means over blocks of pixels of the products of the errors of any two pictures, each against
    another half of the reference: (blocks, seeds, seeds). images: (seeds, y, x, 3)."""
    scale = weights(halves) ** 0.5
    first, second = (by_block(scale * (images - half)) for half in halves)
    return first @ second.transpose(0, 2, 1) / first.shape[-1]


def by_block(values):
    """(n, y, x, 3) → (blocks, n, pixels and colours of a block)."""
    n, height, width, colours = values.shape
    values = values.reshape(n, height // BLOCK, BLOCK, width // BLOCK, BLOCK, colours)
    return values.transpose(1, 3, 0, 2, 4, 5).reshape(-1, n, BLOCK * BLOCK * colours)


def measure(pictures_by_count, halves):
    """(MSE, bias²) against passes, as Curves. pictures_by_count: arrays (seeds, y, x, 3)."""
    tables = [products(images, halves) for images in pictures_by_count]
    rng = np.random.default_rng(0)

    def estimate(table, where, times):
        """Both, from some blocks, with each seed taken so many times."""
        mean = table[where].mean(0)
        own = np.diag(mean) @ times / times.sum()
        pairs = np.outer(times, times) * (1 - np.eye(len(times)))
        return own, (pairs * mean).sum() / pairs.sum()

    blocks = len(tables[0])
    value = [estimate(t, np.arange(blocks), np.ones(t.shape[1])) for t in tables]
    resampled = []
    for _ in range(RESAMPLED):
        where = rng.integers(0, blocks, blocks)
        row = []
        for table in tables:
            seeds = table.shape[1]
            times = np.zeros(seeds)
            while (times > 0).sum() < 2:
                times = np.bincount(rng.integers(0, seeds, seeds), minlength=seeds)
            row.append(estimate(table, where, times))
        resampled.append(row)
    value, resampled = np.array(value), np.array(resampled)
    return tuple(Curve(value[:, k], resampled[:, :, k]) for k in (0, 1))


def run(names, photons, spp):
    results = {}
    counts = tuple(SEEDS)
    for name in names:
        scene, halves = load(name)
        kept = {count: [] for count in counts}
        for seed in range(max(SEEDS.values())):
            wanted = [count for count in counts if seed < SEEDS[count]]
            images = pictures(scene, wanted, seed, {"photon_count": photons}, spp)
            for count, image in zip(wanted, images, strict=True):
                kept[count].append(image)
            print(f"\r{name}: seed {seed + 1} of {max(SEEDS.values())}", end="", flush=True)
        print()
        kept = [np.array(images) for images in kept.values()]
        mse, bias2 = measure(kept, halves)
        reference = np.mean(halves, axis=0)
        own = np.mean(weights(halves) * ((halves[0] - halves[1]) / 2) ** 2)
        results[name] = {
            "passes": counts,
            "seeds": list(SEEDS.values()),
            "photons": photons,
            "samples": spp,
            "variance of the reference": float(own),
            "energy": [float(images.mean() / reference.mean()) for images in kept],
        }
        for label, curve in (("MSE", mse), ("bias²", bias2)):
            results[name][label] = {
                "value": curve.value.tolist(),
                "interval": curve.interval.tolist(),
                "clear": curve.clear.tolist(),
                "slope": curve.slope(counts),
            }
        show(name, results[name])
    return results


def told(slope):
    value, low, high = slope
    return "noise" if np.isnan(value) else f"slope {value:.2f} ({low:.2f} to {high:.2f})"


def show(name, result):
    print(f"| {name} | " + " | ".join(f"{n}" for n in result["passes"]) + " | slope |")
    for label in ("MSE", "bias²"):
        curve = result[label]
        values = " | ".join(
            f"{v:.2e}" + ("" if clear else " (noise)")
            for v, clear in zip(curve["value"], curve["clear"], strict=True)
        )
        print(f"| {label} | {values} | {told(curve['slope'])} |")
    print("| energy | " + " | ".join(f"{e:.4f}" for e in result["energy"]) + " | |", flush=True)


def plot(results, path):
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(results), figsize=(4.2 * len(results), 4), sharey=True)
    for ax, (name, result) in zip(np.atleast_1d(axes), results.items(), strict=True):
        counts = np.array(result["passes"])
        for label, colour in (("MSE", "C0"), ("bias²", "C1")):
            curve = result[label]
            value, clear = np.array(curve["value"]), np.array(curve["clear"])
            low, high = np.maximum(curve["interval"], 1e-9)
            ax.fill_between(counts, low, high, color=colour, alpha=0.2, lw=0)
            text = f"{label}: {told(curve['slope'])}"
            ax.plot(counts[clear], value[clear], "o-", color=colour, label=text)
            ax.plot(counts[~clear], np.maximum(value[~clear], 1e-9), "o", mfc="w", color=colour)
        guide = result["MSE"]["value"][0] * counts ** (-2 / 3)
        ax.plot(counts, guide, "k:", lw=1, label="slope −2/3")
        ax.axhline(
            result["variance of the reference"],
            color="grey",
            lw=1,
            label="variance of the reference",
        )
        ax.set(xscale="log", yscale="log", title=name, xlabel="passes", ylim=(1e-4, 2))
        ax.set_xticks(counts, [str(n) for n in counts])
        ax.minorticks_off()
        ax.legend(fontsize=7)
    np.atleast_1d(axes)[0].set_ylabel("relative to R² + 0.01")
    figure.tight_layout()
    figure.savefig(path)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", choices=list(WINDOWS), default=list(WINDOWS))
    parser.add_argument("--photons", type=int, default=100_000, help="light paths per pass")
    parser.add_argument("--spp", type=int, default=2, help="samples per pass")
    arguments = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    # Scenes that are not measured now keep what was measured before.
    file = SCENES / "pictures" / "convergence.json"
    measured = json.loads(file.read_text()) if file.exists() else {}
    measured |= run(arguments.scenes, arguments.photons, arguments.spp)
    file.write_text(json.dumps(measured, indent=1, ensure_ascii=False) + "\n")
    plot(measured, file.with_suffix(".svg"))
