"""Parts of a file that may be hostile: bounded before they are followed or copied."""

#: Far above what compilers write.
_LONGEST_NAME = 4096


def require_part(data: bytes, offset: int, size: int) -> None:
    """Raise ValueError if the file ends before a part of it does; nothing is copied."""
    if offset + size > len(data):
        raise ValueError(f"it has {len(data)} bytes, a part of it ends at {offset + size}")


def require_at_most(count: int, most: int, what: str) -> None:
    """Raise ValueError if a file announces more of something than its reader follows."""
    if count > most:
        raise ValueError(f"it announces {count} {what}, more than {most}")


def part_of(data: bytes, offset: int, size: int) -> bytes:
    """Return a part of a file; raises ValueError if the file ends before it does."""
    require_part(data, offset, size)
    return data[offset : offset + size]


def text_at(data: bytes, offset: int) -> str:
    """Return the string that ends with a zero byte."""
    end = data.find(b"\0", offset, offset + _LONGEST_NAME + 1)
    if end < 0:
        raise ValueError(f"a name of it does not end within {_LONGEST_NAME} bytes")
    return data[offset:end].decode("ascii", "replace")
