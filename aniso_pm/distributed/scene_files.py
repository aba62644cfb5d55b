"""A scene in XML and all files that it names, under names of their own.

The closure of a scene is found in its text: included files, and whatever an attribute ``filename``
or a parameter ``filename`` names, with the parameters of the scene (``$key``) put in. Each file
gets a folder of its own, with a number for a name, in which it keeps its own name (objects are
called after their files); the text says that instead, so that it depends on no other folder any
more. The rest of the text, numbers above all, stays as it is. Names are looked up as Mitsuba does:
beside the scene, in the folders that ``<path>`` adds, in the working directory.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from aniso_pm.errors import InputError

MAIN = "scene.xml"


class Closure:
    """Files of a scene: ``files`` is packed name → content, ``sources`` packed name → where from;
    ``defines`` are the parameters that its text still has.

    scene    the XML file.
    defines  values of its parameters.

    Raises InputError for a file that is not there, naming it and the element that wants it.
    """

    def __init__(self, scene: Path, defines: dict[str, str]):
        self.files: dict[str, bytes] = {}
        self.sources: dict[str, Path] = {}
        self._names: dict[Path, str] = {}
        self._folders = [Path(scene).resolve().parent, Path.cwd()]
        self._values = dict(defines)
        self._texts: list[str] = []
        self._text(Path(scene).resolve(), MAIN)
        # Mitsuba refuses parameters that nothing uses, any more.
        texts = [self.files[name].decode() for name in self._texts]
        used = {name for text in texts for name in re.findall(self._pattern(), text)}
        self.defines = {name: value for name, value in defines.items() if name in used}

    def _text(self, path: Path, name: str) -> None:
        """Take in an XML file, and what it names."""
        self._names[path], self.sources[name] = name, path
        self._texts.append(name)
        root = ElementTree.fromstring(path.read_bytes())
        for parent in root.iter():
            for element in list(parent):
                self._element(path, parent, element)
        self.files[name] = ElementTree.tostring(root, encoding="utf-8")

    def _element(self, path: Path, parent, element) -> None:
        if element.tag == "default" and "value" in element.attrib:
            value = self._filled(element.get("value"))
            self._values.setdefault(element.get("name", ""), value)
        elif element.tag == "path":
            self._folders.insert(1, self._found(path, element, element.get("value", "")))
            parent.remove(element)
        elif element.tag == "include":
            wanted = self._found(path, element, element.get("filename", ""))
            if wanted not in self._names:
                self._text(wanted, f"include_{len(self._names)}.xml")
            element.set("filename", self._names[wanted])
        elif "filename" in element.attrib:
            element.set("filename", self._taken(path, element, element.get("filename")))
        elif element.get("name") == "filename" and "value" in element.attrib:
            element.set("value", self._taken(path, parent, element.get("value")))

    def _taken(self, path: Path, element, name: str) -> str:
        """The packed name of a file."""
        wanted = self._found(path, element, name)
        if wanted not in self._names:
            packed = packed_name(len(self._names), wanted)
            self._names[wanted], self.sources[packed] = packed, wanted
            self.files[packed] = wanted.read_bytes()
        return self._names[wanted]

    def _found(self, path: Path, element, name: str) -> Path:
        name = self._filled(name)
        for folder in self._folders:
            if (folder / name).exists():
                return (folder / name).resolve()
        kind = f' type="{element.get("type")}"' if element.get("type") else ""
        identity = f' id="{element.get("id")}"' if element.get("id") else ""
        raise InputError(
            f"{path}: <{element.tag}{kind}{identity}> names the file '{name}', which is not there"
        )

    def _filled(self, text: str) -> str:
        """With the values of parameters. The longest name that fits counts, as in Mitsuba."""
        return re.sub(self._pattern(), lambda match: self._values[match[1]], text)

    def _pattern(self) -> str:
        names = sorted(filter(None, self._values), key=len, reverse=True)
        return r"\$(" + "|".join(map(re.escape, names)) + ")" if names else r"(?!)()"


def packed_name(number: int, path: Path) -> str:
    """Of a file in the archive: a folder of its own, its own name."""
    return f"{number}/{path.name}"
