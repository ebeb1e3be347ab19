"""Damage: of bytes, of text in cells, and of trees such as JSON."""

import json
from collections.abc import Callable, Sequence
from copy import deepcopy
from random import Random
from typing import Any

#: Numbers that readers of sizes, counts and type codes stumble over.
EDGES = (0, 1, 2, 3, 7, 8, 9, 15, 16, 127, 128, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF,
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
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 4))):
        rng.choice(_BYTES)(found, rng)
        if words and rng.random() < 0.2:
            _put(found, rng, rng.choice(words))
    return bytes(found)


def _flip(data: bytearray, rng: Random) -> None:
    if data:
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def _replace(data: bytearray, rng: Random) -> None:
    if data:
        data[rng.randrange(len(data))] = rng.choice((0, 1, 255, 128, 127, rng.randrange(256)))


def _insert(data: bytearray, rng: Random) -> None:
    place = rng.randrange(len(data) + 1)
    data[place:place] = rng.randbytes(rng.choice((1, 1, 2, 4, 8, 64)))


def _remove(data: bytearray, rng: Random) -> None:
    place = rng.randrange(len(data) + 1)
    del data[place : place + rng.choice((1, 1, 2, 4, 8, 64, 512))]


def _cut(data: bytearray, rng: Random) -> None:
    del data[rng.randrange(len(data) + 1) :]


def _repeat(data: bytearray, rng: Random) -> None:
    place = rng.randrange(len(data) + 1)
    data[place:place] = data[place : place + rng.choice((1, 4, 16, 128))] * rng.choice((1, 2, 9))


def _blank(data: bytearray, rng: Random) -> None:
    place = rng.randrange(len(data) + 1)
    size = min(rng.choice((4, 8, 32, 256)), len(data) - place)
    data[place : place + size] = bytes([rng.choice((0, 255))]) * size


def _number(data: bytearray, rng: Random) -> None:
    """Put a number of 1 to 8 bytes where one may stand; or change the one that stands there."""
    size = rng.choice((1, 2, 4, 4, 8))
    if len(data) < size:
        return
    place = rng.randrange(len(data) - size + 1)
    place -= place % size if rng.random() < 0.8 else 0
    order: Any = rng.choice(("little", "little", "big"))
    number = rng.choice((*EDGES, len(data), len(data) - place))
    if rng.random() < 0.4:
        number = int.from_bytes(data[place : place + size], order) + rng.choice((-8, -1, 1, 8))
    data[place : place + size] = (number % (1 << 8 * size)).to_bytes(size, order)


def _swap(data: bytearray, rng: Random) -> None:
    if len(data) > 16:
        a, b = rng.randrange(len(data) - 8), rng.randrange(len(data) - 8)
        data[a : a + 8], data[b : b + 8] = data[b : b + 8], data[a : a + 8]


def _put(data: bytearray, rng: Random, word: bytes) -> None:
    place = rng.randrange(len(data) + 1)
    end = place + (len(word) if rng.random() < 0.5 else 0)
    data[place:end] = word


_BYTES: tuple[Callable[[bytearray, Random], None], ...] = (
    _flip, _flip, _replace, _insert, _remove, _cut, _repeat, _blank, _number, _number, _swap,
)  # fmt: skip


def damaged_table(text: str, rng: Random, words: Sequence[str] = WORDS) -> str:
    """Return a text of lines and cells with cells, lines, separators or ends changed."""
    lines = text.split("\n")
    mark = max(",;\t", key=lines[0].count)
    for _ in range(rng.choice((1, 1, 2, 3))):
        row = rng.choice((0, rng.randrange(len(lines)), rng.randrange(len(lines))))
        if rng.random() < 0.1:
            _fill_column(lines, mark, rng, words)
        lines[row] = mark.join(_damaged_cells(lines[row].split(mark), rng, words))
        if rng.random() < 0.1:
            lines[row] = rng.choice(lines)
    end = rng.choice(("\n", "\n", "\n", "\r\n", "\r", "\n\n", " \n"))
    found = end.join(lines)
    return found.replace(mark, rng.choice(",;\t |")) if rng.random() < 0.1 else found


def _fill_column(lines: list[str], mark: str, rng: Random, words: Sequence[str]) -> None:
    """Put one word, or one word after the other, into all cells of a column but the header's."""
    column, word = rng.randrange(4), rng.choice(words)
    for k, line in enumerate(lines[1:], 1):
        cells = line.split(mark)
        if column < len(cells):
            cells[column] = word if rng.random() < 0.9 else rng.choice(words)
            lines[k] = mark.join(cells)


def _damaged_cells(cells: list[str], rng: Random, words: Sequence[str]) -> list[str]:
    column = rng.randrange(len(cells))
    match rng.randrange(8):
        case 0 | 1 | 2:
            cells[column] = rng.choice(words)
        case 3 | 4:
            cells[column] = _damaged_word(cells[column], rng, words)
        case 5:
            cells.insert(column, rng.choice(words))
        case 6:
            del cells[column]
        case 7:
            cells.reverse()
    return cells


def _damaged_word(word: str, rng: Random, words: Sequence[str]) -> str:
    place = rng.randrange(len(word) + 1)
    put: str = rng.choice((*words, *"0123456789.,-+eE"))
    return word[:place] + put + word[place + rng.choice((0, 1)) :]


def damaged_words(text: str, rng: Random, words: Sequence[str]) -> str:
    """Return a short text with parts left out, repeated, changed or put in."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        a, b = sorted((rng.randrange(len(text) + 1), rng.randrange(len(text) + 1)))
        match rng.randrange(4):
            case 0:
                text = text[:a] + text[b:]
            case 1:
                text = text[:b] + text[a:]
            case 2:
                text = text[:a] + rng.choice(words) + text[b:]
            case 3:
                text = _damaged_word(text, rng, words)
        text = text[:2000]
    return text


#: Text that stands for a value which JSON cannot spell, put in after the tree is written.
_RAW = ("NaN", "Infinity", "-Infinity", "1e400", "-1e400", "9" * 5000, "1" * 310, "[" * 3000,
        '{"a":' * 2000, '"\\ud800"', "'x'", "0x1", "1.", "tru", '{"a": 1, "a": 2}')  # fmt: skip

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 0.0, -0.0, 1e-320, 1e308, -1e308, 2**63, 2**64, 10**400, 0.5, "",
    "1", "nan", "\ud800", "\0", "x" * 500, "µm", "../../etc", [], {}, [[]], [None], [1], [1, 2],
    [2, 1], [1, 2, 3], ["x"], {"": 1}, {"value": 1}, {"name": "x", "module": "os", "sha256": ""},
    "<!--", "\r\n", "1e5",
)  # fmt: skip


def damaged_json(tree: Any, rng: Random) -> bytes:
    """Return the JSON of a tree with nodes changed, removed, renamed or repeated; or other text."""
    tree = json.loads(json.dumps(tree))
    raw = None
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        holder, key = _node(tree, rng)
        if holder is None:
            continue
        match rng.randrange(8):
            case 0 | 1 | 2:
                holder[key] = deepcopy(rng.choice(_VALUES))  # a list may be changed itself next
            case 3:
                raw = rng.choice(_RAW)
                holder[key] = "RAW"
            case 4:
                del holder[key]
            case 5:
                _rename(holder, key, rng)
            case 6:
                other, place = _node(tree, rng)
                holder[key] = json.loads(json.dumps(other[place] if other else None))
            case 7:
                holder[key] = _nudged(holder[key], rng)
    text = json.dumps(tree, indent=rng.choice((None, 2)), ensure_ascii=rng.random() < 0.5)
    data = text.encode("utf-8", "surrogatepass")
    if raw is not None:
        data = data.replace(b'"RAW"', raw.encode())
    return damaged_bytes(data, rng, _JSON_WORDS) if rng.random() < 0.2 else data


_JSON_WORDS = (b"{", b"}", b"[", b"]", b",", b":", b'"', b"null", b"NaN", b"\\u0000", b"\xff",
               b"\xef\xbb\xbf", b"//", b"e999")  # fmt: skip


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


def _rename(holder: Any, key: Any, rng: Random) -> None:
    if isinstance(holder, dict):
        holder[rng.choice(("", "x", key + " ", key.upper(), "__class__", "µ"))] = holder.pop(key)
    else:
        holder.append(deepcopy(holder[key]))


#: About the largest double.
_MOST = 10**300


def _nudged(value: Any, rng: Random) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or abs(value) > _MOST:  # what is beyond a double already stays so
        return str(value) if rng.random() < 0.5 else [value]
    return rng.choice(
        (-value, value * 1e30, value * 1e-30, value * (1 + 1e-12), str(value), [value])
    )
