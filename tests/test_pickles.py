"""Every public class of models and results is pickled, and predicts the same afterwards."""

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
import pytest
from numpy.typing import NDArray

import psa_casadi as psa
from psa_casadi.any_model.identify import identify_ode
from psa_casadi.component import OnDemand
from tests.any_model.own_models import oscillator
from tests.report.report_cases import diagnosis, identification
from tests.tiers import slow

FloatArray = NDArray[np.float64]
T = np.linspace(0.0, 0.0199, 200)
U = 40.0 - 40.0 * np.cos(400.0 * T)
PERIOD = 1e-4


def driven(model: psa.Model) -> list[FloatArray]:
    """Return the outputs of a model on a wave of all its inputs."""
    u = np.outer(U / 80.0, [i.start + 1.0 for i in model.structure.inputs])
    x0 = np.array([s.start for s in model.structure.states])
    return [psa.run(model, T, u, x0).y]


def stack() -> psa.Model:
    model = psa.stack_model("P-885.51").with_effect(psa.EFFECTS["slow_creep"], {"creep_gain": 0.05})
    return psa.settled_at(model, 20.0, (60.0,))


@cache
def own() -> tuple[psa.Signals, psa.OdeIdentification, psa.OdeDiagnosis]:
    """Return a record of an oscillator with a stop, and what is found in it."""
    model = oscillator()
    t = np.linspace(0.0, 0.599, 600)
    force = 40.0 * np.sin(25.0 * t) + 15.0 * np.sin(61.0 * t)
    y = psa.run(model.with_values({"c": 40.0}), t, force[:, None], np.zeros(2)).y[:, 0]
    y = y + 1e-6 * np.random.default_rng(0).normal(size=t.size)
    record = psa.Signals(name="r", time=t, columns={"force": force, "position": y})
    fitted = identify_ode(model, [record], starts=1)
    return record, fitted, psa.diagnose(model, [record])


def block(made: Any, *samples: float) -> list[float]:
    """Return what a block says next, without moving it on."""
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


#: By public class: an example, and what it answers.
EXAMPLES: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "Model": (stack, driven),
    "System": (lambda: psa.nanopositioner("P-885.51"), lambda s: driven(s.model())),
    "Component": (lambda: oscillator().components[0], symbol_names),
    "Equations": (equations, lambda e: [dict(e.out)]),
    "Record": (
        lambda: diagnosis("adequate").experiments[0].record,
        lambda r: [r.time, r.voltage, r.displacement, r.sha256],
    ),
    "Signals": (lambda: own()[0], lambda s: [s.time, *s.columns.values(), s.sha256]),
    "Trajectory": (
        lambda: psa.simulate(stack(), T, U),
        lambda t: [t.displacement, *t.states.values(), t.way],
    ),
    "Identification": (
        identification,
        lambda i: [*i.fit.predicted(i.experiments), repr(i), i.determinacy.names],
    ),
    "Diagnosis": (
        lambda: diagnosis("cause_named"),
        lambda d: [d.to_json(), repr(d), *d.base, *d.extended, *driven(d.model)],
    ),
    "OdeIdentification": (
        lambda: own()[1],
        lambda i: [*i.fit.predicted(i.runs), repr(i), *driven(i.model)],
    ),
    "OdeDiagnosis": (
        lambda: own()[2],
        lambda d: [d.to_json(), repr(d), *driven(d.model), *d.extended_fit.predicted(d.runs)],
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
#: What is no result, or is pickled by a slow test of its own.
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
        assert (
            pickle.loads(pickle.dumps(psa.part_model(name))).values == psa.part_model(name).values
        )


def test_errors_keep_their_sentences() -> None:
    error = pickle.loads(pickle.dumps(psa.InputError(["one", "two"])))
    assert error.problems == ("one", "two")
    with psa.timed() as timings:
        psa.simulate(stack(), T, U)
    (stage,) = pickle.loads(pickle.dumps(timings)).stages
    assert (stage.name, stage.runs) == ("rest", timings.stages[0].runs)
    assert 0.0 < stage.wall <= timings.stages[0].wall


def test_another_process_predicts_the_same(tmp_path: Path) -> None:
    """A model of one's own, one of wired parts and one of an FMU, whose equations have no name."""
    fmu = psa.export_fmu(psa.part_model("flexure_stage"), tmp_path / "f.fmu")
    models = [oscillator(), psa.nanopositioner("P-885.51").model(), psa.fmu_model(fmu), stack()]
    (tmp_path / "models.pickle").write_bytes(pickle.dumps(models))
    code = (
        "import pickle, sys, numpy as np; from tests.test_pickles import driven;"
        "models = pickle.load(open(sys.argv[1], 'rb'));"
        "np.savez(sys.argv[2], *[driven(m)[0] for m in models])"
    )
    given = [str(tmp_path / "models.pickle"), str(tmp_path / "y.npz")]
    subprocess.run([sys.executable, "-c", code, *given], check=True)
    with np.load(tmp_path / "y.npz") as found:
        for model, y in zip(models, found.values(), strict=True):
            np.testing.assert_array_equal(y, driven(model)[0])


def test_another_fmu_in_its_place_is_told(tmp_path: Path) -> None:
    fmu = psa.export_fmu(psa.part_model("flexure_stage"), tmp_path / "f.fmu")
    kept = pickle.dumps(psa.fmu_model(fmu))
    psa.export_fmu(psa.part_model("prestress_mechanism"), fmu)
    with pytest.raises(psa.InputError, match="another FMU"):
        pickle.loads(kept)


@slow
def test_a_posterior_is_pickled() -> None:
    record = identification().experiments[1].record
    found = psa.sample(identification().model, [record], draws=20, tune=20, chains=2)
    again = pickle.loads(pickle.dumps(found))
    assert again.figures == found.figures
    np.testing.assert_array_equal(again.tree.posterior["k_L"], found.tree.posterior["k_L"])
