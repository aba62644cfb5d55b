"""What travels to a worker, once: the scene with all its files, as one archive.

The archive is a tar of files, each in a folder whose name is a number, and of XML beside those. It
is hashed; whoever unpacks it makes a new folder below a directory of its own, and takes regular
files with such names only: nothing that arrives can name another place. The folder goes as soon as
the scene is loaded.
"""

from __future__ import annotations

import hashlib
import io
import re
import tarfile
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from . import dictionaries
from .scene_files import MAIN, Closure

# What may be unpacked. No other name has a place: no "..", nothing absolute, no folder in a folder.
_ALLOWED = re.compile(r"[0-9]{1,9}/(?!\.{1,2}$)[^/\\\0]{1,255}|[a-z0-9_]{1,64}\.xml")


class BadParcel(ValueError):
    """What arrived is not what was sent, or would unpack to another place."""


@dataclass(frozen=True)
class Parcel:
    """A scene that can be sent.

    archive  bytes of a tar file, as an array: those travel without being copied.
    sha256   of the archive.
    plain    None, or the scene as a dictionary (see ``dictionaries``).
    defines  values of parameters of a scene in XML.
    sources  where its files were found.
    """

    archive: np.ndarray
    sha256: str
    plain: dict[str, Any] | None
    defines: dict[str, str]
    sources: dict[str, str]

    @staticmethod
    def of(scene: str | Path | Mapping[str, Any], defines: dict[str, str] | None = None) -> Parcel:
        """Of a scene file or dictionary. Raises InputError for a file that is not there."""
        if isinstance(scene, Mapping):
            plain, files, sources = dictionaries.packed(scene)
            values: dict[str, str] = {}
        else:
            found = Closure(Path(scene), defines or {})
            plain, files, sources, values = None, found.files, found.sources, found.defines
        data = _archive(files)
        return Parcel(
            np.frombuffer(data, np.uint8),
            hashlib.sha256(data).hexdigest(),
            plain,
            values,
            {name: str(path) for name, path in sources.items()},
        )

    @contextmanager
    def unpacked(self, directory: Path) -> Iterator[Path]:
        """The folder with the files, below ``directory``, as long as the block runs. Raises
        BadParcel, and OSError where there is no room."""
        with ExitStack() as stack:
            try:
                directory.mkdir(parents=True, exist_ok=True)
                made = tempfile.TemporaryDirectory(prefix="scene-", dir=directory)
                folder = Path(stack.enter_context(made))
                self._unpack(folder)
            except OSError as error:
                what = f"cannot unpack the scene: {error.strerror}"
                raise OSError(error.errno, what, str(directory)) from error
            yield folder

    def _unpack(self, folder: Path) -> None:
        data = self.archive.tobytes()
        if hashlib.sha256(data).hexdigest() != self.sha256:
            raise BadParcel("the scene's archive was damaged on the way")
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            for member in archive:
                if not (member.isreg() and _ALLOWED.fullmatch(member.name)):
                    raise BadParcel(f"the scene's archive names '{member.name}': refused")
                path = folder / member.name
                path.parent.mkdir(exist_ok=True)
                content = archive.extractfile(member)
                with open(path, "xb") as file:
                    file.write(content.read() if content else b"")

    def load(self, directory: Path):
        """The scene as Mitsuba has it; unpacked below ``directory`` while it is loaded."""
        import mitsuba as mi

        with self.unpacked(directory) as folder:
            if self.plain is not None:
                return mi.load_dict(dictionaries.unpacked(self.plain, folder), optimize=False)
            return mi.load_file(str(folder / MAIN), optimize=False, **self.defines)


def _archive(files: dict[str, bytes]) -> bytes:
    """The same for the same content."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name in sorted(files):
            entry = tarfile.TarInfo(name)
            entry.size = len(files[name])
            archive.addfile(entry, io.BytesIO(files[name]))
    return buffer.getvalue()
