"""Lags and oscillators that may stand in each other's place: the model's exchanges.

The linear part is a product, eqs. (13), (15), so that two of its factors can change places with
little effect: the two oscillators differ in the zero alone; the drive's lag stands before the
hysteresis and the creep lag after it, which shows only where the voltage turns; an overdamped
oscillator has a slow pole that looks like a lag. A search from one start may end on the wrong side.

Beside a fast oscillator, that slow pole of lag c/k brings a zero of lag c/k k_P/(k_P + k_B), or
c/k k_B/(k_P + k_B). Where the creep lag cancels the zero, the pole alone is left: it may be the
creep lag, and the oscillator as fast as the other one.
"""

from collections.abc import Iterator, Mapping

Values = Mapping[str, float]

#: A lag cancels a zero where it differs from the zero's lag by less than this share.
_CANCELS = 0.05


def exchanges(p: Values) -> Iterator[tuple[str, dict[str, float]]]:
    """Yield (what changes places, the parameters that do so with their new values)."""
    drive = p["R_s"] * p["C_p"]
    yield "drive lag and creep lag", {"tau": drive, "R_s": p["tau"] / p["C_p"]}
    if "k_P" not in p:
        return
    ratio = p["k_P"] / p["k_B"]
    swapped = {f"{q}_P": p[f"{q}_B"] * ratio for q in "mc"}
    yield "wafers and bonding layers", swapped | {f"{q}_B": p[f"{q}_P"] / ratio for q in "mc"}
    for part, other, what in (("P", "B", "wafers"), ("B", "P", "bonding layers")):
        lag = p[f"c_{part}"] / p[f"k_{part}"]
        if lag**2 > 4.0 * p[f"m_{part}"] / p[f"k_{part}"]:
            slowed = {f"c_{part}": p["tau"] * p[f"k_{part}"]}
            yield f"creep lag and {what}", slowed | {"tau": lag}
            zero = lag * p[f"k_{part}"] / (p["k_P"] + p["k_B"])
            if abs(zero / p["tau"] - 1.0) < _CANCELS:
                share = p[f"k_{part}"] / p[f"k_{other}"]
                like = {f"{q}_{part}": p[f"{q}_{other}"] * share for q in "mc"}
                yield f"creep lag for the slow pole of the {what}", like | {"tau": lag}
            slowed = {f"c_{part}": drive * p[f"k_{part}"]}
            yield f"drive lag and {what}", slowed | {"R_s": lag / p["C_p"]}
