"""An answer to a case, as the score reads it, and what a method is given."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
FORMAT = "psa_causes.answer/1"


def held_out_columns(case: Path) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return times [s], voltage [V] and temperature [degC] of the held-out record, (N,)."""
    t, v, warm = column_table(case / "holdout.csv").T
    return t, v, warm


def column_table(path: Path) -> FloatArray:
    """Return a CSV with one line of names, (N, columns), nan where a cell is empty."""
    return np.asarray(np.genfromtxt(path, delimiter=",", skip_header=1), dtype=np.float64)


def answer(
    name: str,
    *,
    detected: bool,
    causes: Sequence[dict[str, float]],
    predicted: FloatArray,
    seconds: float,
    gain: tuple[float, float, float] | None = None,
) -> dict[str, Any]:
    """Return an answer; `predicted` (N,) [m] is on the held-out voltage, `gain` value and interval
    of the reduction of the held-out rms [%].
    """
    content: dict[str, Any] = {
        "format": FORMAT,
        "case": name,
        "detected": detected,
        "causes": [{e: round(p, 6) for e, p in own.items()} for own in causes],
        "displacement_um": np.round(1e6 * predicted, 6).tolist(),
        "seconds": round(seconds, 2),
    }
    if gain is not None and np.all(np.isfinite(gain)):
        value, low, high = (round(float(g), 3) for g in gain)
        content["gain_percent"] = {"value": value, "low": low, "high": high}
    return content


def write_answer(folder: Path, content: dict[str, Any]) -> None:
    """Write an answer as NAME.json."""
    folder.mkdir(parents=True, exist_ok=True)
    text = json.dumps(content, ensure_ascii=False, allow_nan=False)
    (folder / f"{content['case']}.json").write_text(text + "\n", encoding="utf-8")
