"""The cases of the data set: what is hidden in each, drawn from a seed."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tests.studies.benchmarks.hidden_cases import NOISES, ORDINARY, REACHED, STRONG, WEAK, Case
from tests.studies.plants.again import play_again
from tests.studies.plants.base import simulate_base
from tests.studies.plants.excitations import draw_excitation
from tests.studies.plants.hide import SEARCH
from tests.studies.plants.make import Truth, make_record
from tests.studies.plants.sensor import room, temperature
from tests.studies.plants.stack import FloatArray
from tests.studies.plants.table import FOREIGN, KNOWN, called
from tests.studies.plants.visibility import base_columns

#: Shares of the kinds of cases; what is left over goes to the first.
SHARES = {"known": 0.5, "clean": 0.2, "foreign": 0.1, "weak": 0.1, "two": 0.1}
#: A lag of the sensor is taken over by the base's own: no gain makes it visible.
ASKED = tuple(name for name in KNOWN if name != "sensor_lag")
#: Drawn relative to their record (`in_terms_of`), which knows the first effect only.
_FIRST_ONLY = ("offset_drift", "self_heating", "voltage_saturation")
#: Draws of one effect before the next one takes its place.
_ATTEMPTS = 3


@dataclass(frozen=True)
class Half:
    """One record of a device: (N,) times [s], voltage [V], displacement read and without noise [m],
    temperature [degC]; the fitted base [m] and what moves it (N, 11), see `base_columns`.
    """

    times: FloatArray
    voltage: FloatArray
    read: FloatArray
    clean: FloatArray
    temperature: FloatArray
    base: FloatArray
    columns: FloatArray


@dataclass(frozen=True)
class Made:
    """A case with its record and the held-out one; `rho` is the smallest that was reached."""

    case: Case
    rho: float
    gains: dict[str, float]
    record: Half
    holdout: Half


def cases_of(seed: int, count: int) -> list[Case]:
    """Return so many cases in the order of the data set, which tells nothing of their kinds."""
    rng = np.random.default_rng(seed)
    numbers = {kind: round(share * count) for kind, share in SHARES.items()}
    numbers["known"] += count - sum(numbers.values())
    known, foreign = (_in_turn(rng, names, count) for names in (ASKED, FOREIGN))
    weak, pairs = _in_turn(rng, ASKED, count), [_pair(rng) for _ in range(numbers["two"])]
    seeds = iter(np.random.SeedSequence(seed).generate_state(count).tolist())
    cases = [
        Case("known", known[k], next(seeds), ORDINARY, noise=NOISES[k % len(NOISES)])
        for k in range(numbers["known"])
    ]
    cases += [
        Case("clean", None, next(seeds), noise=NOISES[k % 2]) for k in range(numbers["clean"])
    ]
    cases += [Case("foreign", foreign[k], next(seeds)) for k in range(numbers["foreign"])]
    cases += [Case("weak", weak[k], next(seeds), WEAK) for k in range(numbers["weak"])]
    cases += [Case("two", one, next(seeds), STRONG, (more,)) for one, more in pairs]
    return [cases[k] for k in rng.permutation(count)]


def _in_turn(rng: np.random.Generator, names: tuple[str, ...], count: int) -> list[str]:
    turns = -(-count // len(names))
    return [names[k] for _ in range(turns) for k in rng.permutation(len(names))][:count]


def _pair(rng: np.random.Generator) -> tuple[str, str]:
    more = str(rng.choice([name for name in ASKED if name not in _FIRST_ONLY]))
    return str(rng.choice([name for name in ASKED if name != more])), more


def make(case: Case, folder: Path) -> Made:
    """Make the two records of a case; a folder takes what the plants write on the way.

    Where a device does not show what is hidden as well as was asked for, another one is drawn, and
    after three of them the next effect is taken.
    """
    seeds = np.random.SeedSequence(case.seed).generate_state(4 * _ATTEMPTS).tolist()
    for tried, seed in enumerate(seeds):
        drawn = replace(case, effect=_later(case.effect, tried // _ATTEMPTS), seed=seed)
        if drawn.effect in drawn.more:
            continue
        truth = _device(drawn, folder)
        rho = min([truth.visible, *(h.visible for h in truth.more)])
        if drawn.effect is None or rho >= REACHED * drawn.rho[0]:
            return _made(drawn, truth, rho, folder)
    raise RuntimeError(f"No device drawn from seed {case.seed} shows {case.hidden} well enough.")


def _later(effect: str | None, steps: int) -> str | None:
    if effect is None or steps == 0:
        return effect
    names = FOREIGN if effect in FOREIGN else ASKED
    return names[(names.index(effect) + steps) % len(names)]


def _device(case: Case, folder: Path) -> Truth:
    return make_record(
        case.effect,
        case.seed,
        folder / "record.csv",
        noise=case.noise,
        visible=case.rho if case.effect else None,
        more=case.more,
        more_visible=case.rho if case.more else None,
    )


def _made(case: Case, truth: Truth, rho: float, folder: Path) -> Made:
    rng = np.random.default_rng([case.seed, 3])
    walk = _thermometer(truth, rng)
    played = draw_excitation(rng, truth.excitation, truth.stack.u_rated)
    clean = play_again(truth, case.seed + 1, folder / "holdout.csv", played)
    first = truth.times, truth.voltage, _read(folder / "record.csv"), truth.displacement
    record = _half(truth, first, truth.base_displacement, walk, None)
    base = simulate_base(truth.stack, *played).displacement
    second = *played, _read(folder / "holdout.csv"), clean
    fitted = _fitted(record, truth.base_displacement)
    gains = {called(name): gain for name, _, gain in truth.hidden}
    return Made(case, rho, gains, record, _half(truth, second, base, walk, fitted))


def _thermometer(truth: Truth, rng: np.random.Generator) -> dict[str, float]:
    """What the room does: every record has a thermometer, and not only where it is the cause."""
    for name, parameters, _ in truth.hidden:
        if name == "temperature":
            return dict(parameters)
    return temperature.draw(rng, simulate_base(truth.stack, truth.times, truth.voltage, SEARCH))


def _read(path: Path) -> FloatArray:
    """Return what the sensor said, (N,) [m], nan where nothing."""
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    return 1e-6 * np.asarray(table[:, 2], dtype=np.float64)


def _half(
    truth: Truth,
    signals: tuple[FloatArray, FloatArray, FloatArray, FloatArray],
    base: FloatArray,
    walk: dict[str, float],
    fitted: FloatArray | None,
) -> Half:
    """Return a record with its base, which is fitted to it unless the fit is given."""
    times, voltage, read, clean = signals
    columns = base_columns(truth.stack, times, voltage, base)
    bare = Half(times, voltage, read, clean, room(times, walk), base, columns)
    moves = _fitted(bare, base) if fitted is None else fitted
    return replace(bare, base=base + columns @ moves)


def _fitted(half: Half, base: FloatArray) -> FloatArray:
    """Return the Gauss-Newton step of the base from the device's own values, (11,)."""
    told = np.isfinite(half.read)
    size = np.linalg.norm(half.columns, axis=0)
    found = np.linalg.lstsq((half.columns / size)[told], (half.read - base)[told], rcond=1e-8)[0]
    return np.asarray(found / size, dtype=np.float64)
