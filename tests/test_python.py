"""The public names: few to begin with, the others where they belong; a model in CasADi's words."""

import ast
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import psa_casadi as psa
from psa_casadi.diagnosis.result import Verdict
from psa_casadi.records import records_given
from tests.report.report_cases import diagnosis, identification


def test_dir_has_every_public_name_and_all_are_there() -> None:
    """Those that a tool or a reader looks for: of the package, its stubs for types, its spaces."""
    spaces = {"datasets", "design", "online", "system", "__version__"}
    assert spaces < set(dir(psa)) == set(psa.__all__)
    tree = ast.parse(Path(psa.__file__).read_text(encoding="utf-8"))
    typed = {
        alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)
        for alias in node.names
    } - {"import_module", "TYPE_CHECKING", "Any"}  # fmt: skip
    assert typed == set(dir(psa))
    assert {*psa.online.__all__, *psa.system.__all__} <= set(dir(psa))
    for name in dir(psa):
        assert getattr(psa, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = psa.nothing


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
#: What is asked of a diagnosis, whether it was just made or is read back.
ANSWERS = (
    "verdict", "causes", "candidates", "base_errors", "extended_errors", "gain",
    "noise_floor_rms_m", "kept", "doubt", "notes",
)  # fmt: skip


def test_a_missing_reading_of_a_frame_is_missing() -> None:
    y = [None if k == 3 else float(x) for k, x in enumerate(X)]
    record = psa.record_from(pd.DataFrame({**TABLE, "displacement [um]": y}))
    assert np.flatnonzero(~record.mask).tolist() == [3]


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"displacement [um]": X[:-1]}, "has 63 values"),
        ({"displacement [um]": ["a"] * 64}, "not all numbers"),
        ({"displacement [V]": X}, "displacement"),
        ({"time [ms]": T[::-1]}, "time"),
    ],
)
def test_a_wrong_table_is_refused_as_a_file_is(changed: dict[str, object], said: str) -> None:
    table = {k: v for k, v in TABLE.items() if k.split()[0] != next(iter(changed)).split()[0]}
    with pytest.raises(psa.InputError, match=said):
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
    d, found = diagnosis("cause_named"), identification()
    samples = d.to_frame()
    assert len(samples) == sum(e.record.n for e in d.experiments)
    rest = samples[samples.held_out]
    rms = float(np.sqrt(np.nanmean((rest["measured [m]"] - rest["base [m]"]) ** 2)))
    assert 0.0 < rms < 1e-6
    parameters = found.to_frame().set_index("parameter")
    assert parameters.value.to_dict() == dict(found.model.values)
    assert (parameters.low <= parameters.value)[parameters.low.notna()].all()
    run = psa.simulate(found.model, T, V)
    table = run.to_frame()
    np.testing.assert_array_equal(table["voltage [V]"], V)
    assert {"time [s]", "measured_displacement [m]", "f_H [N]"} <= {*table}
    read = psa.record_from(table[["time [s]", "voltage [V]", "displacement [m]"]])
    np.testing.assert_array_equal(read.displacement, run.outputs["displacement"])


def test_one_output_is_drawn_on_the_axes_that_are_given() -> None:
    d, found = diagnosis("cause_named"), identification()
    run, record = psa.simulate(found.model, T, V), d.experiments[0].record
    axes = Figure().add_subplot()
    assert run.plot(ax=axes, output="f_H") is axes.figure
    (curve,) = axes.lines
    np.testing.assert_array_equal(curve.get_ydata(), run.states["f_H"])
    assert axes.get_ylabel() == "f_H [N]"
    for result, curves in ((run, 1), (record, 1), (d, 3), (found, 2)):
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


def test_what_is_no_diagnosis_is_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / "x.json"
    for text, said in (("{}", "no diagnosis"), ("[", "x.json"), (
        '{"format": "psa_casadi.diagnosis/1"}', "'verdict' is missing")):  # fmt: skip
        path.write_text(text, encoding="utf-8")
        with pytest.raises(psa.InputError, match=said):
            psa.load_diagnosis(path)
    with pytest.raises(psa.InputError, match=r"none\.json"):
        psa.load_diagnosis(tmp_path / "none.json")
