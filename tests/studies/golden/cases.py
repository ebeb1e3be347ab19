"""The cases: records with known causes, measured ones, models of users, and exports."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import psa_casadi as psa
from tests.any_model import own_models as models
from tests.any_model import own_plants as plants
from tests.contract.helpers import done
from tests.studies.exam.marks import Answer, Group, Named, Question, mark
from tests.studies.exam.play import write
from tests.studies.exam.record import Record
from tests.studies.exam.records import RECORDS
from tests.studies.golden.exports import EXPORTS
from tests.studies.plants.make import make_record
from tests.studies.plants.table import called

Row = dict[str, str]


@dataclass(frozen=True)
class Case:
    """A case: its kind and name, what is hidden, and what answers it, in an empty folder."""

    kind: str
    name: str
    hidden: str
    answer: Callable[[Path], Row]

    @property
    def id(self) -> str:
        return f"{self.kind}/{self.name}"


# --- answers of a diagnosis ---------------------------------------------------------------------


def answered(*arguments: Any, **words: Any) -> tuple[dict[str, Any], Answer, float]:
    """Return the JSON of a diagnosis, its answer, and its processor time [s]."""
    begin = time.process_time()
    table = psa.diagnose(*arguments, **words).to_dict()
    seconds = time.process_time() - begin
    causes = (
        Named(c["effect"], c["confidence"], tuple(c["cannot_be_told_from"]), *_family(c))
        for c in table["causes"]
    )
    return table, Answer(table["verdict"], tuple(causes), *_family(table)), seconds


def _family(of: dict[str, Any]) -> tuple[str, float]:
    """Return the likeliest family, place and kind, and its probability."""
    first = next(iter(of.get("families", ())), None)
    return (f"{first['place']} {first['kind']}", first["probability"]) if first else ("", 0.0)


def diagnosed(question: Question | None, *arguments: Any, **words: Any) -> Row:
    """Return a diagnosis as text, with its mark where the truth is known (`exam.marks`)."""
    output, answer, seconds = answered(*arguments, **words)
    base, extended = _errors(output["errors"])
    budget, patch = output["budget"], output.get("patch") or output.get("correction") or {}
    return {
        "mark": "-" if question is None else mark(question, answer),
        "verdict": output["verdict"],
        "causes": " + ".join(_named(c) for c in answer.causes) or "-",
        "unnamed": patch.get("name") or patch.get("port") or "-",
        "removed": "-" if budget is None else f"{budget['together']['share']:.4f}",
        "base": _numbers(base),
        "extended": _numbers(extended),
        "seconds": f"{seconds:.1f}",
    }


def _errors(errors: Any) -> tuple[list[float], list[float]]:
    """Return the held-out errors of base and extended model: of a stack [m], or of every output."""
    if isinstance(errors, list):
        return [e["base"] for e in errors], [e["extended"] for e in errors]
    return [errors["base"]["holdout_rms_m"]], [errors["extended"]["holdout_rms_m"]]


def _named(cause: Named) -> str:
    rivals = f" (or {', '.join(cause.rivals)})" if cause.rivals else ""
    return f"{cause.effect} {cause.probability:.3f}{rivals}"


def _numbers(values: list[float]) -> str:
    return " ".join(f"{v:.6g}" for v in values)


# --- exam and study ----------------------------------------------------------------------------

#: What writes a record into a folder, of a draw other than 0 with fresh seeds: what is right to say
#: of it, and its file.
Ask = Callable[[Path, int], tuple[Question, Path]]


def _sat(record: Record, folder: Path, draw: int) -> tuple[Question, Path]:
    path = folder / f"{record.name}.csv"
    write(replace(record, seed=record.seed + _DRAW * draw), path)
    return record.question, path


#: Seeds of one draw are so far from those of the next.
_DRAW = 10007
#: Range of the effects' rms over the noise's, after the base's parameters are projected out.
_RANGES = {"strong": (1.0, 3.0), "weak": (0.1, 0.3), "foreign": (0.3, 3.0)}
#: The group of each kind of the study.
_GROUPS: dict[str, Group] = {
    "strong": "one", "weak": "one", "two": "two", "three": "three", "foreign": "foreign",
    "clean": "clean",
}  # fmt: skip
_FIRST_SEED = 990001
#: Kind, hidden causes, and the noise where it is not white, or the voltage where it is not rich.
_STUDY = """
strong slow_creep
strong rate_dependent_hysteresis
strong hysteresis_memory ar
strong saturation_of_strain
strong structural_mode
strong preload_loss quantised
strong self_heating
strong current_limit
strong sensor_delay drop-outs
strong temperature
weak field_dependent_gain
weak backlash ar
weak charge_leakage
weak drive_lag
weak sensor_nonlinearity
weak mains_hum quantised
weak offset_drift
clean - white
clean - white
clean - ar
clean - ar
clean - quantised
clean - drop-outs
clean - loops
foreign dry_friction
foreign floor_vibration
foreign guide_stiffness
foreign dead_zone_hysteresis
foreign cross_axis
foreign range_switch
foreign source_power
two slow_creep+sensor_lag
two structural_mode+offset_drift
two rate_independent_asymmetry+drive_lag
two load_stiffness+mains_hum
two ageing+voltage_saturation
three slow_creep+sensor_delay+mains_hum
three structural_mode+saturation_of_strain+temperature
three hysteresis_memory+current_limit+encoder_ripple
three preload_loss+drive_lag+offset_drift
"""


#: Families of the plants' foreign effects, place and kind, that a displacement can distinguish.
_FAMILIES = {
    "dry_friction": ("plant hysteresis",),
    "floor_vibration": ("environment time", "sensor time"),
    "guide_stiffness": ("plant curve",),
    "dead_zone_hysteresis": ("plant hysteresis",),
    "cross_axis": ("environment time", "sensor time"),
    "range_switch": ("sensor curve", "sensor hysteresis"),
    "source_power": ("sensor changing gain", "environment changing gain"),
}


def _studied(
    kind: str, hidden: tuple[str, ...], how: str, seed: int, folder: Path, draw: int
) -> tuple[Question, Path]:
    path = folder / "record.csv"
    wanted = _RANGES.get(kind, _RANGES["strong"])
    make_record(
        hidden[0] if hidden else None,
        seed + _DRAW * draw,
        path,
        noise="white" if how == "loops" else how,  # type: ignore[arg-type]
        excitation="loops" if how == "loops" else "rich",
        visible=wanted if hidden else None,
        more=hidden[1:],
        more_visible=wanted if hidden[1:] else None,
    )
    right = (_FAMILIES.get(name, (called(name),)) for name in hidden)
    noise = "" if how in ("white", "loops") else how
    return Question(_GROUPS[kind], tuple(map(frozenset, right)), noise=noise), path


def _asks() -> Iterator[tuple[str, str, str, Ask]]:
    """Kind, name, what is hidden, and what writes it."""
    for record in RECORDS:
        yield "exam", record.name, record.hides, partial(_sat, record)
    for k, line in enumerate(_STUDY.strip().splitlines()):
        kind, causes, how = (*line.split(), "white")[:3]
        hidden = () if causes == "-" else tuple(causes.split("+"))
        work = partial(_studied, kind, hidden, how, _FIRST_SEED + k)
        yield "study", f"{k + 1:02}-{kind}", f"{causes} {how}", work


ASKS = {f"{kind}/{name}": ask for kind, name, _, ask in _asks()}


def _examined(ask: Ask, folder: Path) -> Row:
    return diagnosed(*ask(folder, 0))


# --- measured records, models of users -----------------------------------------------------


def _measured(fitted: list[int], held_out: list[int], folder: Path) -> Row:
    records = psa.datasets.micromanipulator()
    holdout = [records[k] for k in held_out]
    return diagnosed(None, [records[k] for k in fitted], holdout=holdout)


_MEASURED = {"sine": ([0], []), "loops": ([1], []), "both": ([0, 1], []), "on-sine": ([1], [0])}
_MEMORIES = ["hysteresis", "stop", "curve", "zero", "drift"]
_USER_MODELS: dict[str, tuple[str, Callable[[], psa.Model], Callable[[], Any], dict[str, Any]]] = {
    "bouc-wen": ("hysteresis_of_x_in_v", models.oscillator, lambda: plants.bouc_wen(1), {}),
    "bouc-wen-noisy": (
        "hysteresis_of_x_in_v", models.oscillator, lambda: plants.bouc_wen(2, noise=3e-5), {},
    ),
    "breathing": ("foreign", models.oscillator, lambda: plants.breathing(4), {}),
    "friction": ("friction_in_speed", models.motor, lambda: plants.motor(1), {}),
    "little-friction": (
        "friction_in_speed", models.motor, lambda: plants.motor(3, friction=0.003), {},
    ),
    "motor": ("", models.motor, lambda: plants.motor(2, friction=0.0), {}),
    "overflow": ("stop_of_h1_in_h1", models.tanks, lambda: plants.tanks(3, "overflow"), {}),
    "bent-sensor": ("bend_of_level", models.tanks, lambda: plants.tanks(3, "sensor"), {}),
    "pair": ("", models.pair, lambda: plants.pair(4), {}),
    "dead-zone": (
        "dead_zone_of_u", models.cylinder, lambda: plants.cylinder(20), {"leave_out": _MEMORIES},
    ),
    "known-dead-zone": (
        "", lambda: models.cylinder(dead_zone=0.6), lambda: plants.cylinder(30),
        {"leave_out": _MEMORIES},
    ),
    "oven": ("lag_of_air", models.oven, lambda: plants.oven(40), {"known_start": True}),
}  # fmt: skip


def _user_model(name: str, folder: Path) -> Row:
    hidden, model, made, words = _USER_MODELS[name]
    records = made()
    if isinstance(records, list):
        *records, last = records
        words = {**words, "holdout": [last]}
    groups: dict[str, Group] = {"": "clean", "foreign": "foreign"}
    group = groups.get(hidden, "one")
    question = Question(group, (frozenset({hidden}),) if group == "one" else ())
    return diagnosed(question, model(), records, **words)


def _identified(folder: Path) -> Row:
    """Return which parameters of a sound stack `psa identify` determines, with intervals."""
    record, file = folder / "record.csv", folder / "identification.json"
    make_record(None, 990101, record, excitation="loops", visible=None)
    done("identify", record, "--json", file, "--quiet")
    content = json.loads(file.read_text("utf-8"))
    names: dict[str, list[str]] = {}
    for name, parameter in content["parameters"].items():
        names.setdefault(parameter["determined"], []).append(name)
    output = (content["parameters"][name] for name in names["determined"])
    return {
        "told": "; ".join(f"{how}: {' '.join(of)}" for how, of in names.items()),
        "parameters": _numbers([x for p in output for x in (p["value"], *p["interval"])]),
        "base": _numbers([content["rms_m"]]),
    }


def _all() -> Iterator[Case]:
    for kind, name, hidden, ask in _asks():
        yield Case(kind, name, hidden, partial(_examined, ask))
    for name, (fitted, held) in _MEASURED.items():
        yield Case("measured", name, "-", partial(_measured, fitted, held))
    for name, (hidden, *_) in _USER_MODELS.items():
        yield Case("own", name, hidden or "-", partial(_user_model, name))
    yield Case("identify", "loops", "-", _identified)
    for name, work in EXPORTS.items():
        yield Case("export", name, "-", work)


CASES = {case.id: case for case in _all()}
