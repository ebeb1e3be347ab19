"""The records advised against what is left open: sized by the records, and they really help."""

import pytest

from psa_casadi.identification.advice import Advice, advice, plans
from psa_casadi.identification.determinacy import determinacy
from psa_casadi.identification.fitting.fit import fit
from psa_casadi.records import Record
from psa_casadi.records.split import whole
from psa_casadi.report.words.notes import plan_words
from tests.identification.loop_fits import FREE, NOISE, loops, measured
from tests.model.stack_models import stack
from tests.studies.benchmarks.records import loop_voltage
from tests.tiers import slow_but


def advised(name: str) -> tuple[Advice, ...]:
    result, _, determined = loops(name)
    return advice(result, determined)


def test_slow_loops_of_a_ringing_stack_call_for_fast_records() -> None:
    results = advised("PTBS200")
    planned = [a for a in results if a.record is not None]
    assert {n for a in planned for n in a.parameters} == {"tau", "R_s", "c_P", "c_B"}
    for a in planned:
        assert a.record is not None
        assert 5e3 < 1.0 / a.record.sample_time < 5e6
        assert a.record.duration < 0.5  # the loops take two seconds
        assert a.record.displacement is None
    assert results[0].sentence.endswith(f"would determine {', '.join(planned[0].parameters[:-1])}"
                                        f" and {planned[0].parameters[-1]}.")  # fmt: skip
    ringing, last = results[-2:]
    assert ringing.sentence.startswith("If the mechanics ring, m_P and m_B would be determined")
    assert (last.kind, last.record) == ("force", None)
    result, _, determined = loops("PTBS200")
    advices = advice(result, determined, force_scale_given=True)
    assert [a.sentence for a in advices] == [a.sentence for a in results[:-1]]


@pytest.mark.parametrize("name", slow_but(["P-885.51"], ["PTBS200", "P-885.51"]))
def test_following_the_advice_determines_what_it_promises(name: str) -> None:
    """The truth beyond the loops is not known to the advice: PTBS200 rings, the other does not."""
    model = stack(name)
    result, experiments, determined = loops(name)
    results = advised(name)
    new = [
        whole(measured(model, f"new {k}", a.record.time, a.record.voltage, 10 + 20 * k + i))
        for k, a in enumerate(results)
        if a.record is not None
        for i in range(a.repeats)
    ]
    promised = [n for a in results if a.record is not None for n in a.parameters]
    if name == "PTBS200":
        promised += [n for a in results if a.sentence.startswith("If") for n in a.parameters]
    assert set(determined.undetermined) <= set(promised)
    both = [*experiments, *new]
    sigma = [*result.sigma, *[result.sigma[0]] * len(new)]
    again = fit(model, both, tuple(dict.fromkeys([*FREE, *promised])), sigma=sigma)
    after = determinacy(again)
    assert not set(promised) & set(after.undetermined)
    for n in promised:
        error = after.standard_errors[n]
        assert abs(again.model.values[n] - model.values[n]) < 4.0 * error
        if n in determined.undetermined:
            assert error < 0.5 * determined.standard_errors[n]


def test_what_no_record_can_tell_is_said() -> None:
    """Only the product of resistance and capacitance acts on a displacement."""
    model = stack("P-885.51")
    time, voltage = loop_voltage(model.values, 1.0, 1.0)
    record = measured(model, "loop", time, voltage, 3)
    experiments = [whole(record)]
    result = fit(model, experiments, ("k_L", "R_s", "C_p"), sigma=[NOISE * record.range_m])
    determined = determinacy(result)
    assert {"R_s", "C_p"} == set(determined.undetermined)
    results = advice(result, determined)
    nothing = [a for a in results if a.sentence.startswith("None of the ")]
    assert len(nothing) == 1
    assert set(determined.undetermined) <= set(nothing[0].parameters)
    assert nothing[0].record is None


def test_plans_stay_within_the_records_voltages() -> None:
    model = stack("P-885.51")
    time, voltage = loop_voltage(model.values, 0.7, 1.0)
    record = Record(name="loop", time=time, voltage=voltage - 20.0)
    result = plans([model], [record])
    assert {p.kind for p in result} == {"step", "multisine", "loop", "minor loops"}
    for p in result:
        assert p.record.voltage.min() >= -20.0 - 1e-9
        assert p.record.voltage.max() <= 0.7 * 120.0 - 20.0 + 1e-9
        assert p.record.voltage[0] == pytest.approx(-20.0)
        assert "-20 V" in plan_words(p)
    rates = [p.rate for p in result if p.kind == "step"]
    assert rates == sorted(rates)
    assert len(rates) <= 6
