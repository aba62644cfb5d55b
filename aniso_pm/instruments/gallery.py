"""The scenes that come with the library, and copies of them to play with (``aniso-pm scenes``)."""

from __future__ import annotations

import re
import shutil
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from ..errors import InputError

_PARTS = ("*.xml", "README.md", "meshes/*.ply", "textures/*.png", "references/*.exr")


@dataclass(frozen=True)
class Scene:
    """One scene. about: the paragraph that opens its file."""

    name: str
    file: Path
    about: str


def directory() -> Path:
    """Where the gallery is installed."""
    return Path(str(resources.files("aniso_pm.scenes")))


def scenes() -> list[Scene]:
    """All scenes, by name."""
    return [Scene(path.stem, path, _about(path)) for path in sorted(directory().glob("*.xml"))]


def _about(path: Path) -> str:
    comment = re.search(r"<!--\s*(.*?)(\n\s*\n|-->)", path.read_text(encoding="utf-8"), re.DOTALL)
    return " ".join(comment[1].split()) if comment else ""


def copy(target: Path, force: bool = False) -> list[Path]:
    """Copy the gallery into the directory ``target``, made if need be: the files written.

    Raises InputError where that cannot be, and, unless ``force``, if one of the files is there.
    """
    source, target = directory(), Path(target)
    files = [p.relative_to(source) for pattern in _PARTS for p in sorted(source.glob(pattern))]
    there = [target / file for file in files if (target / file).exists()]
    if there and not force:
        more = f" and {len(there) - 1} more" if len(there) > 1 else ""
        raise InputError(
            f"{there[0]}{more}: already there; name another directory, or overwrite with --force"
        )
    for file in files:
        try:
            (target / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(source / file, target / file)
        except OSError as error:
            raise InputError(f"cannot write '{target / file}': {error.strerror}") from error
    return [target / file for file in files]
