"""Icons of an FMU, drawn from rectangles: as PNG and as SVG, the same bytes on every machine."""

import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass

from psa_casadi.model.compose import Model

#: Side of every icon in pixels of the PNG and in units of the SVG.
SIDE = 128

_CERAMIC, _ELECTRODE, _METAL, _LEAD = "#d9dcdf", "#e69f00", "#5b666f", "#0072b2"
_CLEAR = "#ffffff"
_DEFLATE_BLOCK = 0xFFFF


@dataclass(frozen=True)
class Rectangle:
    """A filled rectangle: left, top, width, height in pixels of a square of `SIDE`; its colour."""

    left: int
    top: int
    width: int
    height: int
    colour: str


def _stack() -> tuple[Rectangle, ...]:
    """Return a stack between two end pieces: wafers, electrodes, a lead on either side."""
    wafers = 8
    layers = [Rectangle(36, 20 + 11 * k, 56, 11, _CERAMIC) for k in range(wafers)]
    electrodes = [
        Rectangle(30 if k % 2 else 36, 19 + 11 * k, 62, 2, _ELECTRODE) for k in range(wafers + 1)
    ]
    ends = [Rectangle(32, 8, 64, 12, _METAL), Rectangle(24, 108, 80, 12, _METAL)]
    leads = [Rectangle(28, 20, 3, 88, _LEAD), Rectangle(97, 20, 3, 88, _LEAD)]
    arms = [Rectangle(8, 90, 20, 3, _LEAD), Rectangle(100, 90, 20, 3, _LEAD)]
    return (*layers, *electrodes, *ends, *leads, *arms)


def _block() -> tuple[Rectangle, ...]:
    """Return a plain box with a lead on either side."""
    leads = [Rectangle(4, 60, 16, 8, _LEAD), Rectangle(108, 60, 16, 8, _LEAD)]
    return (*leads, Rectangle(20, 20, 88, 88, _METAL), Rectangle(28, 28, 72, 72, _CERAMIC))


#: What each drawing shows, by its name.
ICONS: dict[str, tuple[Rectangle, ...]] = {
    "stack": _stack(),
    "block": _block(),
    "electrical": (Rectangle(0, 0, SIDE, SIDE, _LEAD), Rectangle(16, 16, 96, 96, _CLEAR)),
    "mechanical": (Rectangle(0, 0, SIDE, SIDE, _METAL),),
}


def drawing_of(model: Model) -> str:
    """Return the drawing of a model: a stack if it has its voltage and displacement, else a box."""
    is_stack = "voltage" in model.input_names and "displacement" in model.output_names
    return "stack" if is_stack else "block"


def svg(shapes: Sequence[Rectangle]) -> str:
    """Return the shapes as an SVG document."""
    lines = [
        f'<rect x="{s.left}" y="{s.top}" width="{s.width}" height="{s.height}" fill="{s.colour}"/>'
        for s in shapes
    ]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIDE} {SIDE}">'
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', head, *lines, "</svg>", ""])


def png(shapes: Sequence[Rectangle]) -> bytes:
    """Return the shapes as a PNG of 16 colours at most, on a transparent ground.

    The data are stored, not compressed, since compressors differ between versions of zlib.
    Source: PNG, third edition, section 5 (chunks), 11.2 (IHDR, PLTE, IDAT) and 11.3.1 (tRNS).
    """
    colours = [_CLEAR, *dict.fromkeys(s.colour for s in shapes)]
    pixels = [[0] * SIDE for _ in range(SIDE)]
    for s in shapes:
        number = colours.index(s.colour, 1)
        for row in pixels[s.top : s.top + s.height]:
            row[s.left : s.left + s.width] = [number] * s.width
    rows = b"".join(
        b"\0" + bytes(a << 4 | b for a, b in zip(row[::2], row[1::2], strict=True))
        for row in pixels
    )
    header = struct.pack(">IIBBBBB", SIDE, SIDE, 4, 3, 0, 0, 0)
    palette = b"".join(bytes.fromhex(c[1:]) for c in colours)
    chunks = ((b"IHDR", header), (b"PLTE", palette), (b"tRNS", b"\0"), (b"IDAT", _stored(rows)))
    return b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*c) for c in (*chunks, (b"IEND", b"")))


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _stored(data: bytes) -> bytes:
    """Return a zlib stream that stores its data (RFC 1950 and 1951)."""
    stream = b"\x78\x01"
    for begin in range(0, len(data), _DEFLATE_BLOCK):
        part = data[begin : begin + _DEFLATE_BLOCK]
        last = begin + _DEFLATE_BLOCK >= len(data)
        stream += struct.pack("<BHH", last, len(part), len(part) ^ 0xFFFF) + part
    return stream + struct.pack(">I", zlib.adler32(data))
