"""All records of the exam, as a table.

A record is its name and what it hides, its stack, its test, the hidden causes with their
values, and the names that are right for each of them. Stack: hysteresis, stroke, and what is not
usual. Test: voltage, frequency, rate, samples, lowest and highest voltage, noise, and what is not
usual. Names: `c` clean stacks of six kinds of hysteresis, `k` what the package lists, in other
forms, `t` two causes, `f` what the package does not list, with names and families of what comes
nearest.
"""

from typing import Any

from tests.studies.exam.record import Record, Stack, Test

_TABLE = """
c01 nothing | Bouc-Wen 60 lag=0.0005 bouc_wen=-0.3,11,0.1,1,0.01
    | decaying sine 4 1000 4000 -100 100 0.1
c02 nothing | Bouc-Wen 38 bouc_wen=-0.35,6,0.2,1.4,0.02
    | triangle 10 4000 4000 0 120 0.05 colour=0.5
c03 nothing | Bouc-Wen 15 lag=0.00015 mechanics=2100,0.03,6400,0.04 bouc_wen=-0.25,6,0,1,0
    | multisine 40 20000 6000 0 100 0.2 steps=8
c04 nothing | Bouc-Wen 90 strain_lag=0.02 | staircase 1 200 3000 0 150 0.08
c05 nothing | Preisach 95 | reversal curves 0.5 200 6000 0 150 0.1
c06 nothing | Prandtl-Ishlinskii 30 | decaying sine 5 1500 5000 -30 120 0.1
c07 nothing | Coleman-Hodgdon 20 | random reversals 6 800 6000 0 100 0.15
c08 nothing | Preisach 40 | sweep from lowest 1 2000 6000 0 120 0.1
c09 nothing | relays 38 | triangles 5 1000 4000 -20 130 0.1
c10 nothing | Duhem 70 | growing sine 2 500 4000 -150 150 0.1 colour=0.4
k01 log creep | Bouc-Wen 45 | staircase 0.5 100 4000 0 120 0.12 | log creep 0.011 0.02 | slow_creep
k02 fractional creep | Prandtl-Ishlinskii 30 | staircase 0.4 100 3500 0 100 0.1
    | power creep 0.05 0.22 | slow_creep
k03 guide that sticks (Dahl) | Bouc-Wen 50 | decaying sine 2 400 4000 -100 100 0.15
    | guide friction 0.02 0.05 | backlash, hysteresis_memory
k04 backlash | Bouc-Wen 20 | triangles 5 1000 4000 0 100 0.15 | play 0.006 | backlash
k05 self-heating | Bouc-Wen 32 | bursts 30 600 7200 0 100 0.15 steps=10
    | self heating 0.16 1.3 | self_heating
k06 charge leakage | Bouc-Wen 40 | staircase 1.5 300 4500 0 100 0.15 | leakage 50 | charge_leakage
k07 slew limit | Bouc-Wen 15 lag=0.0003 mechanics=3100,0.12,9000,0.1
    | steps 60 20000 4000 0 100 0.3 steps=10 | slew limit 200000 | current_limit
k08 current limit | Bouc-Wen 38 lag=0.00025 mechanics=5000,0.05,16000,0.05
    | growing sine 90 10000 5000 0 120 0.2 | current limit 29000 | current_limit
k09 output saturation | Bouc-Wen 30 | growing sine 3 600 4000 0 120 0.15
    | output limit 0.965 | voltage_saturation
k10 amplifier lag 2nd order | Bouc-Wen 22 lag=0.0003 mechanics=4200,0.03,13000,0.04
    | sweep 8 8000 6000 20 100 0.15 | amplifier lag 900 0.55 | drive_lag
k11 amplifier dead time | Bouc-Wen 22 lag=0.0002 mechanics=2400,0.03,8000,0.04
    | multisine 20 8000 5000 0 100 0.2 steps=10 | dead time 0.00018 | drive_lag, sensor_delay
k12 amplifier nonlinearity (with monitor) | Bouc-Wen 45
    | decaying sine 3 500 4000 -100 100 0.15 monitor=1
    | amplifier gain 0.02 -0.015 | amplifier_nonlinearity
k13 amplifier nonlinearity (no monitor) | Bouc-Wen 45 | triangles 4 800 4000 0 130 0.12
    | amplifier gain 0 -0.05 | saturation_of_strain, field_dependent_gain
k14 sensor lag | Bouc-Wen 28 lag=0.0004 mechanics=3300,0.02,11000,0.03
    | sweep 5 10000 6000 10 110 0.15 | sensor lag 0.00025 | sensor_lag
k15 sensor delay | Bouc-Wen 12 lag=0.0002 mechanics=2800,0.025,9000,0.04
    | multisine 30 12000 5000 0 90 0.2 steps=10 | delay 8e-05 | sensor_delay
k16 sensor bend | Bouc-Wen 70 | decaying sine 2 400 4000 -80 120 0.12
    | bend 0.03 0.06 | sensor_nonlinearity, load_stiffness
k17 interpolation error | Bouc-Wen 12 | triangles 1 300 6000 0 100 0.15
    | ripple 0.0025 0.633 0.3 | sensor_ripple
k18 sensor drift | Bouc-Wen 40 | random reversals 2 200 5000 0 120 0.2
    | drift 0.012 0.5 | offset_drift
k19 load stiffens exp | Bouc-Wen 80 | reversal curves 0.8 300 5000 0 150 0.12
    | stiffening load 0.007 0.35 | sensor_nonlinearity, load_stiffness
k20 preload contact | Bouc-Wen 38 | triangles 4 800 4000 0 120 0.12
    | contact 0.06 0.55 0.012 | preload_loss
k21 structural mode | Bouc-Wen 12 lag=0.00015 mechanics=3900,0.03,12000,0.04
    | sweep 20 15000 6000 20 90 0.2 | mode 740 0.02 0.01 | structural_mode
k22 mains hum, 50 and 150 Hz | Bouc-Wen 50 | decaying sine 3 1000 4000 -50 150 0.15
    | hum 50.02 0.0025 150.06 0.001 | mains_hum
k23 hysteresis that depends on the rate | Prandtl-Ishlinskii 30 lag=0.0002
    | rates 1 1500 6000 0 100 0.12 | growing thresholds 0.009 | rate_dependent_hysteresis
k24 ageing | Bouc-Wen 40 | triangle 8 800 8000 -40 140 0.15 | ageing 0.012 | ageing
k25 temperature | Bouc-Wen 38 | random reversals 1 100 4000 0 120 0.15
    | temperature 0.002 0.0015 | temperature
k26 strain saturation (Langevin) | Bouc-Wen 70 | decaying sine 5 1000 3000 -150 150 0.12
    | strain saturation 2.6 | saturation_of_strain
k27 field-dependent gain | Bouc-Wen 33 | growing sine 4 800 4000 -100 100 0.12
    | field gain 0.05 | field_dependent_gain
k28 reciprocal two-mass | Bouc-Wen 15 lag=0.00012 mechanics=2200,0.03,5600,0.03
    | multisine 60 30000 6000 0 100 0.2 steps=8 | reciprocal masses 0.15 | reciprocal_coupling
k29 branch asymmetry | Bouc-Wen 30 | decaying sine 2 400 4000 0 120 0.12
    | asymmetry 0.1 | hysteresis_memory, rate_independent_asymmetry
k30 sensor delay | Preisach 60 | multisine 20 8000 5000 0 150 0.12
    | delay 0.00022 | sensor_lag, drive_lag, sensor_delay
k31 log creep | Preisach 60 | random reversals 0.6 60 5000 0 120 0.12
    | log creep 0.012 0.1 | slow_creep
k32 ripple | Coleman-Hodgdon 45 | decaying sine 3 600 4000 -100 100 0.12
    | ripple 0.003 3.1 0 | sensor_ripple
t01 log creep + ripple | Bouc-Wen 60 | staircase 0.6 150 4000 0 120 0.12
    | log creep 0.01 0.05; ripple 0.003 5.3 0.2 | slow_creep; sensor_ripple
t02 backlash + hum | Bouc-Wen 30 | triangles 4 1000 5000 0 100 0.12
    | play 0.005; hum 49.97 0.0025 | backlash; mains_hum
t03 drift + stiffening load | Bouc-Wen 38 | random reversals 1 100 5000 -20 120 0.15
    | drift 0.012 0.4; stiffening load 0.012 0.4 | offset_drift; sensor_nonlinearity, load_stiffness
t04 voltage saturation + sensor delay | Bouc-Wen 90 | growing sine 3 600 5000 0 150 0.12
    | output limit 0.97; delay 0.0015 | voltage_saturation; sensor_lag, drive_lag, sensor_delay
t05 structural mode + delay | Bouc-Wen 15 lag=0.00015 mechanics=3400,0.03,9000,0.04
    | multisine 25 12000 6000 0 90 0.2 steps=10
    | mode 610 0.03 0.02; delay 9e-05 | structural_mode; sensor_delay
t06 log creep + preload | Bouc-Wen 32 | staircase 1 200 5000 0 100 0.12
    | log creep 0.012 0.05; contact 0.05 0.5 0.01 | slow_creep; preload_loss
f01 amplitude-dependent damping | Bouc-Wen 15 lag=0.0001 mechanics=1600,0.01,9000,0.05
    | steps 80 30000 6000 0 100 0.2 | amplitude damping 0.8 | plant damping, plant resonance
f02 stick-slip bursts | Bouc-Wen 40 | triangles 3 600 5000 0 120 0.1 | stick slip 0.004 14
    | plant hysteresis
f03 sensor gain drifts | Bouc-Wen 45 | decaying sine 2 300 4500 -100 100 0.12
    | gain drift 0.07 | ageing, sensor changing gain
f04 bursts of interference | Bouc-Wen 20 | triangle 4 1000 5000 0 100 0.1 | interference 0.012 25
    | environment time, sensor time
f05 second device coupled in | Bouc-Wen 38 | decaying sine 3 600 4500 0 120 0.12
    | second device 0.006 0.61 | environment time, plant time, sensor time
f06 mistuned controller, reference recorded | Bouc-Wen 20 lag=0.0004
    | triangle 12 4000 6000 10 90 0.12 steps=10 | controller 0.15 380 0.0016 | drive_lag
f07 sample clock drift | Bouc-Wen 38 | multisine 2 800 5000 0 120 0.12 | clock 0.00012
    | sensor lag, recorder lag
f08 floor vibration (narrow band) | Bouc-Wen 38 | random reversals 3 300 5000 0 120 0.15
    | floor vibration 17 0.01 0.0025 | mains_hum, sensor time
f09 sensor offset steps at an instant | Bouc-Wen 50 | decaying sine 2 400 4000 -100 100 0.12
    | offset step 0.008 0.57 | offset_drift
"""


def _parted(cell: str) -> tuple[str, list[float], dict[str, Any]]:
    """Return the words, the numbers and the named values of a cell."""
    words: list[str] = []
    numbers: list[float] = []
    named: dict[str, Any] = {}
    for word in cell.split():
        name, equals, value = word.partition("=")
        if equals:
            values = tuple(map(float, value.split(",")))
            named[name] = values if len(values) > 1 else values[0]
        elif word.lstrip("-")[0].isdigit():
            numbers.append(float(word))
        else:
            words.append(word)
    return " ".join(words), numbers, named


def _record(place: int, row: str) -> Record:
    about, stack, test, *more = (cell.strip() for cell in row.split("|"))
    name, states = about.split(" ", 1)
    causes, accepted = (cell.split(";") if cell else [] for cell in (*more, "", "")[:2])
    hysteresis, (stroke,), rare = _parted(stack)
    voltage, (frequency, rate, samples, low, high, noise), unusual = _parted(test)
    unusual["steps"] = int(unusual.get("steps", Test.steps))
    hidden = {cause: tuple(values) for cause, values, _ in map(_parted, causes)}
    return Record(
        name, 1000 + 17 * place, states,
        Stack(hysteresis, stroke, **rare),  # type: ignore[arg-type]
        Test(voltage, frequency, rate, int(samples), (low, high), noise, **unusual), hidden,
        tuple(frozenset(one.strip() for one in names.split(",")) for names in accepted),
    )  # fmt: skip


RECORDS: tuple[Record, ...] = tuple(
    _record(place, row)
    for place, row in enumerate(_TABLE.strip().replace("\n    ", " ").splitlines())
)
