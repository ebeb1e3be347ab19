"""Whether names of an own model's diagnosis stand: output by output, and against free functions."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from psa_casadi.any_model.free_functions import Free
from psa_casadi.any_model.hypothesis import OdeHypothesis
from psa_casadi.any_model.judge import beaten_by, left_out, weighed, why_not_named
from psa_casadi.any_model.search import Known

#: Held-out errors of a circuit with a coil that saturates: current [A] and voltage [V].
BASE, NOISE = (0.44, 7.92), (0.0096, 0.052)
NAMED, FREE = (0.206, 0.66), (0.05, 0.642)


def _hypothesis(names: tuple[str, ...], errors: tuple[float, ...]) -> Any:
    causes = [SimpleNamespace(name=n) for n in names]
    outputs = [SimpleNamespace(column=c) for c in ("current", "uc")]
    return SimpleNamespace(
        names=frozenset(names), causes=causes, errors=errors, fit=SimpleNamespace(outputs=outputs)
    )


ROOT = cast(OdeHypothesis, _hypothesis((), BASE))
LOOP = cast(OdeHypothesis, _hypothesis(("hysteresis",), NAMED))
BOTH = cast(OdeHypothesis, _hypothesis(("constant", "drag"), (0.01, 0.06)))


def _known(evidence: dict[frozenset[str], float], alarm: bool = True) -> Known:
    """A search that has found the three sets of causes, of which `constant` adds little."""
    found = {h.names: h for h in (ROOT, LOOP, BOTH)}

    def of_fitted(h: SimpleNamespace) -> float:
        return evidence[frozenset(h.names)] - 8.0 * len(h.causes)

    told = SimpleNamespace(
        found=found,
        evidence=lambda h: evidence[h.names],
        of_fitted=of_fitted,
        score=of_fitted,
        view=lambda h: SimpleNamespace(test=SimpleNamespace(alarm=alarm)),
        slight=lambda h: ("constant",) if "constant" in h.names else (),
        stands=lambda h: True,
    )
    return cast(Known, told)


def _free(evidence: float, errors: tuple[float, ...], share: float) -> Free:
    port = SimpleNamespace(words="the rate of i")
    told = SimpleNamespace(evidence=evidence, errors=errors, share=share, port=port, of="i and v")
    return cast(Free, told)


KNOWN = _known({ROOT.names: 0.0, LOOP.names: 6555.0, BOTH.names: 9000.0})


def test_the_share_of_every_output_that_the_base_misses_is_its_own() -> None:
    own = weighed(ROOT, NAMED, NOISE, 0.9755)
    expected = (0.44**2 - 0.206**2) / (0.44**2 - 0.0096**2)
    assert own.each["current"] == pytest.approx(expected, rel=1e-12)
    assert own.least == ("current", own.each["current"])
    quiet = weighed(ROOT, NAMED, (0.4, 0.052), 0.9755)  # the base is 1.1 times its noise
    assert list(quiet.each) == ["uc"]
    assert quiet.least == ("", 0.9755)


def test_names_fall_to_a_free_function_that_removes_more_of_one_output() -> None:
    own = weighed(ROOT, NAMED, NOISE, 0.9755)
    beaten = beaten_by(KNOWN, LOOP, own, [_free(8500.0, FREE, 0.993)], NOISE)
    assert beaten is not None
    assert beaten.output == "current"
    said = str(why_not_named(("hysteresis",), own, beaten))
    assert "remove 78% of the held-out error above the noise of current; not named" in said
    assert "a free function of i and v in the rate of i explains more (99%)" in said
    less = [
        _free(6600.0, FREE, 0.993),  # hardly likelier
        _free(8500.0, (0.2, 0.6), 0.98),  # the same but for the form
        _free(8500.0, (0.05, 3.0), 0.9),  # worse in the other output
    ]
    assert beaten_by(KNOWN, LOOP, own, less, NOISE) is None


def test_what_is_named_removes_enough_of_every_output() -> None:
    assert weighed(ROOT, NAMED, NOISE, 0.9755).enough  # 78 % of the current
    half = weighed(ROOT, (0.3, 0.66), NOISE, 0.97)
    assert not half.enough
    assert not weighed(ROOT, (0.01, 0.06), NOISE, 0.69).enough
    assert str(why_not_named(("hysteresis",), half, None)) == (
        "hysteresis would remove 54% of the held-out error above the noise of current; not named,"
        " because that is less than 70% and much remains."
    )


def test_causes_that_fit_better_and_add_little_are_told() -> None:
    (note,) = left_out(KNOWN, LOOP)
    assert str(note).startswith(
        "constant and drag together fit better (ln of the Bayes factor higher by"
    )
    assert "by 2445). Not named, because constant would remove less than 2%" in str(note)
    assert left_out(KNOWN, ROOT) == ()
    none = _known({ROOT.names: 0.0, LOOP.names: 6555.0, BOTH.names: 6560.0})
    assert left_out(none, LOOP) == ()
    assert left_out(_known({LOOP.names: 1.0, BOTH.names: 9.0, ROOT.names: 0.0}, False), LOOP) == ()
