"""Scenes that nobody here wrote: ``python tools/foreign_scenes.py FOLDER_OR_FILE ...``.

Every scene file of a folder (XML files with a sensor; not what others include) is rendered small,
with ``path`` and with this integrator: as installed, and for every use of the map. Prints a
Markdown table:

    energy       mean of the picture over the mean of path's, all pixels and colours, with the
                 standard error of the ratio from the scatter of independent renders of both
    path/ours    relative MSE of path over ours (as installed) after the same seconds, compilation
                 apart; the mean over pixels of (I − R1)(I − R2)/(R² + 0.01), R1 and R2 independent
                 halves of the reference, so that its noise does not count
    remarks      what was refused and warned of

``--search`` names folders that scenes look files up in besides their own, ``--pictures`` one for
PNG files of path's picture and ours side by side. Scenes run one by one in processes of their own,
so that one that crashes costs its row only.
"""

import argparse
import json
import re
import subprocess
import sys
import time
from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
from aniso_pm.instruments.report.metrics import weights

USES = {
    "as installed": {},
    "global": {"map": "global"},
    "caustic": {"map": "caustic"},
    "final gather": {"final_gather": True},
}
ROUNDS = 8  # independent renders, whose scatter is the standard error
TRIES = 8  # numbers of samples that are tried for one that takes the given time


# --- One scene ---


def load(file, search, longest):
    """The scene with a film whose longest side has so many pixels."""
    resolver = mi.file_resolver()
    for folder in reversed([file.parent, *search]):
        resolver.prepend(str(folder))
    text = file.read_text()
    wanted = set(re.findall(r"\$(\w+)", text)) - set(re.findall(r'default name="(\w+)"', text))
    scene = mi.load_file(str(file), **dict.fromkeys(wanted & {"spp"}, "16"))  # not used here
    sensor = scene.sensors()[0]
    parameters = mi.traverse(sensor)
    size = np.array(parameters["film.size"]).ravel()
    small = np.maximum(1, np.round(size * longest / size.max())).astype(int).tolist()
    parameters["film.size"] = small
    parameters["film.crop_size"] = small
    parameters["film.crop_offset"] = [0, 0]
    parameters.update()
    return scene


def picture(scene, plugin, spp, seed):
    image = np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed), dtype=np.float64)
    return image[..., :3]


def samples_for(scene, plugin, seconds, seed):
    """Samples a pixel that take so long, kernels compiled and what a render costs once included."""
    spp = 4
    picture(scene, plugin, spp, seed)
    for _ in range(TRIES):
        start = time.perf_counter()
        picture(scene, plugin, spp, seed)
        share = (time.perf_counter() - start) / seconds
        tried, spp = spp, max(4, int(spp / np.clip(share, 1 / 16, 16)))
        if 0.9 < share < 1.1 or spp == tried:
            break
    return spp


def renders(scene, parameters, seconds, seed):
    """ROUNDS independent pictures that take so long together."""
    plugin = mi.load_dict(parameters)
    spp = samples_for(scene, plugin, seconds / ROUNDS, seed)
    return [picture(scene, plugin, spp, seed + 1 + k) for k in range(ROUNDS)]


def error(image, halves):
    return float(np.mean(weights(halves) * (image - halves[0]) * (image - halves[1])))


def measure(file, options):
    """Row of the table, as a dictionary."""
    scene = load(file, options.search, options.size)
    reference = renders(scene, {"type": "path"}, options.reference, 1000)
    halves = [np.mean(reference[k::2], axis=0) for k in (0, 1)]
    energy = np.array([image.mean() for image in reference])
    row = {"energy": {}, "refused": [], "black": not energy.mean() > 0}
    if row["black"]:
        return row
    ours = None
    for number, (use, more) in enumerate(USES.items()):
        try:
            images = renders(scene, {"type": "aniso_pm"} | more, options.ours, 2000 + 100 * number)
        except (ValueError, RuntimeError) as problem:
            # mi.render() hides what was raised inside of it.
            while problem.__cause__ is not None:
                problem = problem.__cause__
            row["refused"].append(str(problem).removeprefix("aniso_pm: "))
            continue
        own = np.array([image.mean() for image in images])
        relative = [x.std(ddof=1) / ROUNDS**0.5 / x.mean() for x in (own, energy)]
        row["energy"][use] = [own.mean() / energy.mean(), float(np.hypot(*relative))]
        ours = np.mean(images, axis=0) if ours is None else ours
    if ours is None:
        return row
    row["ratio"] = equal_seconds(scene, halves, options.seconds)
    if options.pictures:
        options.pictures.mkdir(parents=True, exist_ok=True)
        both = np.concatenate([np.mean(halves, axis=0), ours], axis=1).astype(np.float32)
        mi.util.write_bitmap(str(options.pictures / f"{file.parent.name}_{file.stem}.png"), both)
    return row


def equal_seconds(scene, halves, seconds):
    """Relative MSE of path over that of ours after so many seconds."""
    errors = []
    for parameters in ({"type": "path"}, {"type": "aniso_pm"}):
        plugin = mi.load_dict(parameters)
        spp = samples_for(scene, plugin, seconds, 5000)
        start = time.perf_counter()
        image = picture(scene, plugin, spp, 5001)
        # What it took after all; errors go as one over the time.
        errors.append(error(image, halves) * (time.perf_counter() - start) / seconds)
    return errors[0] / errors[1] if min(errors) > 0 else None


# --- All of them ---


def scene_files(folder, pattern):
    """(folder, XML file) of files with a sensor, of their own or included."""
    if folder.is_file():
        yield folder.parent.parent, folder
        return
    for file in sorted(folder.rglob(pattern)):
        text = file.read_text(errors="replace")
        if "<scene" in text and re.search("<sensor|<include", text) and "include" not in file.parts:
            yield folder, file


def run(file, arguments):
    """The row of a scene by a process of its own."""
    command = [sys.executable, __file__, *arguments, "--one", str(file)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    except subprocess.TimeoutExpired:
        return {"failed": "took longer than ten minutes"}
    printed, errors = (re.sub(r"\x1b\[\d*m", "", text) for text in (done.stdout, done.stderr))
    last = [line for line in printed.splitlines() if line.startswith("{")]
    said = [line for line in printed.splitlines() if line not in last] + errors.splitlines()
    warned = re.findall(r"aniso_pm: (.*)", "\n".join(said))
    if not last:
        lines = [line for line in errors.splitlines() if line.strip()]
        return {"failed": lines[-1] if lines else f"exit status {done.returncode}"}
    row = json.loads(last[-1])
    known = " ".join(row["refused"])
    row["warned"] = sorted({line.strip() for line in warned if line.strip() not in known})
    return row


def cell(found):
    return "" if found is None else f"{found[0]:.4f} ± {found[1]:.4f}"


def line(name, row):
    if "failed" in row:
        return f"| {name} | | | | | | not rendered: {row['failed'][:300]} |"
    if row["black"]:
        return f"| {name} | | | | | | black under `path` |"
    cells = [cell(row["energy"].get(use)) for use in USES]
    ratio = f"{row['ratio']:.2f}" if row.get("ratio") else ""
    remarks = [*dict.fromkeys(f"refused: {text}" for text in row["refused"])]
    remarks += [f"warns: {text}" for text in row.get("warned", [])]
    text = "; ".join(remarks).replace("\n", " ").replace("|", "\\|")
    return f"| {name} | {' | '.join(cells)} | {ratio} | {text} |"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("paths", type=Path, nargs="*", metavar="FOLDER_OR_FILE")
    parser.add_argument("--pattern", default="*.xml", help="scene files, e.g. 'bsdf_*.xml'")
    parser.add_argument("--search", type=Path, action="append", default=[])
    parser.add_argument("--variant", default="llvm_ad_rgb")
    parser.add_argument("--size", type=int, default=120, help="pixels of the longest side")
    parser.add_argument("--reference", type=float, default=16, help="seconds of path")
    parser.add_argument("--ours", type=float, default=4, help="seconds of each use")
    parser.add_argument("--seconds", type=float, default=2, help="of path/ours")
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        mi.set_variant(options.variant)
        print(json.dumps(measure(options.one, options)))
        return
    if not options.paths:
        parser.error("which folder?")
    print("| scene | " + " | ".join(USES) + " | path/ours | remarks |")
    print("|---" * (len(USES) + 3) + "|")
    arguments = [a for a in sys.argv[1:] if a not in map(str, options.paths)]
    for folder, file in (
        pair for path in options.paths for pair in scene_files(path, options.pattern)
    ):
        row = run(file, arguments)
        print(line(file.relative_to(folder).with_suffix(""), row), flush=True)


if __name__ == "__main__":
    main()
