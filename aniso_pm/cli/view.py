"""``aniso-pm view``: watch a picture getting better, in a browser."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer
from aniso_pm.errors import InputError, one_line

from .common import (
    INTERRUPTED,
    Camera,
    Define,
    Integrator,
    Layers,
    Parameter,
    Passes,
    Samples,
    Seconds,
    Seed,
    TargetError,
    Variant,
    load,
    mitsuba_log,
    parse_defines,
    parse_parameters,
    require_file,
    set_variant,
    stopping_rules,
)
from .pictures import Pictures
from .render import record_of

# Seconds that stand for no end.
_ENDLESS = 1e9


def view(
    scene: Annotated[
        Path, typer.Argument(help="Scene in Mitsuba's XML format, or a state (.state) to watch.")
    ],
    out: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Picture to save; default: the scene's name, here."),
    ] = None,
    variant: Variant = "llvm_ad_rgb",
    define: Define = None,
    spp: Samples = None,
    seed: Seed = 0,
    passes: Passes = None,
    seconds: Seconds = None,
    target_error: TargetError = None,
    sensor: Camera = 0,
    integrator_name: Integrator = None,
    parameter: Parameter = None,
    layer_names: Layers = None,
    host: Annotated[str, typer.Option(help="Address to listen at.")] = "127.0.0.1",
    allow_others: Annotated[
        bool, typer.Option("--allow-others", help="Let --host be reachable from other machines.")
    ] = False,
    port: Annotated[int, typer.Option(min=0, max=65535, help="0: any that is free.")] = 0,
    browser: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="No warnings.")] = False,
) -> int:
    """Render, and show on a page of this machine how the picture gets better.

    Prints the address of the page, with a token without which nobody sees it. There the rendering
    is paused, stopped and saved, begun again with other parameters, and asked about single pixels.
    It goes on until somebody stops it, unless --passes, --time or --target-error end it. The
    program ends by the button on the page, or by Ctrl-C, with the picture so far saved.

    Given the state of a rendering that runs elsewhere (--keep-state, or any while it runs), the
    page shows that one.
    """
    from aniso_pm.view import server

    server.check_host(host, allow_others)
    require_file(scene)
    try:
        import flask  # noqa: F401
    except ImportError as error:
        raise server.missing() from error
    rules = stopping_rules(passes, seconds, target_error)
    with mitsuba_log(quiet):
        if scene.suffix.lower() == ".state":
            _check_not_given(
                output=out,
                define=define,
                spp=spp,
                **rules,
                integrator=integrator_name,
                p=parameter,
                layers=layer_names,
            )
            shown: Any = _watched(scene)
        else:
            pictures = Pictures.checked(
                out or Path(scene.with_suffix(".exr").name), False, 0, "srgb", 8, False
            )
            defines = parse_defines(define or [])
            parameters = parse_parameters(parameter, layers=layer_names, **rules)
            set_variant(variant)
            world, camera, integrator = load(scene, defines, sensor, integrator_name, parameters)
            if not hasattr(integrator, "stop_after"):
                raise InputError(
                    f"{scene}: the integrator is {integrator.class_name()}, which cannot be "
                    "watched; add --integrator aniso_pm"
                )
            try:
                integrator.stop_after(**(rules or {"time": _ENDLESS}))
                if layer_names is not None:
                    integrator.settings = integrator.settings.with_(layers=layer_names)
            except ValueError as error:
                raise InputError(one_line(error)) from error
            made_by = {"scene": scene.name, "variant": variant, "seed": seed, "defines": defines}

            def save() -> list[Path]:
                record = record_of(integrator, camera) | made_by
                pictures.write(camera.film(), record, integrator.variance, integrator.layers)
                return [pictures.out]

            from aniso_pm.view.session import Session

            shown = Session(scene.name, world, camera, integrator, seed, spp or 0, save)
        address, close = server.serve(shown, host, port, allow_others)
        print(address, flush=True)
        if browser:
            webbrowser.open(address)
        try:
            shown.run()
        except KeyboardInterrupt:
            if getattr(shown, "snapshot", None) is not None and shown.steered:
                print(f"aniso-pm: saved {', '.join(str(path) for path in save())}", flush=True)
            return INTERRUPTED
        finally:
            close()
    return 0


def _check_not_given(**options: Any) -> None:
    """An InputError for options that a rendering elsewhere cannot be given."""
    given = [name for name, value in options.items() if value is not None]
    if given:
        names = (f"--{name.replace('_', '-')}" if len(name) > 1 else f"-{name}" for name in given)
        raise InputError(f"{', '.join(names)}: a state that is watched is rendered elsewhere")


def _watched(path: Path):
    from aniso_pm.rendering.state import StateError
    from aniso_pm.view.watched import Watched

    try:
        return Watched(path)
    except (StateError, ValueError) as error:
        raise InputError(str(error)) from error
