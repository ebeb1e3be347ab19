"""Public records: taken from a folder or downloaded, and never anything but what was published."""

import hashlib
import http.server
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from psa_casadi import datasets
from psa_casadi.cli.app import app
from psa_casadi.common.errors import InputError, PsaError
from psa_casadi.datasets import DATA_VARIABLE, DATASETS, Dataset
from psa_casadi.datasets.devices import Columns

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


def test_no_network_and_no_such_page_are_told_in_a_sentence(served: str, publish: Publish) -> None:
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
    with pytest.raises(InputError, match=r"part\.csv: there is no such file, and PSA_CASADI_DATA"):
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
def test_every_dataset_says_what_it_is(dataset: Dataset) -> None:
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
