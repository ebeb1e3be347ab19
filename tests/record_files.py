from pathlib import Path

HEADER = "time [s],voltage [V],displacement [um]"
ROWS = [f"{k / 1000},{k % 7},{k % 7 / 10}" for k in range(20)]


def write(path: Path, *lines: str, end: str = "\n", encoding: str = "utf-8") -> Path:
    path.write_bytes((end.join(lines) + end).encode(encoding))
    return path
