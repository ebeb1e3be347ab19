"""Damage: of bytes, of text in cells, and of trees such as JSON."""

import json
from collections.abc import Sequence
from copy import deepcopy
from random import Random
from typing import Any

#: Numbers that readers of sizes, counts and type codes stumble over.
_EDGES = (0, 1, 2, 3, 7, 8, 9, 15, 16, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF,
          0x80000000, 0xFFFFFFFF, 0x7FFFFFFFFFFFFFFF, 0xFFFFFFFFFFFFFFFF)  # fmt: skip
#: What may stand in a cell, a name or a value of a text file, and what should not.
WORDS = (
    "", " ", "nan", "NaN", "inf", "-inf", "1e400", "-1e308", "1e308", "1e-320", "5e-324", "0", "-0",
    "1", "-1", "1_000", "0x10", "1,5", "1.5", "1e5", "1d5", "1.2.3", "--1", "+", ".", "e", "True",
    "None", "null", "#", "# x", '"', '""', "'", '"1"', '"a\nb"', "\t", ";", ",", ":", "=", "[", "]",
    "[s]", "[]", "[ms]", "[kV]", "[nm]", "[counts]", "[degC]", "time", "voltage", "displacement",
    "time [s]", "time [ms]", "voltage [V]", "displacement [um]", "load_force [N]", "current [mA]",
    "temperature [degC]", "1/0", "m/(s)", "1e999999", "９", "٣", "−1", "µm", "\u200b", "\ufeff",
    "\0", "\x1a", "\r", "\x0b", "\x85", "\u2028", "A" * 300, "9" * 400, "\ud7ff", "𝟗", "../x", "/",
)  # fmt: skip


def damaged_bytes(data: bytes, rng: Random, words: Sequence[bytes] = ()) -> bytes:
    """Return bytes with one to four damages, one of them most often."""
    result = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        _damage(result, rng)
        if words and rng.random() < 0.2:
            word, place = rng.choice(words), rng.randrange(len(result) + 1)
            result[place : place + len(word) * rng.choice((0, 1))] = word
    return bytes(result)


def _damage(data: bytearray, rng: Random) -> None:
    """Change a bit, a byte or a number; cut, insert, remove, repeat or blank a part."""
    place = rng.randrange(len(data) + 1)
    size = min(rng.choice((1, 1, 2, 4, 8, 64, 512)), len(data) - place)
    match rng.randrange(10):
        case 0 | 1 if place < len(data):
            data[place] ^= 1 << rng.randrange(8)
        case 2 if place < len(data):
            data[place] = rng.choice((0, 1, 255, 128, 127, rng.randrange(256)))
        case 3 | 4 if len(data) >= 8:
            _change_number(data, rng)
        case 5:
            data[place:place] = rng.randbytes(rng.choice((1, 1, 2, 4, 8, 64)))
        case 6:
            del data[place : place + size]
        case 7:
            del data[place:]
        case 8:
            data[place:place] = data[place : place + size] * rng.choice((1, 2, 9))
        case 9:
            data[place : place + size] = bytes([rng.choice((0, 255))]) * size


def _change_number(data: bytearray, rng: Random) -> None:
    """Put a number of 1 to 8 bytes where one may be; or change the one that is there."""
    size = rng.choice((1, 2, 4, 4, 8))
    place = rng.randrange(len(data) - size + 1)
    place -= place % size if rng.random() < 0.8 else 0
    order: Any = rng.choice(("little", "little", "big"))
    number = rng.choice((*_EDGES, len(data), len(data) - place))
    if rng.random() < 0.4:
        number = int.from_bytes(data[place : place + size], order) + rng.choice((-8, -1, 1, 8))
    data[place : place + size] = (number % (1 << 8 * size)).to_bytes(size, order)


def damaged_table(text: str, rng: Random) -> bytes:
    """Return a text of lines and cells with cells, lines, separators or ends changed."""
    lines = text.split("\n")
    mark = max(",;\t", key=lines[0].count)
    for _ in range(rng.choice((1, 1, 2, 3))):
        row = rng.choice((0, rng.randrange(len(lines)), rng.randrange(len(lines))))
        cells = lines[row].split(mark)
        column = rng.randrange(len(cells))
        match rng.randrange(9):
            case 0 | 1 | 2:
                cells[column] = rng.choice(WORDS)
            case 3 | 4:
                cells[column] = damaged_words(cells[column], rng, WORDS)
            case 5:
                cells.insert(column, rng.choice(WORDS))
            case 6:
                del cells[column]
            case 7:
                cells = rng.choice(lines).split(mark)
            case 8:  # one word in all cells of a column but the header's
                word = rng.choice(WORDS)
                below = [line.split(mark) for line in lines[1:]]
                filled = [[word if k == column else c for k, c in enumerate(r)] for r in below]
                lines[1:] = [mark.join(r) for r in filled]
        lines[row] = mark.join(cells)
    end = rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\n\n", " \n"))
    result = end.join(lines)
    result = result.replace(mark, rng.choice(",;\t |")) if rng.random() < 0.1 else result
    return result.encode("utf-8", "replace")


def damaged_words(text: str, rng: Random, words: Sequence[str]) -> str:
    """Return a short text with parts left out, repeated, changed or put in."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        a, b = sorted((rng.randrange(len(text) + 1), rng.randrange(len(text) + 1)))
        put = rng.choice((*words, *"0123456789.,-+eE"))
        match rng.randrange(4):
            case 0:
                text = text[:a] + text[b:]
            case 1:
                text = text[:b] + text[a:]
            case 2:
                text = text[:a] + put + text[b:]
            case 3:
                text = text[:a] + put + text[a + rng.choice((0, 1)) :]
        text = text[:2000]
    return text


#: Text in the place of a value which JSON cannot spell, put in after the tree is written.
_RAW = ("NaN", "Infinity", "-Infinity", "1e400", "-1e400", "9" * 5000, "1" * 310, "[" * 3000,
        '{"a":' * 2000, '"\\ud800"', "'x'", "0x1", "1.", "tru", '{"a": 1, "a": 2}')  # fmt: skip
_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 0.0, -0.0, 1e-320, 1e308, -1e308, 2**63, 2**64, 10**400, 0.5, "",
    "1", "nan", "\ud800", "\0", "x" * 500, "µm", "../../etc", [], {}, [[]], [None], [1], [1, 2],
    [2, 1], [1, 2, 3], ["x"], {"": 1}, {"value": 1}, {"name": "x", "module": "os", "sha256": ""},
    "<!--", "\r\n", "1e5",
)  # fmt: skip
_JSON_WORDS = (b"{", b"}", b"[", b"]", b",", b":", b'"', b"null", b"NaN", b"\\u0000", b"\xff",
               b"\xef\xbb\xbf", b"//", b"e999")  # fmt: skip


def damaged_json(tree: Any, rng: Random) -> bytes:
    """Return the JSON of a tree with nodes changed, removed, renamed or repeated; or other text."""
    tree = deepcopy(tree)
    raw = None
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        holder, key = _node(tree, rng)
        if holder is None:
            continue
        other, place = _node(tree, rng)
        match rng.randrange(7):
            case 0 | 1 | 2:
                holder[key] = deepcopy(rng.choice(_VALUES))  # a list may be changed itself next
            case 3:
                raw = rng.choice(_RAW)
                holder[key] = "RAW"
            case 4:
                moved = holder.pop(key)
                if isinstance(holder, dict) and rng.random() < 0.5:
                    holder[rng.choice(("", "x", f"{key} ", key.upper(), "__class__"))] = moved
            case 5:
                holder[key] = deepcopy(other[place])
            case 6:
                holder[key] = _nudged(holder[key], rng)
    text = json.dumps(tree, indent=rng.choice((None, 2)), ensure_ascii=rng.random() < 0.5)
    data = text.encode("utf-8", "surrogatepass")
    if raw is not None:
        data = data.replace(b'"RAW"', raw.encode())
    return damaged_bytes(data, rng, _JSON_WORDS) if rng.random() < 0.2 else data


def _node(tree: Any, rng: Random) -> tuple[Any, Any]:
    """Return a container and the key of one of its entries, drawn by walking down."""
    holder, key = None, None
    while isinstance(tree, dict | list) and tree:
        if holder is not None and rng.random() < 0.25:
            break
        holder = tree
        key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
        tree = holder[key]
    return holder, key


def _nudged(value: Any, rng: Random) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or abs(value) > 10**300:  # what is beyond a double already stays so
        return str(value) if rng.random() < 0.5 else [value]
    return rng.choice(
        (-value, value * 1e30, value * 1e-30, value * (1 + 1e-12), str(value), [value])
    )
