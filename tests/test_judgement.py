"""What a search found, and what of it is named."""

from psa_casadi.diagnosis.budget import Share
from psa_casadi.diagnosis.judgement import too_small


def _share(what: str, share: float) -> Share:
    return Share(what, share, (share - 0.03, share + 0.03))


def test_little_is_not_named_beside_much() -> None:
    memory, heating = _share("hysteresis_memory", 0.75), _share("self_heating", 0.022)
    assert too_small([memory, heating]) == (heating,)
    assert too_small([memory, _share("slow_creep", 0.06)]) == ()


def test_the_largest_cause_is_always_named() -> None:
    assert too_small([_share("slow_creep", 0.04)]) == ()
    assert too_small([_share("slow_creep", 0.04), _share("drift", 0.03)])[0].what == "drift"
    assert too_small([]) == ()
