"""Cells of the experiment on disk: each is kept as it is finished, and found again if it fits.

A cell is a file ``NAME.npz`` of arrays, with a JSON text ``about`` that holds its *key*, all that
its content depends on, and its *record*. A cell whose key is another one (the scene has changed, or
the budgets, or the version) does not count.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from aniso_pm.pictures import output


@dataclass(frozen=True)
class Cell:
    record: dict[str, Any]
    arrays: dict[str, np.ndarray]

    @property
    def error(self) -> str | None:
        """What went wrong, in one line; None if nothing did."""
        return self.record.get("error")


@dataclass
class Store:
    """A directory of cells. ``stale`` names those that were found but did not fit."""

    directory: Path
    stale: list[str]

    def __init__(self, directory: Path):
        self.directory = directory
        self.stale = []

    def get(self, name: str, key: Mapping[str, Any]) -> Cell | None:
        """The cell, if there is one that fits and was no failure."""
        path = self._path(name)
        try:
            with np.load(path, allow_pickle=False) as file:
                about = json.loads(str(file["about"]))
                if about["key"] != _plain(key):
                    self.stale.append(name)
                    return None
                cell = Cell(about["record"], {k: file[k] for k in file.files if k != "about"})
        except FileNotFoundError:
            return None
        except Exception:  # whatever a damaged file may raise: it is made again
            self.stale.append(name)
            return None
        return None if cell.error else cell

    def put(
        self,
        name: str,
        key: Mapping[str, Any],
        record: Mapping[str, Any],
        arrays: Mapping[str, np.ndarray] | None = None,
    ) -> Cell:
        """Keep a cell; it appears on the disk whole or not at all."""
        path = self._path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        record, arrays = output.plain(record), dict(arrays or {})
        about = json.dumps({"key": _plain(key), "record": record}, ensure_ascii=False)
        with output.replacing(path) as partial:
            np.savez_compressed(partial, about=np.array(about), **arrays)
        return Cell(record, arrays)

    def _path(self, name: str) -> Path:
        return self.directory / f"{name}.npz"


def _plain(key: Mapping[str, Any]) -> Any:
    return json.loads(json.dumps(output.plain(key)))
