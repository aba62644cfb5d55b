"""What ``render`` and ``merge`` write: the EXR with its layers, and the PNG."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from aniso_pm.errors import InputError
from aniso_pm.pictures import output

Png = Annotated[bool, typer.Option("--png", help="Also write a PNG beside it.")]
Exposure = Annotated[
    float, typer.Option(min=-100, max=100, help="Of the PNG, in stops: 1 is twice as bright.")
]
Tonemap = Annotated[
    str, typer.Option(metavar="CURVE", help="Of the PNG: srgb clips, aces is a filmic curve.")
]
Bits = Annotated[int, typer.Option(help="Of a channel of the PNG: 8 or 16.")]
Denoise = Annotated[
    bool,
    typer.Option(
        "--denoise", help="Also write the layer denoised.*, which is then what the PNG shows."
    ),
]


_TEXTURE = (
    "aniso-pm: warning: denoising takes noise for texture where the reconstruction filter is wider "
    'than a pixel; render with aniso_pm and --layers denoising, or with <rfilter type="box"/>'
)


@dataclass(frozen=True)
class Pictures:
    """What is to be written, found to be possible before anything slow.

    out   the EXR; png: the PNG beside it, or None.
    """

    out: Path
    png: Path | None
    exposure: float
    tonemap: str
    bits: int
    denoise: bool

    @staticmethod
    def checked(
        out: Path, png: bool, exposure: float, tonemap: str, bits: int, denoise: bool
    ) -> Pictures:
        """Raises InputError or OutputError, in one line, for what cannot be written."""
        from aniso_pm.pictures import denoising, display

        if out.suffix.lower() != ".exr":
            raise InputError(
                f"cannot write '{out}': the output's name must end in .exr; --png writes a PNG "
                "beside it"
            )
        if bits not in (8, 16):
            raise InputError(f"--bits is {bits}; a PNG has 8 or 16 bits a channel")
        if not png and (exposure or tonemap != "srgb" or bits != 8):
            raise InputError("--exposure, --tonemap and --bits are those of the PNG; add --png")
        picture = out.with_suffix(".png") if png else None
        for path in filter(None, [out, picture]):
            output.check_writable(path)
        display.check_tonemap(tonemap)
        if denoise:
            denoising.check_installed()
        return Pictures(out, picture, exposure, tonemap, bits, denoise)

    def check_film(self, film) -> None:
        """Raises InputError for a film whose pixels are no colours, where colours are needed."""
        import mitsuba as mi

        if mi.has_flag(film.flags(), mi.FilmFlags.Special) and (self.png or self.denoise):
            option = "--png" if self.png else "--denoise"
            raise InputError(f"{option}: the pixels of a {film.class_name()} are no colours")

    def write(
        self,
        film,
        record: dict[str, Any],
        variance=None,
        layers: Mapping[str, Any] | None = None,
        weights: Sequence[float] = (1.0,),
    ) -> None:
        """Write the film; what was done to denoise it goes into ``record``.

        weights  of the filter that the picture was made with (``film.pixel_weights``).
        """
        from aniso_pm.pictures import denoising, display

        layers = dict(layers or {})
        colours = display.colours(film)
        if colours is None:
            output.write_exr(film, self.out, record, variance, layers)
            if self.denoise or self.png:
                raise output.OutputError(f"'{self.out}' is written, but its pixels are no colours")
            return
        if self.denoise:
            known = dict(layers)
            if variance is not None:
                known["standard_error"] = variance[..., :3] ** 0.5
            layers["denoised"] = denoising.denoise(colours, known)
            record["denoise"] = denoising.about(known)
            if len(weights) > 1 and not record["denoise"]["without_pixel_filter"]:
                print(_TEXTURE, file=sys.stderr)
            colours[..., :3] = layers["denoised"]
        output.write_exr(film, self.out, record, variance, layers)
        if self.png:
            display.write_png(colours, self.png, self.exposure, self.tonemap, self.bits, record)
