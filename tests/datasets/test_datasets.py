"""Public records: downloaded or from a folder, exactly as published; one axis of several."""

import hashlib
import http.server
import io
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from build_scripts.measured_data import measured_data_directory
from psa_casadi import datasets
from psa_casadi.cli.app import app
from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.common.units import FloatArray
from psa_casadi.datasets import DATA_VARIABLE, DATASETS, Dataset
from psa_casadi.datasets.devices import Columns, OneAxis, linear_response

TABLE = "".join(f"{k:.6f}\t9.000000\t{k * 1.8:.6f}\t{-0.5 * k:.6f}\r\n" for k in range(40)).encode()
#: Makes a dataset of a table at an address.
Publish = Callable[[str, bytes], Dataset]
PART = Columns(first_row=3, rows=20, voltage=2, displacement=3, sample_rate=200.0)


def psa(*arguments: str | Path) -> tuple[int, str]:
    result = CliRunner().invoke(app, ["datasets", *map(str, arguments)])
    return result.exit_code, result.stdout


@pytest.fixture
def served(tmp_path: Path) -> Iterator[str]:
    """Address of a server of this machine that publishes TABLE as `table.dat`."""
    folder = tmp_path / "published"
    folder.mkdir()
    (folder / "table.dat").write_bytes(TABLE)

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:
            """Say nothing."""

    handler = partial(Quiet, directory=str(folder))
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}/table.dat"
    server.shutdown()
    server.server_close()


@pytest.fixture
def publish(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Publish:
    """Return what makes a dataset `small` of TABLE, or of what is supposed to be published."""
    monkeypatch.delenv(DATA_VARIABLE, raising=False)
    monkeypatch.setenv("PSA_CASADI_CACHE", str(tmp_path / "cache"))
    for proxy in ("http_proxy", "HTTP_PROXY", "all_proxy", "ALL_PROXY"):
        monkeypatch.delenv(proxy, raising=False)
    monkeypatch.setenv("no_proxy", "127.0.0.1")

    def make(url: str, table: bytes) -> Dataset:
        first = DATASETS["micromanipulator"].files[0]
        original = replace(first.originals[0], name="table.dat", url=url, sha256=sha(table))
        csv = sha(PART.csv([TABLE]))
        file = replace(first, name="part.csv", sha256=csv, originals=(original,), conversion=PART)
        small = replace(DATASETS["micromanipulator"], name="small", files=(file,))
        monkeypatch.setitem(DATASETS, "small", small)
        return small

    return make


def sha(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_a_table_becomes_a_record(served: str, publish: Publish, tmp_path: Path) -> None:
    publish(served, TABLE)
    (record,) = datasets.load("small")
    k = np.arange(3, 23)
    assert record.displacement is not None
    np.testing.assert_allclose(record.time, (k - 3) / 200.0, rtol=1e-12)
    np.testing.assert_allclose(record.voltage, k * 1.8, rtol=1e-12)
    np.testing.assert_allclose(record.displacement, -0.5e-6 * k, rtol=1e-12)
    assert record.sha256 == DATASETS["small"].files[0].sha256
    assert datasets.originals("small")["table.dat"].read_bytes() == TABLE
    assert Path(record.source).is_relative_to(tmp_path / "cache")


def test_another_file_than_the_published_one_is_refused(
    served: str, publish: Publish, tmp_path: Path
) -> None:
    publish(served, TABLE + b"more")
    with pytest.raises(PsaError, match=r"is not the published file, its SHA-256 differs from"):
        datasets.load("small")
    assert not list((tmp_path / "cache").rglob("*.csv"))


def test_no_network_and_no_such_page_are_reported(served: str, publish: Publish) -> None:
    for url in (served.replace("table", "absent"), "http://127.0.0.1:9/table.dat"):
        publish(url, TABLE)
        sentence = r"cannot be downloaded \(\w+\); connect to a network"
        with pytest.raises(PsaError, match=sentence) as e:
            datasets.load("small")
        assert str(e.value).startswith(url)
        assert not isinstance(e.value, InputError)


def test_a_folder_is_taken_as_it_is_or_refused(
    publish: Publish, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    publish("http://127.0.0.1:9/table.dat", TABLE)
    monkeypatch.setenv(DATA_VARIABLE, str(tmp_path))
    with pytest.raises(InputError, match=r"part\.csv: there is no such file, but PSA_CASADI_DATA"):
        datasets.load("small")
    path = tmp_path / "small" / "part.csv"
    path.parent.mkdir()
    path.write_bytes(PART.csv([TABLE]).replace(b"0.005,", b"0.006,"))
    with pytest.raises(InputError, match="is not the published record, its SHA-256 differs"):
        datasets.load("small")
    path.write_bytes(PART.csv([TABLE]))
    assert datasets.load("small")[0].source == str(path)
    sentence = r"table\.dat: there is no such file, .* download http://127"
    with pytest.raises(InputError, match=sentence):
        datasets.originals("small")
    (path.parent / "table.dat").write_bytes(TABLE)
    assert list(datasets.originals("small")) == ["table.dat"]


@pytest.mark.parametrize("dataset", DATASETS.values(), ids=lambda d: d.name)
def test_every_dataset_describes_itself(dataset: Dataset) -> None:
    text = datasets.origin_text(dataset)
    for part in (dataset.source, dataset.citation, dataset.licence_text, dataset.description):
        assert len(part) > 20
        assert part in text
    assert dataset.licence.split(",")[0] in dataset.licence_text
    for file in dataset.files:
        assert file.conversion.words in text
        assert len(bytes.fromhex(file.sha256)) == 32
        for original in file.originals:
            assert original.url.startswith("https://")
            assert original.url.endswith(f"/{original.name}")
            assert len(bytes.fromhex(original.sha256)) == 32
            assert original.url in text


def test_the_command_lists_shows_and_writes(served: str, publish: Publish, tmp_path: Path) -> None:
    dataset = publish(served, TABLE)
    assert "micromanipulator" in psa()[1]
    assert psa("-q")[1].split() == list(DATASETS)
    assert dataset.citation in psa("small")[1]
    code, out = psa("small", "-o", tmp_path / "new" / "place")
    assert code == 0
    assert "part.csv" in out
    kept = sorted((tmp_path / "new" / "place").iterdir())
    assert [p.name for p in kept] == ["part.csv", "small_licence.txt"]
    assert kept[0].read_bytes() == PART.csv([TABLE])
    assert kept[1].read_text() == datasets.origin_text(dataset)


#: Folder of the originals of the steering mirror, which may not exist.
ORIGINALS = measured_data_directory() / "steering_mirror_test"
N, AXES, PERIODS, RATE = 64, 3, 2, 6400.0
#: Rows of the impulse responses from each voltage to each displacement [m/V], at delays 0, 1, 2.
IMPULSE = 1e-6 * np.random.default_rng(7).normal(size=(AXES, AXES, 3))


def voltages(seed: int, experiments: int) -> FloatArray:
    """Periodic random-phase signals (N, AXES, experiments, PERIODS) of lines 1 to N/2 - 2."""
    rng = np.random.default_rng(seed)
    lines = np.zeros((N // 2 + 1, AXES, experiments), dtype=complex)
    lines[1:-1] = np.exp(2j * np.pi * rng.uniform(size=(N // 2 - 1, AXES, experiments)))
    one = np.fft.irfft(lines, n=N, axis=0)
    return np.repeat(one[..., None], PERIODS, axis=-1)


def driven(u: FloatArray, only: int | None = None) -> FloatArray:
    """Displacements in steady state of all actuators, or of one of them."""
    y = np.zeros_like(u)
    for j in range(AXES) if only is None else [only]:
        for delay in range(3):
            y += IMPULSE[:, j, delay][:, None, None] * np.roll(u[:, [j]], delay, axis=0)
    return y


def saved(array: FloatArray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def columns(csv: bytes) -> FloatArray:
    head, *rows = csv.decode().splitlines()
    assert head == "time [s],voltage [V],displacement [um]"
    return np.array([[float(cell) for cell in row.split(",")] for row in rows])


def test_the_linear_response_is_recovered() -> None:
    u = voltages(1, 6)
    displayed = linear_response(u, driven(u))
    truth = np.fft.rfft(IMPULSE, n=N, axis=2).transpose(2, 0, 1)
    truth[[0, -1]] = 0.0  # no voltage there
    np.testing.assert_allclose(displayed, truth, atol=1e-12 * 1e-6)


@pytest.mark.parametrize("axis", range(AXES))
def test_what_is_left_is_the_answer_to_the_voltage_of_its_channel(axis: int) -> None:
    u = voltages(1, 6)
    t, v, x = columns(OneAxis(axis, -1, 2, 1, RATE).csv([saved(u), saved(driven(u))])).T
    np.testing.assert_allclose(t, np.arange(N) / RATE, atol=5e-9)
    np.testing.assert_allclose(v, u[:, axis, 2, 0], atol=6e-7)
    np.testing.assert_allclose(-x, 1e6 * driven(u, axis)[:, axis, 2, 0], atol=6e-5)


@pytest.mark.parametrize("axis", range(AXES))
def test_a_bend_of_the_direct_answer_stays(axis: int) -> None:
    u = voltages(1, 6)
    y, item = driven(u), driven(u, axis)[:, axis]
    bend = 0.3e-6 * (item / 1e-6) ** 3
    y[:, axis] += bend
    x = columns(OneAxis(axis, 1, 2, 1, RATE).csv([saved(u), saved(y)]))[:, 2]
    lost = x - 1e6 * (item + bend)[:, 2, 0]
    # of six experiments the two other voltages can explain a third of what is no linear answer
    assert np.std(lost) < 0.6e6 * np.std(bend[:, 2, 0])


def test_a_test_signal_is_judged_by_the_response_of_the_training_signals() -> None:
    train, test = voltages(1, 6), voltages(2, 3)
    arrays = (train, driven(train), test, driven(test))
    t, v, x = columns(OneAxis(1, 1, 2, 2, RATE).csv([*map(saved, arrays)])).T
    assert len(t) == 2 * N
    np.testing.assert_allclose(v, np.tile(test[:, 1, 2, 0], 2), atol=6e-7)
    item = 1e6 * driven(test, 1)[:, 1, 2]
    np.testing.assert_allclose(x, item.T.reshape(-1), atol=6e-5)


@pytest.mark.slow
@pytest.mark.skipif(not any(ORIGINALS.glob("*.npy")), reason=f"no originals in {ORIGINALS}")
def test_the_published_arrays_give_the_stated_bytes() -> None:
    for name in ("steering_mirror", "steering_mirror_test"):
        for file in DATASETS[name].files:
            content = [(ORIGINALS / o.name).read_bytes() for o in file.originals]
            for original, what in zip(file.originals, content, strict=True):
                assert hashlib.sha256(what).hexdigest() == original.sha256
            assert hashlib.sha256(file.conversion.csv(content)).hexdigest() == file.sha256
