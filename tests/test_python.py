"""The public names: few at the top level, the others in modules; a model as CasADi functions."""

import ast
import inspect
import pickle
import subprocess
import sys
from collections.abc import Callable
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.common.units import FloatArray
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.identification.own_model import identify_ode
from psa_casadi.model.component import OnDemand
from psa_casadi.records.read.reading import records_given
from tests.any_model.own_models import oscillator
from tests.report.report_cases import diagnosis, identification
from tests.tiers import slow


def test_dir_has_every_public_name_and_all_are_there() -> None:
    """Those that a tool or a reader looks for: of the package, its stub for types, its spaces."""
    spaces = {"datasets", "design", "online", "system", "__version__"}
    assert spaces < set(dir(psa)) == set(psa.__all__)
    stub = ast.parse(Path(psa.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    typed = [node for node in ast.walk(stub) if isinstance(node, ast.ImportFrom)]
    assert {alias.asname for node in typed for alias in node.names} == set(dir(psa))
    assert {*psa.online.__all__, *psa.system.__all__} <= set(dir(psa))
    for name in dir(psa):
        assert getattr(psa, name) is not None
    for name in ("nothing", "identfy"):
        with pytest.raises(AttributeError, match=f"no attribute '{name}'"):
            getattr(psa, name)


@pytest.mark.parametrize("space", ["design", "online", "system"])
def test_a_space_has_what_it_names(space: str) -> None:
    module = getattr(psa, space)
    assert module.__all__ == sorted(module.__all__, key=lambda n: (n.upper() != n, n.islower(), n))
    for name in module.__all__:
        assert getattr(module, name) is not None
        assert name in dir(module)
    with pytest.raises(AttributeError, match="nothing"):
        _ = module.nothing


def test_a_models_words_make_a_model_again() -> None:
    model = psa.stack_model("P-885.51").plant()
    values = {f"p_{k}": v for k, v in enumerate(model.parameter_vector())}
    names = [[f"{c}_{k}" for k in range(n)] for c, n in (("x", len(model.state_names)),
             ("u", len(model.input_names)), ("y", len(model.output_names)))]  # fmt: skip
    again = psa.system.ode_model(
        model.casadi(), name="again", states=names[0], inputs=names[1], outputs=names[2],
        parameters=list(values), values=values,
    )  # fmt: skip
    x, u = np.linspace(0.0, 1e-6, len(names[0])), np.ones(len(names[1]))
    for one, other in zip(
        model.structure.f(0.0, x, u, model.parameter_vector()),
        again.structure.f(0.0, x, u, again.parameter_vector()),
        strict=True,
    ):
        np.testing.assert_allclose(np.array(one), np.array(other), rtol=1e-12)


def test_sampled_states_have_no_such_words() -> None:
    name = next(n for n in psa.PARTS if psa.system.part_model(n).sampled_names)
    with pytest.raises(psa.InputError, match="sample instants only"):
        psa.system.part_model(name).casadi()


T = np.arange(64) * 1e-3
V = 50.0 - 50.0 * np.cos(40.0 * T)
X = 0.1 * V + 0.01 * np.sin(7.0 * T)
TABLE = {"time [ms]": 1e3 * T, "voltage [V]": V, "displacement [um]": X}
#: Attributes of a diagnosis, new or loaded.
ANSWERS = (
    "verdict", "causes", "candidates", "base_errors", "extended_errors", "gain",
    "noise_floor_rms_m", "kept", "doubt", "notes",
)  # fmt: skip


def test_a_missing_reading_of_a_frame_is_missing() -> None:
    y = [None if k == 3 else float(x) for k, x in enumerate(X)]
    record = psa.record_from(pd.DataFrame({**TABLE, "displacement [um]": y}))
    assert np.flatnonzero(~record.mask).tolist() == [3]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"displacement [um]": X[:-1]}, "has 63 values"),
        ({"displacement [um]": ["a"] * 64}, "not all numbers"),
        ({"displacement [V]": X}, "displacement"),
        ({"time [ms]": T[::-1]}, "time"),
    ],
)
def test_a_wrong_table_is_refused_as_a_file_is(changed: dict[str, object], message: str) -> None:
    table = {k: v for k, v in TABLE.items() if k.split()[0] != next(iter(changed)).split()[0]}
    with pytest.raises(psa.InputError, match=message):
        psa.record_from({**table, **changed})  # type: ignore[dict-item]


def test_one_or_several_records_paths_and_tables_are_records(tmp_path: Path) -> None:
    record = psa.record_from(TABLE)
    path = tmp_path / "r.csv"
    psa.write_record(path, {k: np.asarray(v) for k, v in TABLE.items()})
    for one in (record, str(path), path, TABLE, pd.DataFrame(TABLE)):
        (alone,) = records_given(one)
        (listed,) = records_given([one])
        assert alone.n == listed.n == 64
    assert [r.n for r in records_given([record, path, TABLE])] == [64, 64, 64]


def test_results_are_data_frames() -> None:
    d, result = diagnosis("cause_named"), identification()
    samples = d.to_frame()
    assert len(samples) == sum(e.record.n for e in d.experiments)
    rest = samples[samples.held_out]
    rms = float(np.sqrt(np.nanmean((rest["measured [m]"] - rest["base [m]"]) ** 2)))
    assert 0.0 < rms < 1e-6
    parameters = result.to_frame().set_index("parameter")
    assert parameters.value.to_dict() == dict(result.model.values)
    assert (parameters.low <= parameters.value)[parameters.low.notna()].all()
    table = psa.simulate(result.model, T, V).to_frame()
    assert {"time [s]", "measured_displacement [m]", "f_H [N]"} <= {*table}


def test_one_output_is_drawn_on_the_axes_that_are_passed() -> None:
    d, matches = diagnosis("cause_named"), identification()
    run, record = psa.simulate(matches.model, T, V), d.experiments[0].record
    axes = Figure().add_subplot()
    assert run.plot(ax=axes, output="f_H") is axes.figure
    (curve,) = axes.lines
    np.testing.assert_array_equal(curve.get_ydata(), run.states["f_H"])
    assert axes.get_ylabel() == "f_H [N]"
    for result, curves in ((run, 1), (record, 1), (d, 3), (matches, 2)):
        (one,) = result.plot(output="displacement").axes
        assert one.get_ylabel().startswith("displacement [")
        assert len(one.lines) == curves
    assert "residual" in d.plot(output="residual").axes[0].get_ylabel()
    assert record.plot().axes[0].get_ylabel().startswith("displacement [")
    with pytest.raises(psa.InputError, match=r"no output 'speed'.*displacement, residual"):
        d.plot(output="speed")
    with pytest.raises(psa.InputError, match=r"no output 'x_1'.*voltage, "):
        run.plot(output="x_1")


@pytest.mark.parametrize("verdict", ["cause_named", "adequate", "ambiguous"])
def test_a_diagnosis_is_loaded_back(verdict: Verdict, tmp_path: Path) -> None:
    d = diagnosis(verdict)
    (tmp_path / "D.json").write_text(d.to_json(), encoding="utf-8")
    again: Any = psa.load_diagnosis(tmp_path / "D.json")
    for other in (again, pickle.loads(pickle.dumps(again)), pickle.loads(pickle.dumps(d))):
        for name in ANSWERS:
            assert getattr(other, name) == getattr(d, name), name
        assert [b.why for b in other.blind_to] == [b.why for b in d.blind_to]
        assert other.remaining.where == d.remaining.where
        assert other.next_experiment.why == d.next_experiment.why
        assert other.to_json() == d.to_json()
        assert repr(other) == repr(d)
    assert verdict in again._repr_html_()
    both = psa.compare(again, d).findings
    assert [f.verdict for f in both] == [verdict, verdict]
    assert both[0].causes == both[1].causes


def test_what_is_no_diagnosis_is_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    for text, message in (("{}", "no diagnosis"), ("[", "x.json"), (
        '{"format": "psa_casadi.diagnosis/1"}', "'verdict' is missing")):  # fmt: skip
        path.write_text(text, encoding="utf-8")
        with pytest.raises(psa.InputError, match=message):
            psa.load_diagnosis(path)
    with pytest.raises(psa.InputError, match=r"none\.json"):
        psa.load_diagnosis(tmp_path / "none.json")


TIMES = np.linspace(0.0, 0.0199, 200)
WAVE = 40.0 - 40.0 * np.cos(400.0 * TIMES)
PERIOD = 1e-4


def driven(model: psa.Model) -> list[FloatArray]:
    """Return the outputs of a model on a wave of all its inputs."""
    u = np.outer(WAVE / 80.0, [i.start + 1.0 for i in model.structure.inputs])
    x0 = np.array([s.start for s in model.structure.states])
    return [psa.run(model, TIMES, u, x0).y]


def stack() -> psa.Model:
    model = psa.stack_model("P-885.51").with_effect(psa.EFFECTS["slow_creep"], {"creep_gain": 0.05})
    return psa.settled_at(model, 20.0, (60.0,))


@cache
def swing() -> tuple[psa.Signals, psa.Identification, psa.Diagnosis]:
    """Return a record of an oscillator with a stop, its fit and its diagnosis."""
    model = oscillator()
    t = np.linspace(0.0, 0.599, 600)
    force = 40.0 * np.sin(25.0 * t) + 15.0 * np.sin(61.0 * t)
    y = psa.run(model.with_values({"c": 40.0}), t, force[:, None], np.zeros(2)).y[:, 0]
    y = y + 1e-6 * np.random.default_rng(0).normal(size=t.size)
    record = psa.Signals(name="r", time=t, columns={"force": force, "position": y})
    fitted = identify_ode(model, [record], starts=1)
    return record, fitted, psa.diagnose(model, [record])


def block(made: Any, *samples: float) -> list[float]:
    """Return the next output of a block, without moving it on."""
    return [pickle.loads(pickle.dumps(made)).step(*samples)]


def values(**more: float) -> dict[str, float]:
    model = psa.stack_model("P-885.51")
    return dict(psa.identifier_for(model, PERIOD, noise=2e-8).values) | more


def moved(made: Any, *samples: float) -> Any:
    for k in range(50):
        made.step(*(s * np.sin(0.3 * k) ** 2 for s in samples))
    return made


def equations(symbols: Any = None) -> psa.Equations:
    symbols = symbols or OnDemand()
    return psa.Equations(out={"y": 1.0}, add={}, der={})


def symbol_names(c: psa.Component) -> list[str]:
    """Return a component's equations as text."""
    made = c.equations(OnDemand())
    return [f"{n} = {ca.SX(e)}" for part in (made.der, made.add, made.out) for n, e in part.items()]


def _lag() -> psa.Model:
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    return psa.ode_model({"x": x, "u": u, "ode": u - x}, name="lag")


#: By public class: an example, and its text.
EXAMPLES: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "Model": (stack, driven),
    "System": (lambda: psa.nanopositioner("P-885.51"), lambda s: driven(s.model())),
    "Component": (lambda: oscillator().components[0], symbol_names),
    "Equations": (equations, lambda e: [dict(e.out)]),
    "Record": (
        lambda: diagnosis("adequate").experiments[0].record,
        lambda r: [r.time, r.voltage, r.displacement, r.sha256],
    ),
    "Signals": (lambda: swing()[0], lambda s: [s.time, *s.columns.values(), s.sha256]),
    "Trajectory": (
        lambda: psa.simulate(stack(), TIMES, WAVE),
        lambda t: [t.displacement, *t.states.values(), t.way],
    ),
    "Identification": (
        lambda: swing()[1],
        lambda i: [*i.fit.outputs(), repr(i), i.to_json(), *driven(i.model)],
    ),
    "StackIdentification": (
        identification,
        lambda i: [*i.fit.predicted(), repr(i), i.to_json(), i.determinacy.names],
    ),
    "StackDiagnosis": (
        lambda: diagnosis("cause_named"),
        lambda d: [d.to_json(), repr(d), *d.base, *d.extended, *driven(d.model)],
    ),
    "Diagnosis": (
        lambda: swing()[2],
        lambda d: [d.to_json(), repr(d), *driven(d.model), *d.extended_fit.outputs()],
    ),
    "Comparison": (
        lambda: psa.compare(swing()[1], swing()[2]), lambda c: [repr(c), *map(repr, c.differences)],
    ),
    "HysteresisObserver": (
        lambda: moved(psa.HysteresisObserver(values()), 60.0), lambda b: block(b, 31.0),
    ),
    "FeedForward": (
        lambda: moved(psa.FeedForward(values()), 8e-6), lambda b: block(b, 3e-6),
    ),
    "OnlineIdentification": (
        lambda: moved(psa.OnlineIdentification(values()), 60.0, 8e-6),
        lambda b: [*block(b, 31.0, 4e-6), b.estimate],
    ),
    "AdaptiveFeedForward": (
        lambda: moved(psa.AdaptiveFeedForward(values()), 8e-6, 7e-6),
        lambda b: [*block(b, 3e-6, 4e-6), b.estimate],
    ),
    "Parameter": (lambda: stack().parameter("creep_gain"), lambda p: [p]),
    "State": (lambda: stack().structure.states[0], lambda s: [s]),
    "Input": (lambda: stack().structure.inputs[0], lambda i: [i]),
    "Output": (lambda: stack().structure.outputs[0], lambda o: [o]),
    "Publication": (lambda: psa.Publication("a", "1", "c", "l"), lambda p: [p]),
    "Job": (lambda: psa.Job("a", ("a.csv",), "b", date(2026, 1, 2)), lambda j: [j]),
    "Options": (psa.Options, lambda o: [o]),
    "BatchRun": (lambda: psa.BatchRun(Path("x"), (), (), 1, 2.0, ()), lambda b: [b, b.counts]),
    "Linear": (lambda: psa.linearize(_lag()), lambda v: [repr(v), v.a, v.to_json()]),
    "CodeExport": (
        lambda: psa.CodeExport(Path("a.h"), Path("a.c"), 2, ()), lambda c: [c],
    ),
    "CheckReport": (
        lambda: psa.CheckReport(Path("a.fmu"), (), compared=False), lambda c: [c, c.passed],
    ),
    "AmplifierLimits": (lambda: psa.design.AmplifierLimits(max_voltage=100.0), lambda a: [a]),
    "Limits": (
        lambda: psa.design.Limits(low=0.0, high=9.0, duration=1.0, samples=50),
        lambda a: [a, a.grid(5)],
    ),
}  # fmt: skip
#: What is no result, or is pickled by a separate slow test.
_OTHER = {"Symbols", "Timings", "Posterior", "InputError", "MachineError", "PsaError"}


def same(one: Any, other: Any) -> None:
    for a, b in zip(one, other, strict=True):
        if isinstance(a, np.ndarray) or (isinstance(a, list) and isinstance(a[0], np.ndarray)):
            np.testing.assert_array_equal(a, b)
        else:
            assert a == b


def test_every_public_class_has_an_example() -> None:
    spaces = (psa, psa.design, psa.online, psa.system)
    classes = {n for s in spaces for n in s.__all__ if inspect.isclass(getattr(s, n))}
    assert classes == set(EXAMPLES) | _OTHER


@pytest.mark.parametrize("name", EXAMPLES)
def test_a_pickle_answers_as_its_original(name: str) -> None:
    make, answers = EXAMPLES[name]
    made = make()
    assert type(made).__name__ == name
    same(answers(pickle.loads(pickle.dumps(made))), answers(made))


def test_components_of_this_package_stay_themselves() -> None:
    for component in (*psa.COMPONENTS.values(), *psa.EFFECTS.values()):
        assert pickle.loads(pickle.dumps(component)) is component
    for name in psa.STACKS:
        model = psa.stack_model(name)
        assert pickle.loads(pickle.dumps(model)).structure is model.structure
    for name in psa.PARTS:
        part = psa.part_model(name)
        assert pickle.loads(pickle.dumps(part)).values == part.values


def test_errors_keep_their_sentences() -> None:
    error = pickle.loads(pickle.dumps(psa.InputError(["one", "two"])))
    assert error.problems == ("one", "two")
    with psa.timed() as timings:
        psa.simulate(stack(), TIMES, WAVE)
    (stage,) = pickle.loads(pickle.dumps(timings)).stages
    assert (stage.name, stage.runs) == ("rest", timings.stages[0].runs)
    assert 0.0 < stage.wall <= timings.stages[0].wall


def test_another_process_predicts_the_same(tmp_path: Path) -> None:
    """A user's model, one of wired parts and one of an FMU, whose equations have no name."""
    fmu = psa.export_fmu(psa.part_model("flexure_stage"), tmp_path / "f.fmu")
    models = [oscillator(), psa.nanopositioner("P-885.51").model(), psa.fmu_model(fmu), stack()]
    (tmp_path / "models.pickle").write_bytes(pickle.dumps(models))
    code = (
        "import pickle, sys, numpy as np; from tests.test_python import driven;"
        "models = pickle.load(open(sys.argv[1], 'rb'));"
        "np.savez(sys.argv[2], *[driven(m)[0] for m in models])"
    )
    paths = [str(tmp_path / "models.pickle"), str(tmp_path / "y.npz")]
    subprocess.run([sys.executable, "-c", code, *paths], check=True)
    with np.load(tmp_path / "y.npz") as result:
        for model, y in zip(models, result.values(), strict=True):
            np.testing.assert_array_equal(y, driven(model)[0])


def test_another_fmu_in_its_place_is_reported(tmp_path: Path) -> None:
    fmu = psa.export_fmu(psa.part_model("flexure_stage"), tmp_path / "f.fmu")
    kept = pickle.dumps(psa.fmu_model(fmu))
    psa.export_fmu(psa.part_model("prestress_mechanism"), fmu)
    with pytest.raises(psa.InputError, match="another FMU"):
        pickle.loads(kept)


@slow
def test_a_posterior_is_pickled() -> None:
    record = identification().experiments[1].record
    result = psa.sample(identification().model, [record], draws=20, tune=20, chains=2)
    again = pickle.loads(pickle.dumps(result))
    assert again.figures == result.figures
    np.testing.assert_array_equal(again.tree.posterior["k_L"], result.tree.posterior["k_L"])
