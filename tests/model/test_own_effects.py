"""Effects of a user's own module: found, named, saved by reference, exported, refused."""

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import psa_casadi as psa
from psa_casadi.model import own_effects as place
from psa_casadi.model.model_file import dumps, loads
from psa_casadi.model.own_effects import declaration_hash, known_effects

RIPPLE = """
import casadi as ca
import psa_casadi as psa


def _equations(s):
    return psa.Equations(
        add={"measured_displacement": s.ripple * ca.sin(2.0 * ca.pi * s.x / s.ripple_period)}
    )


SENSOR_RIPPLE = psa.Component(
    "encoder_ripple",
    "an error that repeats with the grating's period",
    "Heydemann 1981",
    _equations,
    (
        psa.Parameter("ripple", 0.0, "m", (-1e-6, 1e-6), "its amplitude", scale=2e-8),
        psa.Parameter(
            "ripple_period", 4e-6, "m", (1e-7, 1e-4), "its period", log=True, fitted=False
        ),
    ),
    gain="ripple",
    belongs_to="sensor",
    needs=("sensor",),
)
"""


@pytest.fixture
def ripple(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[psa.Component]:
    """The effect of a module in the current folder."""
    (tmp_path / "gratings.py").write_text(RIPPLE)
    monkeypatch.chdir(tmp_path)
    _forget()
    yield psa.own_effects("gratings")["encoder_ripple"]
    _forget()


def _forget() -> None:
    psa.own_effects.cache_clear()
    place.installed_effects.cache_clear()
    sys.modules.pop("gratings", None)
    sys.modules.pop("rulings", None)
    importlib.invalidate_caches()


def extended(ripple: psa.Component) -> psa.Model:
    return psa.stack_model("P-885.51").with_effect(ripple, {"ripple": 5e-8})


def test_a_declaration_that_has_changed_is_refused(ripple: psa.Component, tmp_path: Path) -> None:
    text = dumps(extended(ripple))
    source = tmp_path / "gratings.py"
    source.write_text("# a comment changes nothing\n" + RIPPLE)
    _forget()
    commented = psa.own_effects("gratings")["encoder_ripple"]
    assert declaration_hash(commented) == declaration_hash(ripple)
    source.write_text(RIPPLE.replace("ca.sin", "ca.cos"))
    _forget()
    other = psa.own_effects("gratings")["encoder_ripple"]
    with pytest.raises(psa.InputError, match="declared in another way"):
        loads(text, effects=[other])


def install(site: Path, text: str) -> None:
    """Lay a package down as pip does, with the entry point that announces its effects."""
    (site / "gratings-1.dist-info").mkdir(parents=True)
    (site / "gratings.py").write_text(text)
    (site / "gratings-1.dist-info" / "METADATA").write_text("Name: gratings\nVersion: 1\n")
    (site / "gratings-1.dist-info" / "entry_points.txt").write_text(
        f"[{place.GROUP}]\ngratings = gratings\n"
    )


@pytest.fixture
def neighbours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A current folder with files of the names of what is imported; each tells that it ran."""
    here = tmp_path / "here"
    here.mkdir()
    tells = "from pathlib import Path; Path(__file__).with_suffix('.ran').touch()\n"
    install(tmp_path / "site", "import rulings\n" + RIPPLE)
    (tmp_path / "site" / "rulings.py").touch()
    install(here, tells + RIPPLE)
    (here / "rulings.py").write_text(tells)
    monkeypatch.chdir(here)
    monkeypatch.syspath_prepend(tmp_path / "site")
    _forget()
    yield here
    _forget()


@pytest.mark.parametrize("first", ["", "here", None])
def test_installed_packages_announce_theirs_and_no_neighbour_stands_for_one(
    first: str | None, neighbours: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if first is not None:  # as `python -m`, `python` and notebooks have it
        monkeypatch.syspath_prepend(str(neighbours) if first else "")
    before = list(sys.path)
    assert "encoder_ripple" in known_effects()
    assert len(known_effects()) == len(psa.EFFECTS) + 1
    assert psa.own_effects("gratings").keys() == {"encoder_ripple"}
    assert not list(neighbours.glob("*.ran"))
    assert sys.path == before


def test_a_neighbour_stands_for_nothing_that_is_missing(
    neighbours: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "site" / "gratings.py").unlink()
    monkeypatch.syspath_prepend("")
    with pytest.raises(psa.InputError, match=r"No module named 'gratings'"):
        known_effects()
    assert not list(neighbours.glob("*.ran"))
    assert "encoder_ripple" in psa.own_effects("gratings")  # it is asked for
    assert (neighbours / "gratings.ran").is_file()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("import nothing_of_that_name", "cannot be imported"),
        ("X = 1", "holds no effect"),
        (RIPPLE.replace('"encoder_ripple"', '"slow_creep"'), "named 'slow_creep' too"),
        (RIPPLE.replace("s.x /", "s.no_such_symbol /"), "no_such_symbol"),
    ],
)
def test_a_module_that_does_not_do_is_told_in_a_sentence(
    text: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "gratings.py").write_text(text)
    monkeypatch.chdir(tmp_path)
    _forget()
    with pytest.raises(psa.InputError, match=message):
        psa.own_effects("gratings")
    _forget()
