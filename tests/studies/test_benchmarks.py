"""What the benchmarks count and print, on figures made up here."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter
from typer.testing import CliRunner

import psa_casadi as psa
from psa_casadi.common.units import ComplexArray, FloatArray
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.records.split import split
from psa_casadi.simulation import device
from tests.datasets.test_datasets import N as PERIOD
from tests.studies.__main__ import app
from tests.studies.benchmarks import changed, floors, mirror, names, peers, sampling
from tests.studies.benchmarks import diagnose as study
from tests.studies.benchmarks.floors import HISTORIES, Part, floor_of, play, ridge
from tests.studies.benchmarks.hidden_cases import Case, CaseResult, Kind
from tests.studies.benchmarks.table import BENCHES, bench
from tests.studies.exam.marks import Answer, Named, Question
from tests.tiers import slow


def silent(_: str) -> None:
    """Progress that nobody reads."""


def test_every_benchmark_has_a_function_or_a_command() -> None:
    for name in BENCHES:
        assert callable(bench(name, "app") or bench(name)), name


def test_a_folder_is_for_a_benchmark_that_takes_one(tmp_path: Path) -> None:
    statement = CliRunner().invoke(app, ["identify", "--folder", str(tmp_path)])
    assert statement.exit_code == 2
    assert "--folder: 'identify' takes none" in statement.stderr.replace("\n", " ")
    with pytest.raises(psa.InputError, match="holds no CSV file"):
        floors.run(silent, False, folder=tmp_path)


# ---- names


def _answered(case: str, question: Question, *causes: Named, left: str = "") -> names.AnsweredCase:
    verdict = "cause_named" if causes else "unexplained" if left else "adequate"
    return names.AnsweredCase(
        case, 0, question, Answer(verdict, causes, left, 0.6 if left else 0.0), 2.0
    )


def test_names_families_and_probabilities_are_counted() -> None:
    one = Question("one", (frozenset({"slow_creep"}),))
    foreign = Question("foreign", (frozenset({"sensor time"}),))
    items = [
        _answered("exam/a", one, Named("slow_creep", 0.99, (), "plant relaxation", 0.99)),
        _answered("tune/b", one, Named("charge_leakage", 0.95, (), "drive relaxation", 0.97)),
        _answered("tune/c", one, left="plant relaxation"),
        _answered("tune/d", foreign, Named("backlash", 0.6, (), "plant hysteresis", 0.6)),
        _answered("tune/e", foreign, Named("offset_drift", 0.6, (), "sensor time", 0.7)),
        _answered("tune/f", foreign),
        _answered("tune/g", Question("clean", noise="pink")),
        _answered("tune/h", Question("clean", noise="pink"), Named("mains_hum", 0.9)),
    ]
    figures, reliability, each = names.tables(items)
    rows = {(row["hidden"], row["records"]): row for row in figures.rows}
    assert set(rows) == {
        *(("one cause", source) for source in ("exam", "tune", "all")),
        ("foreign cause", "tune"), ("clean, odd noise", "tune"), ("all", "all"),
    }  # fmt: skip
    causes = rows["one cause", "all"]
    requested = ("in set", "alone", "family")
    assert [causes[k] for k in requested] == ["1/3", "1/3", "2/3"]
    assert causes["wrong"] == "1/2, 1/2"
    assert rows["foreign cause", "tune"]["honest"] == "1/3"
    assert rows["clean, odd noise", "tune"]["alarms"] == "1/2"
    assert rows["all", "all"]["wrong"] == "2/3, 1/2"
    assert [row["names: right"] for row in reliability.rows] == ["-", "0/2", "0/1", "0/1", "1/1"]
    assert [row["families: right"] for row in reliability.rows] == ["-", "2/3", "-", "0/1", "1/1"]
    assert len(each.rows) == len(items)


def test_a_pattern_of_names_that_no_case_has_is_reported() -> None:
    with pytest.raises(psa.InputError, match="no case has 'exma/'"):
        names.run(silent, False, only="exma/")


# ---- ensembles


@slow
def test_all_ways_reach_the_error_on_a_short_record(monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight sets of 40 samples of a sine, scipy and CVODES next to `simulate_many`."""
    none = Mock(side_effect=psa.InputError("there is none."))
    monkeypatch.setattr(device, "device_module", none)
    monkeypatch.setattr(peers, "find_spec", lambda _: None)
    monkeypatch.setattr(peers, "_REPEATS", 1)
    voltage = 50.0 - 50.0 * np.cos(2.0 * np.pi * np.arange(40) / 39.0)
    short = replace(peers.cases(40)[0], voltage=voltage)
    (table,) = peers.measured(silent, [short], 8).tables
    assert [(r["sets"], r["samples"]) for r in table.rows] == [(8, 40), (4, 40), (4, 40)]
    assert [r["way"] for r in table.rows] == [peers.OURS, *list(peers.PEERS)[:2]]
    assert all(float(str(r["largest error / range"])) <= 1e-5 for r in table.rows)
    assert table.rows[0]["over ours"] == "1.0"
    assert "pip install --group ensembles" in table.note
    assert table.note.endswith("No rows of a GPU: there is none.")


# ---- diagnose and excerpts


def _result(
    kind: Kind, effect: str | None, named: dict[str, float], rho: float = 1.0
) -> CaseResult:
    """Return a case in which the most probable effect is named, nothing if there is none."""
    first = max(named, key=lambda name: named[name], default=None)
    names, rho = ((first,) if first else ()), rho if effect else 0.0
    verdict: Verdict = "cause_named" if first else "adequate"
    return CaseResult(Case(kind, effect, 1), rho, verdict, names, names, (), named, 1.0)


RESULTS = [
    _result("known", "slow_creep", {"slow_creep": 0.97, "offset_drift": 0.03}),
    _result("known", "slow_creep", {"slow_creep": 0.99}),
    _result("known", "offset_drift", {"slow_creep": 0.9, "offset_drift": 0.1}),
    _result("known", "offset_drift", {"slow_creep": 0.99}, 0.01),  # not as visible as requested
    _result("left out", "slow_creep", {"offset_drift": 0.98}),
    _result("foreign", "dry_friction", {}),
    _result("clean", None, {}),
    _result("clean", None, {"slow_creep": 0.99}),
]


def test_shares_are_of_the_cases_as_visible_as_requested() -> None:
    summary = study.result_tables(RESULTS)[0]
    reached = {row["figure"]: row["reached"] for row in summary.rows}
    assert {
        "right name alone, rho 0.3 to 3": "67 % (2 of 3)",
        "a single wrong name, rho 0.3 to 3": "33 % (1 of 3)",
        "clean: a cause named": "50 % (1 of 2)",
        "effect not in the table: not named alone": "0 % (0 of 1)",
        "foreign plants: not named alone": "100 % (1 of 1)",
    }.items() <= reached.items()


def test_a_probability_is_held_against_how_often_the_effect_is_the_cause() -> None:
    assert study.in_class(RESULTS, 0.95, 1.0) == [(0.97, True), (0.99, True)]
    assert study.in_class(RESULTS, 0.02, 0.2) == [(0.03, False), (0.1, True)]
    rows = {row[0]: row[1:] for row in study.result_tables(RESULTS)[1].table.rows}
    assert rows["80 to 95 %"] == ("90 %", "0", "1")
    assert rows["95 to 100 %"] == ("98 %", "2", "2")


def test_an_interval_of_the_gain_is_held_against_the_records_it_does_not_know() -> None:
    ends = ((45.0, 55.0), (51.0, 60.0)), ((25.0, 35.0), (20.0, 31.0))
    items = [
        study.Covered("slow_creep", 50.0, (40.0, 45.0), ends[0], (50.0, 50.5)),
        study.Covered("ageing", 30.0, (10.0, 60.0), ends[1], (30.0, 30.0)),
    ]
    blocks, records = study.intervals_table(items).table.rows
    assert blocks[1:] == ("50 % (1 of 2)", "27.5 %")
    assert records[1:] == ("75 % (3 of 4)", "10.0 %")


def test_a_refusal_is_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.linspace(0.0, 2.999, 3000)
    x = psa.simulate(psa.stack_model("P-885.51"), t, 50.0 - 40.0 * np.cos(2 * np.pi * t))
    still = psa.Record(
        name="still", time=t, voltage=np.full(3000, 3.0), displacement=x.displacement
    )
    assert changed.end_of(still).startswith("refused: ")
    monkeypatch.setattr(psa, "diagnose", Mock(side_effect=KeyError("x")))
    assert changed.end_of(still) == "crashed: KeyError: 'x'"


# ---- floors

#: Samples, and noise over the range's order of size; every fourth quarter of a hundred is held out.
N, NOISE = 1600, 2e-3
HELD = np.arange(N) % 100 >= 75


def triangles(rng: np.random.Generator) -> FloatArray:
    """Loops of other amplitudes, up and down in pieces of other length, with a little jitter."""
    turns = np.cumsum(rng.integers(30, 90, size=60))
    values = rng.uniform(-1.0, 1.0, size=60)
    values[5:7] = 1.0, -1.0
    return np.interp(np.arange(N), np.r_[0, turns], np.r_[0.0, values])


def plant(v: FloatArray, rng: np.random.Generator, state: float = 0.0) -> FloatArray:
    """Memory, creep and the ripple of a sensor, by none of the code that is tested."""
    memory = np.zeros(N)
    for threshold, weight in ((2 / 15, 0.2), (6 / 15, 0.15), (9 / 15, 0.1)):
        s = min(max(state, v[0] - threshold), v[0] + threshold)
        for k in range(N):
            s = min(max(s, v[k] - threshold), v[k] + threshold)
            memory[k] += weight * (s + 0.2 * s**2)
    creep = lfilter([1 / 300.0], [1.0, 1 / 300.0 - 1.0], v - v[0])
    x = v + memory + 0.1 * creep
    return np.asarray(x + 0.01 * np.sin(8.0 * x) + NOISE * rng.standard_normal(N))


def test_a_play_follows_behind_its_threshold_and_remembers_what_was_before() -> None:
    v = np.array([0.0, 1.0, 0.5, -1.0])
    np.testing.assert_allclose(play(v, 0.2, ()), [0.0, 0.8, 0.7, -0.8])
    np.testing.assert_allclose(play(v, 0.2, (1.0,)), [0.2, 0.8, 0.7, -0.8])


def test_prior_sizes_distinguish_what_acts_from_what_does_not() -> None:
    rng = np.random.default_rng(3)
    features = rng.standard_normal((300, 64))
    kinds = np.r_[0, np.ones(3, dtype=int), np.full(60, 2)]
    truth = np.r_[5.0, 1.0, -2.0, 0.5, np.zeros(60)]
    y = features @ truth + 0.3 * rng.standard_normal(300)
    result = ridge(features, kinds, y)
    assert result.sigma == pytest.approx(0.3, rel=0.1)
    np.testing.assert_allclose(result.weights[:4], truth[:4], atol=0.1)
    plain = np.linalg.lstsq(features, y, rcond=None)[0]
    assert np.sum((result.weights - truth) ** 2) < 0.3 * np.sum((plain - truth) ** 2)
    without = ridge(features[:, :3], kinds[:3], y)
    assert result.evidence > without.evidence + 10.0


def test_the_floor_of_a_plant_of_its_kind_is_the_noise() -> None:
    rng = np.random.default_rng(11)
    v = triangles(rng)
    t, x = np.linspace(0.0, 1e-3 * (N - 1), N), 1e-6 * plant(v, rng)
    experiments = [split(psa.Record(name="loops", time=t, voltage=40.0 + 30.0 * v, displacement=x))]
    errors = floors.floor_on(experiments, silent)
    assert errors.holdout_rms_m < 1.5e-6 * NOISE
    # a straight line of the voltage errs fifty times more: the record does hold the memory
    line = np.polyval(np.polyfit(v, x, 1), v)
    assert np.std((x - line)[experiments[0].held_out]) > 30.0 * errors.holdout_rms_m


@slow
def test_modes_are_detected_in_a_broadband_record() -> None:
    rng = np.random.default_rng(2)
    v = np.clip(0.25 * rng.standard_normal(700), -1.0, 1.0)
    truth, damping, x = (0.11, 0.23), 0.03, 0.3 * v
    for f in truth:
        w = 2 * np.pi * f
        poles = [1.0, -2 * np.exp(-damping * w) * np.cos(w), np.exp(-2 * damping * w)]
        x += lfilter([0.0, 0.05], poles, v)
    noise = 0.01 * np.std(x)
    y = x + noise * rng.standard_normal(len(v))
    held = HELD[: len(v)]
    floor = floor_of([Part(v, y, ~held)])
    for f in truth:
        mode = min(floor.modes, key=lambda m: abs(m.frequency - f))
        assert mode.frequency == pytest.approx(f, rel=0.003)
        assert mode.damping == pytest.approx(damping, rel=0.1)
    assert np.std((y - floor.predicted[0])[held]) < 1.4 * noise


@slow
def test_a_line_of_the_mains_is_detected_and_noise_is_none() -> None:
    rng = np.random.default_rng(8)
    v, noise = triangles(rng), 0.01 * rng.standard_normal(N)
    y = v + 0.02 * np.sin(2 * np.pi * 0.2531 * np.arange(N) + 1.0) + noise
    floor = floor_of([Part(v, y, ~HELD)])
    (line,) = [m for m in floor.modes if m.damping == 0.0]
    assert line.frequency == pytest.approx(0.2531, abs=1e-5)
    assert np.std((y - floor.predicted[0])[HELD]) < 1.1 * np.std(noise)
    assert not floor_of([Part(v, v + noise, ~HELD)]).modes


@slow
def test_where_a_record_comes_from_is_identified() -> None:
    rng = np.random.default_rng(5)
    v = 0.4 * triangles(rng)
    result = floor_of([Part(v, plant(v, rng, state=1.0), ~HELD)]).histories[0]
    assert result in HISTORIES
    assert result[-1] == 1.0


# ---- mirror: modes from a response, a model of them, and the score of its authors


def structure(softer: float = -0.03) -> mirror.Modes:
    """Return 15 modes with shapes that are a little out of phase, and a lag of 50 us."""
    rng, modes = np.random.default_rng(6), []
    for peak in mirror.PEAKS:
        driven, sensed = rng.normal(size=(2, 3)) + 0.1j * rng.normal(size=(2, 3))
        driven = driven / driven[np.argmax(np.abs(driven))]
        frequency = float(peak + rng.uniform(-4, 4))
        modes.append(mirror.Mode(frequency, 0.01, softer, 0.4, driven, sensed))
    return mirror.Modes(tuple(modes), rng.normal(size=(3, 3)), 5e-5, 0.2)


def response_of(modes: mirror.Modes, frequency: FloatArray, amplitude: float) -> ComplexArray:
    """Return displacement over voltage (lines, 3, 3) [m/V] of voltages held between samples."""
    above, whole = amplitude - mirror.MIDDLE, np.zeros((len(frequency), 3, 3), dtype=np.complex128)
    for n in range(-20, 21):  # what steps drive besides the line, and sampling aliases to it
        s = 2j * np.pi * (frequency + n * mirror.RATE)
        table = np.tile(modes.rest.astype(np.complex128), (len(s), 1, 1))
        for m in modes.modes:
            w = 2 * np.pi * m.frequency * (1 + m.softer * above)
            damping = m.damping * (1 + m.lossier * above)
            pole = w**2 / (s**2 + 2 * damping * w * s + w**2)
            shape = m.sensed[:, None] * m.driven
            table += pole[:, None, None] * (shape.real + (s / w)[:, None, None] * shape.imag)
        held = np.full(len(s), float(n == 0), dtype=np.complex128)
        held[1:] = (1 - np.exp(-s[1:] / mirror.RATE)) / (s[1:] / mirror.RATE)
        factor = 1e-6 * (1 + modes.rise * above) * held / (1 + s * modes.lag)
        whole += table * factor[:, None, None]
    return whole


def test_modes_are_detected_in_responses() -> None:
    truth, frequency = structure(), np.linspace(0.0, mirror.RATE / 2, 1500)
    responses = {a: response_of(truth, frequency, a) for a in (0.1, 0.3)}
    for response in responses.values():
        response[frequency > 3000] = 0.0  # no voltage there
    modes = mirror.modes_of(responses)
    assert modes.lag == pytest.approx(truth.lag, rel=1e-2)
    assert modes.rise == pytest.approx(truth.rise, rel=1e-2)
    assert modes.modes[-1].frequency == pytest.approx(truth.modes[-1].frequency, rel=2e-3)
    for item, true in zip(modes.modes[:-1], truth.modes[:-1], strict=True):  # below 3 kHz
        assert item.frequency == pytest.approx(true.frequency, rel=1e-4)
        assert item.damping == pytest.approx(true.damping, rel=1e-2)
        assert item.softer == pytest.approx(true.softer, rel=2e-2)
        assert item.lossier == pytest.approx(true.lossier, rel=5e-2)
        np.testing.assert_allclose(item.driven, true.driven, atol=2e-2)
        np.testing.assert_allclose(item.sensed, true.sensed, atol=5e-2)


@slow
def test_the_mirror_answers_as_its_modes_say_at_an_amplitude() -> None:
    """In steady state, where the shapes at the stacks have one phase: it has their tables then."""
    n, rng, inputs = 4096, np.random.default_rng(8), structure()
    modes = [replace(m, driven=np.real(m.driven).astype(np.complex128)) for m in inputs.modes]
    result = replace(inputs, modes=tuple(modes))
    lines = np.zeros((n // 2 + 1, 3), dtype=np.complex128)
    lines[1:1800] = np.exp(2j * np.pi * rng.uniform(size=(1799, 3)))
    u = np.fft.irfft(lines, n=n, axis=0)
    u, lines = 0.3 / np.std(u) * u, 0.3 / np.std(u) * lines
    statement = mirror.played(mirror.mirror(result), np.stack([u, u], axis=2))
    errors, frequency = [], np.linspace(0.0, mirror.RATE / 2, n // 2 + 1)
    for amplitude in (0.1, 0.3):
        response = response_of(result, frequency, amplitude)
        true = np.fft.irfft(np.einsum("kij,kj->ki", response, lines), n=n, axis=0)
        errors.append([float(np.std(statement[:, :, k] - true) / np.std(true)) for k in range(2)])
    assert max(errors[1]) < 0.02
    assert min(errors[0]) > 0.1


def test_an_exact_simulation_scores_nothing_and_noise_scores_its_share() -> None:
    y = np.random.default_rng(4).normal(size=(4 * PERIOD, 3, 3, 2)) * [[[1.0]], [[2.0]], [[3.0]]]
    assert len(y) > mirror.SKIPPED
    assert np.all(mirror.score(y, y) == 0.0)
    paths = y.copy()
    paths[mirror.SKIPPED :] += 0.5 * np.std(y[mirror.SKIPPED :], axis=0)
    paths[: mirror.SKIPPED] += 100.0
    np.testing.assert_allclose(mirror.score(y, paths), 0.5)


# ---- sampling: the one equation that PyMC gets shows what the whole stack shows

#: NumPy under the names of PyMC's symbols.
NUMPY = SimpleNamespace(
    floor=np.floor, mod=np.mod, eq=np.equal, lt=np.less, switch=np.where, sqrt=np.sqrt
)


def test_the_reduced_equation_shows_the_stack_at_other_values() -> None:
    model = sampling.stack().with_values({"k_L": 7.9, "A": -1.5, "delta": -0.2, "n": 1.7})
    v, inputs = model.values, sampling.record()
    p = [v["A"], v["delta"], v["n"]]
    result = solve_ivp(
        lambda t, y: [sampling.hysteresis_rate(y[0], t, p, v, NUMPY)], (0.0, inputs.time[-1]),
        [30.0], t_eval=inputs.time, method="LSODA", rtol=1e-9, atol=1e-6,
        max_step=sampling.LEG / 20,
    )  # fmt: skip
    compliance = 1.0 / v["k_P"] + 1.0 / v["k_B"]
    reduced = compliance * (v["k_L"] * inputs.voltage + result.y[0])
    whole = psa.simulate(model, inputs.time, inputs.voltage, memory={"f_H": 30.0}, rtol=1e-9)
    miss = reduced - whole.displacement
    assert np.max(np.abs(miss - np.mean(miss))) < 1e-4 * np.ptp(whole.displacement)
    assert np.ptp(result.y[0]) > 50.0  # it is the hysteresis that is compared


def test_the_table_states_effective_samples_per_processor_time() -> None:
    draws = np.random.default_rng(0).standard_normal((20000, 2))
    fast, slow = (sampling.Drawn(n, draws, s) for n, s in (("a", 2.0), ("b", 500.0)))
    titled_table = sampling.speed([fast, slow])
    assert "250 times" in titled_table.note
    for row, seconds in zip(titled_table.table.rows, (2.0, 500.0), strict=True):
        assert float(row[2]) == pytest.approx(20000, rel=0.1)
        assert float(row[4]) == pytest.approx(float(row[2]) / seconds, rel=0.01)
