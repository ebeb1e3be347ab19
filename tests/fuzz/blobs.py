"""States of FMUs as bytes: damaged ones are refused or harmless, and the instance goes on."""

import ctypes
import struct
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random

from psa_casadi.export.importer.fmu import CO_SIMULATION, MODEL_EXCHANGE, Fmu, FmuError, Instance
from tests.fmu_models import exported
from tests.fuzz.mutators import damaged_bytes
from tests.fuzz.target import FALSE_PASS, Found, Target

ROOM = "blobs"
_STACKS = ("P-885.51", "every_effect")
_KINDS = tuple(
    (name, fmi, kind)
    for name in _STACKS
    for fmi in (2, 3)
    for kind in (CO_SIMULATION, MODEL_EXCHANGE)
)
_STEP = 1e-5
#: Numbers that a state may not hold, and some that it may.
_NUMBERS = (float("nan"), float("inf"), -1e308, 1e308, 5e-324, -0.0, 1e30, 1.0, 2.0**63)


@cache
def _fmu(name: str, fmi: int) -> Fmu:
    return Fmu(exported(name, fmi))


@cache
def _instance(name: str, fmi: int, kind: int) -> tuple[Instance, bytes]:
    """Return an instance some steps after its start, and its state there."""
    instance = _fmu(name, fmi).start(kind)
    for k in range(5 if kind == CO_SIMULATION else 0):
        instance.set({"voltage": 10.0 * k})
        instance.step(k * _STEP, _STEP)
    snapshot = instance.save()
    data = instance.serialize(snapshot)
    instance.drop(snapshot)
    return instance, data


def _load_all() -> None:
    for kind in _KINDS:
        _instance(*kind)


def _blob(rng: Random) -> bytes:
    """Return the number of a kind and its damaged state; half of them with the right checksum."""
    number = rng.randrange(len(_KINDS))
    _, data = _instance(*_KINDS[number])
    if rng.random() < 0.5:
        return bytes([number]) + damaged_bytes(data, rng, (b"psasnap\0",))
    state = bytearray(data[32:])
    for _ in range(rng.choice((1, 1, 2, 8))):
        place = 8 * rng.randrange(len(state) // 8)
        whole = rng.choice((0, 1, 2, 3, 255, -1, 2**31, 2**62))
        word = struct.pack("<d", rng.choice(_NUMBERS)), struct.pack("<q", whole), rng.randbytes(8)
        state[place : place + 8] = rng.choice(word)
    head = bytearray(data[:24]) + struct.pack("<Q", _checksum(bytes(state)))
    return bytes([number]) + bytes(head) + bytes(state)


def _checksum(data: bytes) -> int:
    """Return FNV-1a of 64 bits, as snapshot.c computes it."""
    value = 14695981039346656037
    for byte in data:
        value = (value ^ byte) * 1099511628211 % 2**64
    return value


def _take(data: bytes, _: Path) -> Iterator[Found]:
    instance, sound = _instance(*_KINDS[data[0]])
    blob = data[1:]
    before = _outputs(instance, sound)
    try:
        snapshot = instance.deserialize(blob)
    except FmuError:
        taken = False
    else:
        taken = True
        if struct.unpack_from("<Q", blob, 24)[0] != _checksum(blob[32:]):
            yield Found(FALSE_PASS, "a state with a wrong checksum is taken")
        _go_on(instance, snapshot)
    if _outputs(instance, sound) != before:
        yield Found(FALSE_PASS, "after a damaged state, a sound one does not give the same outputs")
    if not taken:
        raise FmuError("the state is refused")


def _go_on(instance: Instance, snapshot: ctypes.c_void_p) -> None:
    """Step from a state that was taken; an error that the FMU tells is right."""
    try:
        instance.restore(snapshot)
        names = instance.fmu.names("output")
        if instance.interface == CO_SIMULATION:
            instance.set({"voltage": 20.0})
            instance.step(float(instance.get(["time"])[0]), _STEP)
        else:
            instance.vector(instance.derivatives_function, len(instance.fmu.states()))
        instance.get(names)
    except FmuError:
        pass
    finally:
        instance.drop(snapshot)


def _outputs(instance: Instance, data: bytes) -> bytes:
    snapshot = instance.deserialize(data)
    instance.restore(snapshot)
    instance.drop(snapshot)
    return instance.get(instance.fmu.names("output")).tobytes()


TARGETS = (Target("states", ROOM, ".blob", _blob, _take, 1.0, prepare=_load_all),)
