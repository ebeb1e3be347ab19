"""Records of the exam with no cause, with two, or with one that the package does not list."""

from tests.studies.exam.record import Record, Stack, Test, names

#: Stacks as they are, of six kinds of hysteresis.
CLEAN = (
    Record(
        "c01",
        1000,
        "nothing",
        Stack("Bouc-Wen", 60, lag=0.0005, bouc_wen=(-0.3, 11, 0.1, 1.0, 0.01)),
        Test("decaying sine", 4, 1000, 4000, (-100, 100), 0.1),
    ),
    Record(
        "c02",
        1017,
        "nothing",
        Stack("Bouc-Wen", 38, bouc_wen=(-0.35, 6, 0.2, 1.4, 0.02)),
        Test("triangle", 10, 4000, 4000, (0, 120), 0.05, colour=0.5),
    ),
    Record(
        "c03",
        1034,
        "nothing",
        Stack(
            "Bouc-Wen",
            15,
            lag=0.00015,
            mechanics=(2100.0, 0.03, 6400.0, 0.04),
            bouc_wen=(-0.25, 6, 0, 1, 0),
        ),
        Test("multisine", 40, 20000, 6000, (0, 100), 0.2, steps=8),
    ),
    Record(
        "c04",
        1051,
        "nothing",
        Stack("Bouc-Wen", 90, strain_lag=0.02),
        Test("staircase", 1, 200, 3000, (0, 150), 0.08),
    ),
    Record(
        "c05",
        1068,
        "nothing",
        Stack("Preisach", 95),
        Test("reversal curves", 0.5, 200, 6000, (0, 150), 0.1),
    ),
    Record(
        "c06",
        1085,
        "nothing",
        Stack("Prandtl-Ishlinskii", 30),
        Test("decaying sine", 5, 1500, 5000, (-30, 120), 0.1),
    ),
    Record(
        "c07",
        1102,
        "nothing",
        Stack("Coleman-Hodgdon", 20),
        Test("random reversals", 6, 800, 6000, (0, 100), 0.15),
    ),
    Record(
        "c08",
        1119,
        "nothing",
        Stack("Preisach", 40),
        Test("sweep from lowest", 1, 2000, 6000, (0, 120), 0.1),
    ),
    Record(
        "c09",
        1136,
        "nothing",
        Stack("relays", 38),
        Test("triangles", 5, 1000, 4000, (-20, 130), 0.1),
    ),
    Record(
        "c10",
        1153,
        "nothing",
        Stack("Duhem", 70),
        Test("growing sine", 2, 500, 4000, (-150, 150), 0.1, colour=0.4),
    ),
)

#: Two causes in one record.
TWO_CAUSES = (
    Record(
        "t01",
        1714,
        "log creep + ripple",
        Stack("Bouc-Wen", 60),
        Test("staircase", 0.6, 150, 4000, (0, 120), 0.12),
        {"log creep": (0.01, 0.05), "ripple": (0.003, 5.3, 0.2)},
        (
            names("slow_creep"),
            names("sensor_ripple"),
        ),
    ),
    Record(
        "t02",
        1731,
        "backlash + hum",
        Stack("Bouc-Wen", 30),
        Test("triangles", 4, 1000, 5000, (0, 100), 0.12),
        {"play": (0.005,), "hum": (49.97, 0.0025)},
        (
            names("backlash"),
            names("mains_hum"),
        ),
    ),
    Record(
        "t03",
        1748,
        "drift + stiffening load",
        Stack("Bouc-Wen", 38),
        Test("random reversals", 1, 100, 5000, (-20, 120), 0.15),
        {"drift": (0.012, 0.4), "stiffening load": (0.012, 0.4)},
        (
            names("offset_drift"),
            names("load_stiffness", "sensor_nonlinearity"),
        ),
    ),
    Record(
        "t04",
        1765,
        "voltage saturation + sensor delay",
        Stack("Bouc-Wen", 90),
        Test("growing sine", 3, 600, 5000, (0, 150), 0.12),
        {"output limit": (0.97,), "delay": (0.0015,)},
        (
            names("voltage_saturation"),
            names("sensor_delay", "sensor_lag", "drive_lag"),
        ),
    ),
    Record(
        "t05",
        1782,
        "structural mode + delay",
        Stack("Bouc-Wen", 15, lag=0.00015, mechanics=(3400.0, 0.03, 9000.0, 0.04)),
        Test("multisine", 25, 12000, 6000, (0, 90), 0.2, steps=10),
        {"mode": (610.0, 0.03, 0.02), "delay": (9e-05,)},
        (
            names("structural_mode"),
            names("sensor_delay"),
        ),
    ),
    Record(
        "t06",
        1799,
        "log creep + preload",
        Stack("Bouc-Wen", 32),
        Test("staircase", 1, 200, 5000, (0, 100), 0.12),
        {"log creep": (0.012, 0.05), "contact": (0.05, 0.5, 0.01)},
        (
            names("slow_creep"),
            names("preload_loss"),
        ),
    ),
)

#: Causes that the package does not list; the names are what comes nearest, if anything does.
FOREIGN = (
    Record(
        "f01",
        1816,
        "amplitude-dependent damping",
        Stack("Bouc-Wen", 15, lag=0.0001, mechanics=(1600.0, 0.01, 9000.0, 0.05)),
        Test("steps", 80, 30000, 6000, (0, 100), 0.2, steps=6),
        {"amplitude damping": (0.8,)},
    ),
    Record(
        "f02",
        1833,
        "stick-slip bursts",
        Stack("Bouc-Wen", 40),
        Test("triangles", 3, 600, 5000, (0, 120), 0.1),
        {"stick-slip": (0.004, 14.0)},
    ),
    Record(
        "f03",
        1850,
        "sensor gain drifts",
        Stack("Bouc-Wen", 45),
        Test("decaying sine", 2, 300, 4500, (-100, 100), 0.12),
        {"gain drift": (0.07,)},
        (names("ageing"),),
    ),
    Record(
        "f04",
        1867,
        "bursts of interference",
        Stack("Bouc-Wen", 20),
        Test("triangle", 4, 1000, 5000, (0, 100), 0.1),
        {"interference": (0.012, 25.0)},
    ),
    Record(
        "f05",
        1884,
        "second device coupled in",
        Stack("Bouc-Wen", 38),
        Test("decaying sine", 3, 600, 4500, (0, 120), 0.12),
        {"second device": (0.006, 0.61)},
    ),
    Record(
        "f06",
        1901,
        "mistuned controller, reference recorded",
        Stack("Bouc-Wen", 20, lag=0.0004),
        Test("triangle", 12, 4000, 6000, (10, 90), 0.12, steps=10),
        {"controller": (0.15, 380.0, 0.0016)},
        (names("drive_lag"),),
    ),
    Record(
        "f07",
        1918,
        "sample clock drift",
        Stack("Bouc-Wen", 38),
        Test("multisine", 2, 800, 5000, (0, 120), 0.12),
        {"clock": (0.00012,)},
    ),
    Record(
        "f08",
        1935,
        "floor vibration (narrow band)",
        Stack("Bouc-Wen", 38),
        Test("random reversals", 3, 300, 5000, (0, 120), 0.15),
        {"floor vibration": (17.0, 0.01, 0.0025)},
        (names("mains_hum"),),
    ),
    Record(
        "f09",
        1952,
        "sensor offset steps at an instant",
        Stack("Bouc-Wen", 50),
        Test("decaying sine", 2, 400, 4000, (-100, 100), 0.12),
        {"offset step": (0.008, 0.57)},
        (names("offset_drift"),),
    ),
)
