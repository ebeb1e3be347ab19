"""The command: help, exit codes, messages, files written whole or not at all, the served page."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

import psa_casadi as psa
from tests.contract.helpers import DATA, PSA, command, done, refused, request, served, write
from tests.tiers import posix, slow

COMMANDS = (
    "demo", "identify", "sample", "simulate", "diagnose", "batch", "compare", "effects", "stacks",
    "export fmu", "export modelica", "export c", "export ssp", "design experiment",
    "design mechanism", "design input", "check", "web", "examples", "datasets",
)  # fmt: skip


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example_and_can_be_quiet(name: str) -> None:
    for option in ("--help", "-h"):
        text = done(*name.split(), option).words
        assert f"Usage: psa {name}" in text
        assert f"Example: psa {name}" in text
        assert "--quiet" in text
    assert name.split(maxsplit=1)[0] in done("--help").out.split()


def test_importing_the_package_and_help_are_quick_and_load_no_casadi() -> None:
    code = "import sys, psa_casadi.cli.app; print({'casadi', 'numpy'}.intersection(sys.modules))"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert run.stdout == "set()\n"


@pytest.mark.parametrize(
    ("words", "message_part"),
    [
        (("identfy",), "identfy"),
        (("simulate", "--stack", "demo"), "--input"),
        (("simulate", "--input", "{demo}", "-o", "{out}"), "The model is missing; add --model"),
        (("simulate", "--stack", "p885", "--input", "{demo}", "-o", "{out}"), "mean P-885.51?"),
        (("simulate", "--model", "{bytes}", "--input", "x", "-o", "{out}"), "it is no text in"),
        (("diagnose",), "records"),
        (("identify", "{bytes}", "--method", "best"), "--method"),
        (("identify", "{absent}", "-o", "{out}"), "there is no such file"),
        (("compare", "{absent}", "b.json"), "absent.csv: cannot be read"),
        (("export", "fmu", "--stack", "P-1", "-o", "{out}"), "P-1"),
        (("export", "fmu", "--stack", "xyzzy", "-o", "{out}"), "there are PTBS200, WYDS0808020"),
        (("export", "fmu", "--stack", "demo", "--model", "m", "-o", "{out}"), "exclude each other"),
        (("export", "fmu", "--stack", "demo", "-o", "{out}", "--platforms", "vax"), "'vax'"),
        (("export", "fmu", "--stack", "demo", "-o", "{out}", "--name", "1st"), "'1st' cannot"),
        (("export", "fmu", "--stack", "demo", "-o", "{out}", "--fmi", "7"), "--fmi"),
        (("export", "fmu", "--stack", "demo", "-o", "{folder}/no/x.fmu"), "create it first"),
        (("export", "ssp", "--model", "m", "--stack", "demo", "-o", "{out}"), "exclude each other"),
        (("export", "ssp", "--stack", "P-885.51", "--platforms", "vax", "-o", "{out}"), "vax"),
        (("export", "ssp", "--stack", "P-1", "-o", "{folder}/no/x.ssp", "--picture", "w.gif"),
         "3 problems"),
        (("export", "c", "--stack", "demo", "--step", "10", "-o", "{folder}/code"), "unit"),
        (("export", "c", "--step", "10us", "--stack", "demo", "-o", "{bytes}"), "a file of"),
        (("examples", "ci", "-o", "{bytes}"), "cannot be created, there is a file of that"),
        (("datasets", "micromanipulator", "-o", "{bytes}"), "bytes: cannot be created"),
        (("check", "{bytes}"), "cannot be read as an FMU"),
        (("check", "{bytes}", "--timeout", "inf"), "'--timeout'"),
        (("check", "{folder}"), "is a directory"),
        (("diagnose", "{demo}", "--expect", "adquate"), "'adequate'"),
        (("diagnose", "{demo}", "--max-error", "much"), "0.5%"),
        (("diagnose", "{demo}", "-o", "{out}", "--json", "{out}"), "both"),
        (("identify", "{demo}", "--method", "paper", "--model", "{absent}"), "absent.csv"),
        (("identify", "{good}", "-o", "{good}"), "would overwrite an input"),
        (("identify", "{demo}", "--stiffness", "50"), "5e7, which is 50 N/um"),
        (("design", "mechanism", "--stack", "demo", "--damping", "2", "-o", "{out}"), "2"),
        (("design", "mechanism", "--stack", "PTBS200", "--poles", "fast", "-o",
          "{folder}/no/m.json", "--max-stroke-loss", "much"), "3 problems with the input"),
        (("design", "mechanism", "--stack", "demo", "--damping", "0.5", "--max-force", "inf",
          "-o", "{out}"), "The largest force is inf N; give a positive one"),
        (("design", "experiment", "--stack", "demo", "--duration", "1", "--samples", "0",
          "-o", "{out}"), "0 samples hold no experiment"),
        (("effects", "xyzzy"), "current_limit"),
        (("stacks", "P-885"), "P-885.51"),
        (("datasets", "micro"), "micromanipulator"),
        (("effects", "sensor_delay", "--figure", "{folder}/f.txt"),
         "f.txt: --figure writes a picture, .png or .svg or .pdf; name it so."),
        (("batch", "{folder}", "-o", "{out}", "--report", "f.pdf"),
         "f.pdf: --report writes a page, .html or .htm; name it so."),
        (("compare", "a.json", "b.json", "-o", "{folder}/f.pdf"),
         "f.pdf: --output writes a page, .html or .htm; name it so."),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_refused_with_exit_code_2(
    words: tuple[str, ...], message_part: str, tmp_path: Path
) -> None:
    (tmp_path / "bytes").write_bytes(bytes(range(256)))
    (tmp_path / "good").write_bytes((DATA / "demo.csv").read_bytes())
    places = {
        "folder": tmp_path, "out": tmp_path / "out", "bytes": tmp_path / "bytes",
        "absent": tmp_path / "absent.csv", "demo": DATA / "demo.csv", "good": tmp_path / "good",
    }  # fmt: skip
    message = refused(*(w.format(**places) for w in words), folder=tmp_path)
    assert message_part in message
    assert "Errno" not in message


def test_a_message_is_one_sentence_on_stderr_of_a_separate_process(tmp_path: Path) -> None:
    absent = tmp_path / "absent.csv"
    ended = subprocess.run(
        [*PSA, "identify", absent, "-o", tmp_path / "m.json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.splitlines() == [
        f"Error: {absent}: there is no such file; check the name and the directory it is in."
    ]
    assert list(tmp_path.iterdir()) == []


def test_the_machines_fault_ends_with_1_and_leaves_files_as_they_were(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, out = psa.stack_model("demo"), tmp_path / "x.fmu"
    for name in ("ageing", "backlash", "preload_loss", "charge_leakage"):  # compiled by no one else
        model = model.with_effect(psa.EFFECTS[name])
    psa.save_model(model, tmp_path / "m.json")
    out.write_bytes(b"kept")
    monkeypatch.setenv("CC", str(tmp_path / "no_compiler"))
    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path.with_name("empty_cache")))
    text = refused(
        "export", "fmu", "--model", tmp_path / "m.json", "-o", out, code=1, folder=tmp_path
    )
    assert "Failed: The C compiler" in text
    assert str(tmp_path / "no_compiler") in text
    assert out.read_bytes() == b"kept"
    with pytest.raises(psa.MachineError, match="no_compiler"):
        psa.export_fmu(model, out)


def test_mistakes_in_python_are_input_errors_that_list_all() -> None:
    with pytest.raises(psa.InputError) as caught:
        psa.identify(["none.csv", {"t": [0.0]}])
    assert {p.split(":")[0] for p in caught.value.problems} == {"none.csv", "record 2"}
    assert isinstance(caught.value, psa.PsaError)
    assert not issubclass(psa.MachineError, psa.PsaError)
    with pytest.raises(psa.InputError, match="no parameter 'kL'"):
        psa.stack_model("demo").with_values({"kL": 1.0})
    with pytest.raises(psa.InputError, match="outside its bounds"):
        psa.stack_model("demo").with_values({"k_P": -1.0})


@posix
@slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_command_that_is_ended_reports_it_and_leaves_no_half_file(
    number: signal.Signals, tmp_path: Path
) -> None:
    running = subprocess.Popen(
        [*PSA, "diagnose", DATA / "demo.csv", "--report", tmp_path / "page.html"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "TMPDIR": str(tmp_path)},
    )  # fmt: skip
    assert running.stderr is not None
    assert running.stderr.readline()  # it works by now
    running.send_signal(number)
    _, text = running.communicate(timeout=60)
    assert running.returncode == 128 + number
    assert "Traceback" not in text
    assert number != signal.SIGINT or "Interrupted: " in text
    assert list(tmp_path.iterdir()) == []


def test_an_effect_is_drawn_as_a_picture(tmp_path: Path) -> None:
    for ending, starts in (("png", b"\x89PNG"), ("svg", b"<?xml"), ("pdf", b"%PDF")):
        path = tmp_path / f"f.{ending}"
        done("effects", "sensor_delay", "--figure", path, "--quiet")
        assert path.read_bytes().startswith(starts)
    head = (tmp_path / "f.png").read_bytes()[:24]
    width, height = (int.from_bytes(head[k : k + 4], "big") for k in (16, 20))
    assert width >= 800
    assert height >= 400


# --- psa web ---


@posix
def test_the_page_that_diagnoses_answers_to_who_has_its_address_alone(tmp_path: Path) -> None:
    with served(tmp_path) as (place, token):
        guess = f"psa_{place.partition(':')[2]}=guess"
        for path in ("/", "/state", "/report", "/?token=", "/?token=guess", "/files/report.html"):
            assert request(place, "GET", path)[0] == 403
        assert request(place, "POST", "/start")[0] == 403
        assert request(place, "GET", "/", Cookie=guess)[0] == 403
        assert request(place, "GET", f"/?token={token}", Host="psa.example")[0] in (400, 403, 421)
        status, headers, page = request(place, "GET", f"/?token={token}")
        assert status == 200
        policy = headers["content-security-policy"]
        assert {"default-src 'none'", "frame-ancestors 'none'"} <= {*policy.split("; ")}
        assert "unsafe" not in policy
        assert b"http" not in page.replace(b"http://www.w3.org/2000/svg", b"")
        assert "httponly" in headers["set-cookie"].lower()
        assert token.encode() not in page
        cookie, origin = headers["set-cookie"].split(";")[0], f"http://{place}"
        record = b"t (ms),U [V],pos\n" + b"".join(b"%d,%d,%d\n" % (k, k % 50, k) for k in range(99))
        table = {"Cookie": cookie, "X_Name": quote("mine & <b>.csv")}
        for source, statuses in (("http://x.example", {403}), (origin, range(200, 300))):
            answer = request(place, "POST", "/files", record, Origin=source, **table)
            assert answer[0] in statuses
        started, state = time.monotonic(), {}
        while time.monotonic() < started + 30.0:
            state = json.loads(request(place, "GET", "/state", Cookie=cookie)[2])
            if "voltage" in json.dumps(state):
                break
            time.sleep(0.1)
        text = json.dumps(state)
        assert "mine & <b>.csv" in text
        assert '"ms"' in text


@slow
def test_a_playground_holds_every_stack_and_loads_nothing(tmp_path: Path) -> None:
    pytest.importorskip("ziglang")
    done("web", "-o", tmp_path / "page.html", "--quiet")
    text = (tmp_path / "page.html").read_text("utf-8")
    for name in ("P-885.51", "PTBS200", "slow_creep"):
        assert name in text
    assert not re.search(r"(src|href)=[\"']?(https?:)?//", text)
    assert "default-src 'none'" in text
    assert 1e5 < len(text) < 3e6


_MODEL = """
import casadi as ca
import psa_casadi as psa

def make():
    x, u, T, k = (ca.SX.sym(n) for n in ("s", "heater", "T", "k"))
    bounds = (0.1, 100.0)
    return psa.ode_model(
        {"x": x, "u": u, "p": [T, k], "ode": (k * u - x) / T, "y": x}, name="oven",
        inputs=[psa.Input("heater", "W", "heating power")],
        outputs=[psa.Output("warmth", "K", "above the room")],
        parameters=[
            psa.Parameter("T", 3.0, "s", bounds, "time constant", log=True),
            psa.Parameter("k", 1.0, "K/W", bounds, "gain", log=True),
        ],
    )
"""


_SCALE = """
import psa_casadi as psa

BENT_SCALE = psa.Component(
    "bent_scale", "the scale of the thermometer is bent", "a parabola",
    lambda s: psa.Equations(add={"shown_warmth": s.bend * s.true_warmth**2}),
    parameters=(psa.Parameter("bend", 0.0, "1/K", (-0.1, 0.1), "curvature", scale=1e-3),),
    gain="bend", belongs_to="sensor",
)
"""


def _oven(folder: Path) -> tuple[Path, Path, list[str]]:
    """Write a user's model, and a record whose sensor is bent, in other units.

    Return their paths, and the options of a command that fits the one to the other.
    """
    model, record = folder / "oven.py", folder / "oven.csv"
    model.write_text(_MODEL, encoding="utf-8")
    rng, step = np.random.default_rng(1), 0.1
    power = np.repeat(rng.choice([0.0, 10.0, 20.0, 40.0], 60), 20)
    warmth, x = np.zeros(power.size), 0.0
    for k in range(power.size):  # exact for a held power
        warmth[k] = x
        x = 2.0 * power[k] + (x - 2.0 * power[k]) * np.exp(-step / 5.0)
    reading = warmth + 2e-3 * warmth**2 + 0.05 * rng.standard_normal(power.size)
    time = np.arange(power.size, dtype=np.float64) * step / 60.0
    write(record, {"Time [min]": time, "heater [kW]": 1e-3 * power, "Warmth [mK]": 1e3 * reading})
    return model, record, f"--model {model}:make --hold zero --known-start".split()


def test_a_users_model_is_identified_and_diagnosed_on_the_command_line(
    tmp_path: Path,
) -> None:
    _, record, arguments = _oven(tmp_path)
    fit, page, result = (tmp_path / n for n in ("fit.html", "page.html", "diagnosis.json"))
    values, both = tmp_path / "values.json", tmp_path / "both.html"
    text = done("identify", record, *arguments, "--report", fit, "--json", values).out
    assert "identified 'oven'" in text
    assert "'warmth' is missed by" in text
    assert "oven" in fit.read_text("utf-8")
    kept = tmp_path / "extended.json"
    left_out = ("--leave-out", "delay", "--leave-out", "satur")
    words = ("--report", page, "--json", result, *left_out, "-o", kept)
    text = done("diagnose", record, *arguments, *words, "--expect", "cause_named").out
    assert "cause named" in text
    export = f"psa export fmu --model {kept} -o {kept.with_suffix('.fmu')}"
    assert export in page.read_text("utf-8")
    text = done(*export.split()[1:]).out
    assert "evidence: none; models of one's own carry none" in text
    content = json.loads(result.read_text("utf-8"))
    assert [cause["effect"] for cause in content["causes"]] == ["bend_of_warmth"]
    assert content["values"]["T"] == pytest.approx(5.0, rel=0.01)
    (row,) = json.loads(values.read_text("utf-8"))["records"]
    assert (row["output"], row["unit"], row["samples"]) == ("warmth", "K", 1200)
    done("compare", values, result, "-o", both)
    assert "values" in both.read_text("utf-8")
    (tmp_path / "records").mkdir()
    (tmp_path / "records" / "one.csv").write_bytes(record.read_bytes())
    batch = ("batch", tmp_path / "records", "-o", tmp_path / "out", "--workers", "1")
    assert "1 devices: 1 done." in done(*batch, *arguments).out
    one = json.loads((tmp_path / "out" / "one" / "identification.json").read_text("utf-8"))
    assert one["parameters"] == json.loads(values.read_text("utf-8"))["parameters"]
    assert dict(psa.load_model(kept).values) == content["values"]
    assert page.read_text("utf-8").startswith("<!DOCTYPE html>")
    ended = command("diagnose", record, *arguments, *words, "--expect", "adequate")
    assert ended.code == 1
    assert "The verdict is cause_named; expected adequate." in ended.words


def test_a_users_effects_are_searched_in_a_users_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An effect at a port of the model, which fits no stack."""
    monkeypatch.chdir(tmp_path)
    _, record, arguments = _oven(tmp_path)
    Path("scale.py").write_text(_SCALE, encoding="utf-8")
    result = tmp_path / "diagnosis.json"
    arguments += ["--effects", "scale", "--leave-out", "bend"]
    done("diagnose", record, *arguments, "--json", result)
    content = json.loads(result.read_text("utf-8"))
    assert [cause["effect"] for cause in content["causes"]] == ["bent_scale"]
    text = refused("diagnose", record, "--effects", "scale")
    assert "no symbol named 'true_warmth'" in text


def test_what_a_users_model_does_not_have_is_refused(tmp_path: Path) -> None:
    model, record, arguments = _oven(tmp_path)
    text = refused("identify", record, *arguments, "--profile", "T", "--columns", "warmth=w")
    assert "--profile does not apply to your model" in text
    assert "'w', which --columns names for 'warmth', is not in the header" in text
    assert "oven.py has no function 'mak'" in refused("diagnose", record, "--model", f"{model}:mak")
    text = refused("diagnose", record, "--model", model)
    assert "say which function of" in text
    assert "it has 'make', as" in text
    assert "there is no file" in refused("diagnose", record, "--model", "none.py:make")
    text = refused("identify", record, "--hold", "zero")
    assert "--hold applies to your model; add --model FILE.py:FUNCTION." in text
    (tmp_path / "bad.py").write_text("1 / 0", encoding="utf-8")
    text = refused("identify", record, "--model", tmp_path / "bad.py")
    assert "bad.py cannot make a model (ZeroDivisionError: division by zero)" in text
