"""Lags and oscillators that may stand in each other's place: the model's exchanges.

The linear part is a product, eqs. (13), (15), so that two of its factors can change places with
little effect: the two oscillators differ in the zero alone; the drive's lag stands before the
hysteresis and the creep lag after it, which shows only where the voltage turns; an overdamped
oscillator has a slow pole that looks like a lag. A search from one start may end on the wrong side.
"""

from collections.abc import Iterator, Mapping

Values = Mapping[str, float]


def exchanges(p: Values) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield (what changes places, the parameters that do so with their new values)."""
    drive = p["R_s"] * p["C_p"]
    yield "drive lag and creep lag", {"tau": drive, "R_s": p["tau"] / p["C_p"]}
    if "k_P" not in p:
        return
    ratio = p["k_P"] / p["k_B"]
    swapped = {f"{q}_P": p[f"{q}_B"] * ratio for q in "mc"}
    yield "wafers and bonding layers", swapped | {f"{q}_B": p[f"{q}_P"] / ratio for q in "mc"}
    for part, what in (("P", "wafers"), ("B", "bonding layers")):
        lag = p[f"c_{part}"] / p[f"k_{part}"]
        if lag**2 > 4.0 * p[f"m_{part}"] / p[f"k_{part}"]:
            slowed = {f"c_{part}": p["tau"] * p[f"k_{part}"]}
            yield f"creep lag and {what}", slowed | {"tau": lag}
            slowed = {f"c_{part}": drive * p[f"k_{part}"]}
            yield f"drive lag and {what}", slowed | {"R_s": lag / p["C_p"]}
