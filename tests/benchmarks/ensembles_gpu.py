"""The rows of a GPU in the benchmark `ensembles`, where there is one."""

import time
from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.model.compose import Model
from psa_casadi.records import Record
from psa_casadi.report.words.phrases import number
from psa_casadi.report.words.tables import Table
from psa_casadi.simulation.device import run as device
from psa_casadi.simulation.many import simulate_many
from tests.benchmarks.outcome import Progress, TitledTable

#: Sets on the GPU for each one on the cores, and those whose ranges are compared.
MORE, _COMPARED = 100, 64
_HEAD = (
    "voltage", "sets", "samples", "tolerance", "largest difference of a range from the cores'",
    "wall [s]", "ns per sample and set",
)  # fmt: skip
_NOTE = (
    "One set a thread of {}; of each set the range is kept, on the device. The starts of the sets"
    " are in the times, compiling is not."
)


def on_gpu(
    progress: Progress,
    model: Model,
    records: Sequence[tuple[Record, float]],
    draw: Callable[[int], list[dict[str, float]]],
    count: int,
) -> tuple[tuple[TitledTable, ...], str]:
    """Return a table of `count` drawn sets under records with their tolerances, or why not."""
    try:
        cupy = device.device_module()
    except InputError as error:
        return (), f" No rows of a GPU: {error}"
    sets, rows = draw(count), []
    columns = {name: np.array([values[name] for values in sets]) for name in sets[0]}
    for record, rtol in records:
        progress(f"{record.name}: GPU, {count} sets")
        keep = partial(simulate_many, model, record=record, rtol=rtol, reduce="range")
        ours = keep(sets[:_COMPARED])
        keep(sets[:_COMPARED], device="cuda")  # compiles
        begin = time.perf_counter()
        found = keep(columns, device="cuda")
        wall = time.perf_counter() - begin
        apart = np.max(np.abs(found[: len(ours)] - ours) / ours)
        rows.append((
            record.name, str(count), str(record.n), f"{rtol:.0e}", f"{apart:.1e}",
            number(wall), number(1e9 * wall / count / record.n),
        ))  # fmt: skip
    name = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode()
    table = Table(_HEAD, tuple(rows))
    return (TitledTable("Many sets on a GPU", table, _NOTE.format(name)),), ""
