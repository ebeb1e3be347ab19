"""Icons of an FMU, drawn from rectangles: as PNG and as SVG, the same bytes on every machine."""

import struct
import zlib
from collections.abc import Sequence

from psa_casadi.model.compose import Model

#: A filled rectangle: left, top, width, height in pixels of a square of `SIDE`; its colour.
Rectangle = tuple[int, int, int, int, str]

#: Side of every icon in pixels of the PNG and in units of the SVG.
SIDE = 128

_CERAMIC, _ELECTRODE, _METAL, _LEAD = "#d9dcdf", "#e69f00", "#5b666f", "#0072b2"
_CLEAR = "#ffffff"

#: What each drawing shows, by its name.
ICONS: dict[str, tuple[Rectangle, ...]] = {
    # a stack between two end pieces: wafers, electrodes, a lead on either side
    "stack": (
        *((36, 20 + 11 * k, 56, 11, _CERAMIC) for k in range(8)),
        *((30 if k % 2 else 36, 19 + 11 * k, 62, 2, _ELECTRODE) for k in range(9)),
        (32, 8, 64, 12, _METAL), (24, 108, 80, 12, _METAL),
        (28, 20, 3, 88, _LEAD), (97, 20, 3, 88, _LEAD),
        (8, 90, 20, 3, _LEAD), (100, 90, 20, 3, _LEAD),
    ),
    # a plain box with a lead on either side
    "block": (
        (4, 60, 16, 8, _LEAD), (108, 60, 16, 8, _LEAD),
        (20, 20, 88, 88, _METAL), (28, 28, 72, 72, _CERAMIC),
    ),
    "electrical": ((0, 0, SIDE, SIDE, _LEAD), (16, 16, 96, 96, _CLEAR)),
    "mechanical": ((0, 0, SIDE, SIDE, _METAL),),
}  # fmt: skip


def drawing_of(model: Model) -> str:
    """Return the drawing of a model: a stack if it has its voltage and displacement, else a box."""
    is_stack = "voltage" in model.input_names and "displacement" in model.output_names
    return "stack" if is_stack else "block"


def svg(shapes: Sequence[Rectangle]) -> str:
    """Return the shapes as an SVG document."""
    lines = [
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="{colour}"/>'
        for left, top, width, height, colour in shapes
    ]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIDE} {SIDE}">'
    return "\n".join(['<?xml version="1.0" encoding="UTF-8"?>', head, *lines, "</svg>", ""])


def png(shapes: Sequence[Rectangle]) -> bytes:
    """Return the shapes as a PNG of 16 colours at most, on a transparent ground.

    The data are stored, not compressed, since compressors differ between versions of zlib.
    Sources: PNG, third edition, section 5 (chunks), 11.2 (IHDR, PLTE, IDAT) and 11.3.1 (tRNS); RFC
    1950 and 1951 (one stored block, which takes 65,535 bytes).
    """
    colours = [_CLEAR, *dict.fromkeys(colour for *_, colour in shapes)]
    pixels = [[0] * SIDE for _ in range(SIDE)]
    for left, top, width, height, colour in shapes:
        for row in pixels[top : top + height]:
            row[left : left + width] = [colours.index(colour, 1)] * width
    rows = b"".join(
        b"\0" + bytes(a << 4 | b for a, b in zip(row[::2], row[1::2], strict=True))
        for row in pixels
    )
    stored = struct.pack("<BHH", 1, len(rows), len(rows) ^ 0xFFFF) + rows
    chunks = {
        b"IHDR": struct.pack(">IIBBBBB", SIDE, SIDE, 4, 3, 0, 0, 0),
        b"PLTE": b"".join(bytes.fromhex(c[1:]) for c in colours),
        b"tRNS": b"\0",
        b"IDAT": b"\x78\x01" + stored + struct.pack(">I", zlib.adler32(rows)),
        b"IEND": b"",
    }
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks.items()
    )
