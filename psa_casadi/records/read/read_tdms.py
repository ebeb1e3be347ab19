"""The channels of TDMS files, which LabVIEW writes, with units and time as they are stated."""

import io
import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from psa_casadi.errors import InputError
from psa_casadi.records.read.arrays import Array, collected, series
from psa_casadi.records.read.file_bytes import check_size, reason_of


def tdms_arrays(path: str, data: bytes) -> dict[str, Array]:
    """Return the channels of a TDMS file by their names, and the `time` of their waveforms.

    Where groups have channels of the same name, the name is `group.channel`.

    Raises:
        InputError: the file is no TDMS file, is damaged or states more values than it holds, or
            npTDMS is not installed.
    """
    try:
        # an optional dependency, needed for these files only
        import nptdms  # noqa: PLC0415
        from nptdms.log import log_manager  # noqa: PLC0415
    except ImportError:
        raise InputError(
            f"{path}: reading TDMS needs npTDMS, which is not installed; run "
            f"`pip install 'psa-casadi[tdms]'`, or export the record as CSV."
        ) from None
    log_manager.set_level(logging.CRITICAL)  # it tells of damage on the terminal
    try:
        with nptdms.TdmsFile.open(io.BytesIO(data)) as file:
            channels = [c for group in file.groups() for c in group.channels()]
            numeric = [c for c in channels if c.dtype.kind in "biuf"]
            _check_held(path, sum(len(c) * c.dtype.itemsize for c in numeric), len(data))
            return collected(_named(numeric))
    except InputError:
        raise
    except Exception as error:  # npTDMS may raise anything on a damaged file
        raise InputError(
            f"{path}: is no readable TDMS file ({reason_of(error)}); save it again, or export the"
            " record as CSV."
        ) from error


def _check_held(path: str, stated: int, size: int) -> None:
    """Refuse a file that states more numbers than it has bytes for: none are packed."""
    check_size(path, stated, "its channels hold")
    if stated > size:
        raise ValueError(f"it states {stated} bytes of numbers and has {size}")


def _named(channels: list[Any]) -> Iterator[tuple[str, Array]]:
    names = [c.name for c in channels]
    waves = []
    for channel in channels:
        twice = names.count(channel.name) > 1
        name = f"{channel.group_name}.{channel.name}" if twice else channel.name
        values = np.asarray(channel[:])
        yield from series(name, values, channel.properties.get("unit_string"))
        step = channel.properties.get("wf_increment")
        if isinstance(step, float | int) and step > 0 and values.size:
            waves.append((float(channel.properties.get("wf_start_offset", 0.0)), step, values.size))
    if waves and len(set(waves)) == 1:
        first, step, count = waves[0]
        yield "time", Array(first + step * np.arange(count), "s")
