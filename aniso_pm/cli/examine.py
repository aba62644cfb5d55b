"""``aniso-pm inspect``, ``stability`` and ``doctor``: what tells rather than renders."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer
from aniso_pm.errors import InputError, one_line

from .common import (
    Define,
    Samples,
    SceneFile,
    Variant,
    load,
    make_directory,
    mitsuba_log,
    parse_defines,
    require_file,
    set_variant,
)


def inspect(
    scene: SceneFile,
    variant: Variant = "llvm_ad_rgb",
    define: Define = None,
    spp: Samples = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON list.")] = False,
) -> int:
    """Say what a scene needs of the photon mapper, what is left out, and why.

    A scene whose integrator is another one is inspected for aniso_pm with default parameters.
    """
    require_file(scene)
    set_variant(variant)
    with mitsuba_log(quiet=False):
        world, _, integrator = load(scene, parse_defines(define or []), 0, needed=False)
        from aniso_pm.instruments import inspect as inspection
        from aniso_pm.rendering.prepared import prepare
        from aniso_pm.rendering.settings import Settings

        settings = getattr(integrator, "settings", None) or Settings()
        try:
            prepared = prepare(world, settings, False)
            findings = inspection.examine(prepared, compile_=True, spp=spp or 0)
        except ValueError as error:
            raise InputError(one_line(error)) from error
    if as_json:
        print(json.dumps(inspection.as_data(findings), indent=2, ensure_ascii=False))
    else:
        print(inspection.as_text(findings))
    return 0


def stability(
    out: Annotated[Path, typer.Option("--output", "-o", help="Directory to write into.")],
    variant: Variant = "llvm_ad_rgb",
    quick: Annotated[bool, typer.Option("--quick", help="Leave out the slow cases.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the record instead of the table.")
    ] = False,
) -> int:
    """Measure extreme cases against 50-digit references and write the table.

    Writes stability.json, stability.html and stability.md. Exit status 1 if a case fails.
    """
    try:
        import jinja2  # noqa: F401
        import mpmath  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"this needs {error.name}, which is not installed: pip install 'aniso-pm[stability]'"
        ) from error
    make_directory(out)
    set_variant(variant)

    from aniso_pm.instruments.doctor import versions
    from aniso_pm.instruments.stability import all_cases, case, page

    rows = []
    with mitsuba_log(quiet=True):
        for row in case.run(all_cases(), quick):
            rows.append(row)
            if not as_json:
                print(page.line(row), flush=True)
    about = {"versions": versions(), "variant": variant, "quick": quick}
    found = page.record(rows, about)
    paths = page.write(out, found)
    if as_json:
        print(json.dumps(found, indent=2, ensure_ascii=False))
    else:
        print(f"{page.summary(found['counts'])}; written: {', '.join(map(str, paths))}")
    return int(found["counts"][case.FAIL] > 0)


def doctor(
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> int:
    """Say what is installed and whether it works, with the fix for what does not."""
    from aniso_pm.instruments import doctor as examination

    checks = examination.examine()
    print(examination.as_json(checks) if as_json else examination.as_text(checks))
    return int(any(check.fix for check in checks))
