"""Score answers to the data set of hidden causes: python score.py DATA ANSWERS [--json FILE]

Needs numpy and nothing else. A case without an answer counts as nothing detected. Malformed answers
are listed in sentences, and nothing is scored: exit code 2.
"""

import itertools
import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

FORMAT = "psa_causes.answer/1"
#: The same curve below the resonances: counted apart.
BENDS = ("load_stiffness", "sensor_nonlinearity")
#: Classes of stated probability, above the one and up to the next.
CLASSES = (0.02, 0.2, 0.5, 0.8, 0.95, 1.0)


def column(path, name):
    """Return the column of a CSV whose heading starts with a name, (N,), nan where empty."""
    heads = path.read_text(encoding="utf-8").split("\n", 1)[0].split(",")
    at = [h.split(" [")[0] for h in heads].index(name)
    return np.genfromtxt(path, delimiter=",", skip_header=1, usecols=at)


def _number(value):
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def faults(answer, name, causes, samples):
    """Return what is wrong with an answer, in sentences; `samples`: of the held-out record."""
    if not isinstance(answer, dict) or answer.get("format") != FORMAT:
        return [f'{name}: the format is not \'{FORMAT}\'; write "format": "{FORMAT}".']
    wrong = []
    if answer.get("case") != name:
        wrong.append(f'{name}: "case" is {answer.get("case")!r}; it must be the file\'s name.')
    if not isinstance(answer.get("detected"), bool):
        wrong.append(f'{name}: "detected" must be true or false.')
    sets = answer.get("causes")
    if not isinstance(sets, list) or not all(isinstance(s, dict) and s for s in sets):
        return [*wrong, f'{name}: "causes" must be a list of objects, each {{cause: probability}}.']
    for one_set in sets:
        wrong += [
            f"{name}: there is no cause '{c}'; data.json lists them."
            for c in one_set
            if c not in causes
        ]
        if (
            not all(_number(p) and 0 <= p <= 1 for p in one_set.values())
            or sum(one_set.values()) > 1.001
        ):
            wrong.append(f"{name}: probabilities of a set lie in 0 to 1 and add up to at most 1.")
    y = answer.get("displacement_um")
    if y is not None and not (
        isinstance(y, list) and len(y) == samples and all(_number(v) for v in y)
    ):
        wrong.append(f'{name}: "displacement_um" must hold {samples} numbers, as holdout.csv.')
    return [*wrong, *_more_faults(answer, name)]


def _more_faults(answer, name):
    wrong = []
    gain, patch = answer.get("gain_percent"), answer.get("patch")
    if gain is not None and not (
        isinstance(gain, dict) and all(_number(gain.get(k)) for k in ("value", "low", "high"))
    ):
        wrong.append(f'{name}: "gain_percent" must hold the numbers value, low and high.')
    if patch is not None and not _is_curve(patch):
        wrong.append(
            f'{name}: "patch" must hold "column" (time, voltage, temperature or base'
            ' displacement) and as many increasing "at" as "adds_um".'
        )
    return wrong


def _is_curve(patch):
    if not isinstance(patch, dict):
        return False
    at, adds = patch.get("at"), patch.get("adds_um")
    return (
        patch.get("column") in ("time", "voltage", "temperature", "base displacement")
        and isinstance(at, list) and isinstance(adds, list) and len(at) == len(adds) > 1
        and all(_number(v) for v in (*at, *adds)) and bool(np.all(np.diff(at) > 0))
    )  # fmt: skip


def read(data, answers):
    """Return truth, answers and causes; print what is wrong with answers and exit."""
    about = json.loads((data / "data.json").read_text(encoding="utf-8"))
    truth = json.loads((data / "truth" / "truth.json").read_text(encoding="utf-8"))["cases"]
    contents, wrong = {}, []
    if not answers.is_dir():
        wrong.append(f"{answers} is no folder; give the one with your answers, 001.json and so on.")
    for path in sorted(answers.glob("*.json")):
        if path.stem not in truth:
            wrong.append(f"{path.name}: the data set has no such case.")
            continue
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            wrong.append(f"{path.name} is no JSON: {error}.")
            continue
        samples = column(data / "truth" / f"{path.stem}.csv", "time").size
        wrong += faults(content, path.stem, about["causes"], samples)
        contents[path.stem] = content
    if wrong:
        print("\n".join(wrong), file=sys.stderr)
        raise SystemExit(2)
    return truth, contents, about["causes"]


def held_out(data, name, answer):
    """Return rms on the held-out record of prediction, base and noise [um]; nan if there is none.

    The mean of an error is the zero of the sensor and does not count.
    """
    true, case = data / "truth" / f"{name}.csv", data / "cases" / name
    read_um, clean = column(true, "displacement"), column(true, "displacement without noise")
    base = column(case / "base_holdout.csv", "base displacement")
    y, patch = answer.get("displacement_um"), answer.get("patch")
    if y is None and patch is not None:
        over = column(case / "base_holdout.csv", patch["column"])
        y = base + np.interp(over, patch["at"], patch["adds_um"])
    spread = [np.nanstd(read_um - np.asarray(x)) for x in (base, clean)]
    return (np.nan if y is None else np.nanstd(read_um - np.asarray(y))), *spread


def one(data, name, true, answer):
    """Return the marks of one case."""
    sets = answer.get("causes", [])
    within = {c for one_set in sets for c in one_set}
    error, base, noise = held_out(data, name, answer)
    hidden, gain = true["hidden"], answer.get("gain_percent")
    alone = next(iter(sets[0])) if len(sets) == 1 and len(sets[0]) == 1 else None
    reached = 100.0 * (1.0 - error / base)
    return {
        "case": name, "kind": true["kind"], "hidden": hidden, "alone": alone,
        "answered": bool(answer), "detected": bool(answer.get("detected")), "named": bool(sets),
        "in_set": set(hidden) <= within, "right_alone": len(hidden) == 1 and alone == hidden[0],
        "single_wrong": alone is not None and alone not in hidden,
        "exactly": sorted(max(s, key=s.get) for s in sets) == sorted(hidden),
        "size": len(sets[0]) if len(sets) == 1 else None,
        "over_noise": error / noise, "base_over_noise": base / noise,
        "removed": (base**2 - error**2) / (base**2 - noise**2) if base > noise else np.nan,
        "gain_held": None if gain is None or np.isnan(error)
        else bool(gain["low"] <= reached <= gain["high"]),
        "stated": sets[0] if sets else {}, "seconds": answer.get("seconds"),
    }  # fmt: skip


def brier(marks):
    """Return the mean square between the first set's probabilities and what is, over causes and
    "nothing listed": 0 is perfect, 2 the worst.
    """
    costs = []
    for m in marks:
        true = m["hidden"][0] if m["kind"] in ("known", "weak") else ""
        stated = {**m["stated"], "": 1.0 - sum(m["stated"].values())}
        costs.append(sum((stated.get(c, 0.0) - (c == true)) ** 2 for c in {*stated, true}))
    return float(np.mean(costs)) if costs else None


def reliability(marks):
    """Return for each class of stated probability: mean, right, number."""
    pairs = [(p, c in m["hidden"]) for m in marks for c, p in m["stated"].items()]
    rows = []
    for low, high in itertools.pairwise(CLASSES):
        inside = [(p, right) for p, right in pairs if low < p <= high + 1e-9]
        if inside:
            mean = float(np.mean([p for p, _ in inside]))
            rows.append({"above": low, "up_to": high, "mean": mean,
                         "right": sum(r for _, r in inside), "of": len(inside)})  # fmt: skip
    return rows


def _quantile(values, q):
    kept = [v for v in values if v is not None and math.isfinite(v)]
    return float(np.quantile(kept, q)) if kept else None


def figures(marks):
    """Return the figures: name -> [count, of] or a number, None where no case has one."""
    known, weak, clean, foreign, two = (
        [m for m in marks if m["kind"] == k] for k in ("known", "weak", "clean", "foreign", "two")
    )
    straight = [m for m in known if m["hidden"][0] not in BENDS]
    gained = [m for m in marks if m["gain_held"] is not None]
    listed = [*known, *weak, *clean, *foreign]
    predicted = [*known, *weak, *two]

    def count(cases, key, wanted=True):
        return [sum(m[key] == wanted for m in cases), len(cases)]

    return {
        "answered": count(marks, "answered"),
        "detected, 0.3 to 3 times the noise": count(known, "detected"),
        "right name in the set": count(known, "in_set"),
        "right name alone": count(known, "right_alone"),
        "right name alone, the two bends not counted": count(straight, "right_alone"),
        "a single wrong name": count([*known, *weak], "single_wrong"),
        "weak (0.1 to 0.3): right name in the set": count(weak, "in_set"),
        "clean: a cause named": count(clean, "named"),
        "clean: any alarm": count(clean, "detected"),
        "foreign: detected": count(foreign, "detected"),
        "foreign: no single name": count(foreign, "alone", None),
        "two causes: both in the sets": count(two, "in_set"),
        "two causes: both named first, no third": count(two, "exactly"),
        "size of a single set, mean": float(np.mean([m["size"] for m in known if m["size"]] or [0])),
        "Brier score": brier(listed),
        "held-out error over the noise, median": _quantile([m["over_noise"] for m in predicted], 0.5),
        "held-out error over the noise, 95th": _quantile([m["over_noise"] for m in predicted], 0.95),
        "the fitted base's, median": _quantile([m["base_over_noise"] for m in predicted], 0.5),
        "clean: held-out error over the noise, median": _quantile([m["over_noise"] for m in clean], 0.5),
        "foreign: share of the excess removed, median": _quantile([m["removed"] for m in foreign], 0.5),
        "interval of the gain holds it": count(gained, "gain_held"),
        "seconds of a case, median": _quantile([m["seconds"] for m in marks], 0.5),
    }  # fmt: skip


def score(data: Path, answers: Path) -> dict[str, Any]:
    """Return figures, reliability and the marks of every case."""
    truth, contents, _ = read(data, answers)
    marks = [one(data, name, true, contents.get(name, {})) for name, true in truth.items()]
    single = [m for m in marks if m["kind"] != "two"]
    return {"figures": figures(marks), "reliability": reliability(single), "cases": marks}


def formatted(value: Any) -> str:
    """Return a figure as text."""
    if value is None:
        return "-"
    if isinstance(value, list):
        share = f" ({100 * value[0] / value[1]:.0f} %)" if value[1] else ""
        return f"{value[0]} of {value[1]}{share}"
    return f"{value:.3g}"


def main(words):
    """Print the table; 0 scored, 2 wrong usage or malformed answers."""
    out = None
    if "--json" in words[:-1]:
        at = words.index("--json")
        out, words = Path(words[at + 1]), words[:at] + words[at + 2 :]
    if len(words) != 2 or not (Path(words[0]) / "data.json").is_file():
        print(f"{__doc__.splitlines()[0]}\nDATA is the folder with data.json.", file=sys.stderr)
        return 2
    result = score(Path(words[0]), Path(words[1]))
    for name, value in result["figures"].items():
        print(f"{name:48s} {formatted(value)}")
    for r in result["reliability"]:
        print(f"stated {r['above']:.2f} to {r['up_to']:.2f} (mean {r['mean']:.2f}):"
              f" {formatted([r['right'], r['of']])} right")  # fmt: skip
    if out is not None:
        text = json.dumps(result, indent=1).replace("NaN", "null")
        out.write_text(text + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
