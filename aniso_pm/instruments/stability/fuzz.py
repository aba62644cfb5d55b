"""Random scenes: no crash, no hang, no pixel that is not finite; the seed says which scene.

Scenes are rendered in a process of their own, so that a crash or a hang is a finding like any
other. ``python -m aniso_pm.instruments.stability.fuzz SEED SECONDS`` renders one scene after the
other and prints the seed of each; with 0 for SECONDS it renders that one.
"""

from __future__ import annotations

import queue
import subprocess
import sys
import threading
import time

import aniso_pm  # noqa: F401 (registers the plugins; before mitsuba, so that it can choose LLVM)
import mitsuba as mi
import numpy as np
from aniso_pm.errors import one_line
from aniso_pm.instruments.stability.case import Case, Measured
from aniso_pm.instruments.stability.worlds import diffuse, film, grey, room
from aniso_pm.kernel import RULES

# A scene takes seconds; after this long without a word the process counts as hanging.
HANGS = 180.0
# How long the case of the table renders.
SECONDS = 60.0


class _Dice:
    def __init__(self, seed: int):
        self.rng = np.random.default_rng(seed)

    def one_of(self, *values):
        return values[self.rng.integers(len(values))]

    def chance(self, p: float) -> bool:
        return bool(self.rng.random() < p)

    def between(self, low, high) -> float:
        return float(self.rng.uniform(low, high))

    def log(self, low, high) -> float:
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def color(self):
        return {"type": "rgb", "value": self.rng.random(3).tolist()}


def _bsdf(dice: _Dice, depth: int = 0):
    alphas = {"alpha_u": dice.log(1e-5, 1), "alpha_v": dice.log(1e-5, 1)}
    simple = {
        "diffuse": {"type": "diffuse", "reflectance": dice.color()},
        "metal": {"type": "roughconductor", "distribution": dice.one_of("beckmann", "ggx")}
        | alphas,
        "asg": {"type": "asgconductor"} | alphas,
        "mirror": {"type": "conductor"},
        "glass": {"type": "dielectric", "int_ior": dice.between(1.01, 2.5)},
        "thin": {"type": "thindielectric"},
        "frosted": {"type": "roughdielectric", "alpha": dice.log(1e-4, 1)},
        "plastic": {"type": dice.one_of("plastic", "roughplastic")},
        "principled": {
            "type": "principled",
            "base_color": dice.color(),
            "roughness": dice.between(0, 1),
            "anisotropic": dice.between(0, 1),
            "metallic": dice.between(0, 1),
        },
        "null": {"type": "null"},
    }
    nested = {
        "mask": lambda: {"type": "mask", "opacity": dice.between(0, 1), "nested": _bsdf(dice, 1)},
        "twosided": lambda: {
            "type": "twosided",
            "nested": simple[dice.one_of("diffuse", "metal", "asg", "plastic")],
        },
        "blend": lambda: {
            "type": "blendbsdf",
            "weight": dice.between(0, 1),
            "first": simple["metal"],
            "second": simple["diffuse"],
        },
    }
    name = dice.one_of(*simple, *(() if depth else nested))
    return simple[name] if name in simple else nested[name]()


def _thing(dice: _Dice):
    T = mi.ScalarTransform4f
    axis = dice.rng.normal(size=3)
    axis = (axis / np.linalg.norm(axis)).tolist()
    place = (
        T().translate(dice.rng.uniform(-0.7, 0.7, 3).tolist()).rotate(axis, dice.between(0, 360))
    )
    kind = dice.one_of("sphere", "rectangle", "cube", "disk", "cylinder")
    size = [dice.log(1e-3, 0.6)] * 3
    if kind in ("rectangle", "cube") and dice.chance(0.5):
        size = [dice.log(1e-4, 0.9) for _ in range(3)]
    return {
        "type": kind,
        "to_world": place.scale(size),
        "bsdf": _bsdf(dice),
        "flip_normals": dice.chance(0.2),
    }


def _light(dice: _Dice):
    T = mi.ScalarTransform4f
    position = dice.rng.uniform(-0.9, 0.9, 3).tolist()
    power = dice.log(1e-6, 1e6)
    aim = T().look_at(origin=position, target=dice.rng.uniform(-1, 1, 3).tolist(), up=[0.1, 1, 0.3])
    return dice.one_of(
        {"type": "point", "position": position, "intensity": grey(power)},
        {
            "type": "spot",
            "to_world": aim,
            "intensity": grey(power),
            "cutoff_angle": dice.between(1, 80),
        },
        {
            "type": "directional",
            "direction": [0.1, -1, dice.between(-1, 1)],
            "irradiance": grey(power),
        },
        {
            "type": "sphere",
            "center": position,
            "radius": dice.log(1e-4, 0.2),
            "bsdf": diffuse(0.5),
            "emitter": {"type": "area", "radiance": grey(power)},
        },
    )


def random_scene(seed: int) -> tuple[dict, dict]:
    """(scene, integrator) as dictionaries; the same for the same seed."""
    dice = _Dice(seed)
    walls = ["floor", "ceiling", "back", "front", "left", "right"]
    without = [name for name in walls if dice.chance(0.3)] + ["light"] * dice.chance(0.5)
    scene = room(without=without, light=dice.log(1e-3, 1e3))
    scene |= {f"thing{i}": _thing(dice) for i in range(dice.rng.integers(0, 5))}
    scene |= {f"lamp{i}": _light(dice) for i in range(dice.rng.integers(0, 3))}
    if dice.chance(0.15):
        scene["sky"] = {"type": "constant", "radiance": grey(dice.log(1e-6, 1e6))}
    scene["sensor"]["film"] = film(int(dice.rng.integers(1, 20)), int(dice.rng.integers(1, 20)))
    scene["sensor"]["film"]["rfilter"] = {"type": dice.one_of("box", "gaussian", "lanczos")}
    integrator = {
        "type": "aniso_pm",
        "kernel": dice.one_of("auto", "anisotropic", "isotropic"),
        "rule": dice.one_of(*RULES),
        "size": dice.one_of("bandwidth", "bandwidth", "epsilon"),
        "epsilon": dice.log(1e-8, 10),
        "guard": dice.chance(0.5),
        "max_aspect": dice.log(1, 1e4),
        "map": dice.one_of("global", "global", "caustic"),
        "gather_roughness": dice.between(0.1, 1),
        "photon_count": int(dice.log(1, 20_000)),
        "passes": int(dice.rng.integers(1, 4)),
        "alpha": dice.between(0.01, 1),
        "initial_radius": dice.one_of(0.0, 0.0, dice.log(1e-4, 2)),
        "edge_compensation": dice.chance(0.7),
        "max_depth": int(dice.one_of(-1, -1, 1, 2, 3, 8)),
        "rr_depth": int(dice.rng.integers(1, 10)),
        "hide_emitters": dice.chance(0.3),
    }
    if integrator["map"] == "global":
        integrator["final_gather"] = dice.chance(0.3)
    return scene, integrator


def render(seed: int) -> str | None:
    """What is wrong with that scene's picture, or None."""
    scene, integrator = random_scene(seed)
    try:
        image = mi.render(
            mi.load_dict(scene), integrator=mi.load_dict(integrator), spp=4, seed=seed
        )
    except Exception as error:
        reason = one_line(error.__cause__ or error)
        # A scene that the integrator refuses with its own sentence is fine.
        return None if isinstance(error.__cause__ or error, ValueError) else reason
    bad = int(np.sum(~np.isfinite(np.array(image))))
    return f"{bad} values that are not finite" if bad else None


def main(first: int, seconds: float) -> None:
    """Render scenes of the seeds first, first + 1, … for so many seconds, at least one."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    started, seed = time.monotonic(), first
    while seed == first or time.monotonic() - started < seconds:
        print("begin", seed, flush=True)
        print("end", seed, render(seed) or "", flush=True)
        seed += 1


def run(first: int, seconds: float) -> tuple[int, list[str]]:
    """(scenes rendered, findings) in a process of their own."""
    command = [
        sys.executable,
        "-m",
        "aniso_pm.instruments.stability.fuzz",
        str(first),
        str(seconds),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    lines: queue.Queue[str | None] = queue.Queue()

    def read():
        for line in process.stdout:
            lines.put(line)
        lines.put(None)

    threading.Thread(target=read, daemon=True).start()
    seed, done, findings = None, 0, []
    while True:
        try:
            line = lines.get(timeout=HANGS)
        except queue.Empty:
            process.kill()
            findings.append(f"seed {seed}: no answer in {HANGS:g} s")
            break
        if line is None:
            break
        word, _, rest = line.strip().partition(" ")
        if word == "begin":
            seed = rest
        elif word == "end":
            done += 1
            seed, _, trouble = rest.partition(" ")
            findings += [f"seed {seed}: {trouble}"] if trouble else []
    if process.wait() > 0 or process.returncode < 0 and not findings:
        findings.append(f"seed {seed}: the process ended with status {process.returncode}")
    return done, findings


def _fuzz() -> Measured:
    done, findings = run(0, SECONDS)
    words = f"{done} scenes; {'; '.join(findings)}" if findings else f"{done} scenes"
    return Measured(float(len(findings)) if done else float("nan"), words)


def cases() -> list[Case]:
    return [
        Case(
            "fuzz",
            f"random scenes for {SECONDS:g} s",
            "crashes, hangs, pixels not finite",
            0.0,
            _fuzz,
            slow=True,
        )
    ]


if __name__ == "__main__":
    main(int(sys.argv[1]), float(sys.argv[2]))
