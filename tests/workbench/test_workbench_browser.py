"""The local page in use: choose a record, map its columns, read the verdict."""

from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path

import pytest

from tests.contract.helpers import served
from tests.report.browser import find_browser
from tests.report.steered_browser import Steered, steered
from tests.tiers import posix, slow

pytestmark = pytest.mark.xdist_group("browser")
DEMO = Path(__file__).parents[2] / "psa_casadi" / "data" / "demo.csv"
#: A name that is markup where somebody takes it for that.
HOSTILE = "<img src=x onerror=document.title=1>.csv"


@pytest.fixture
def address(tmp_path: Path) -> Iterator[str]:
    (tmp_path / "tmp").mkdir()
    with served(tmp_path / "tmp") as (place, token):
        yield f"http://{place}/?token={token}"


def drop(tab: Steered, path: Path) -> None:
    """Drop a file with the mouse, as from a window of the system."""
    data = {"items": [], "files": [str(path)], "dragOperationsMask": 1}
    for kind in ("dragEnter", "dragOver", "drop"):
        tab.call("Input.dispatchDragEvent", type=kind, x=300, y=300, data=data)


def faults(tab: Steered, axe: str) -> list[str]:
    """Return the violations in the present page that axe rates serious or critical."""
    tab.run(f"{axe}; window.violations = null; axe.run({{resultTypes: ['violations']}}).then("
            "r => { window.violations = r.violations; }); 0")  # fmt: skip
    tab.until("window.violations")
    texts: list[str] = tab.run(
        "window.violations.filter(v => ['serious', 'critical'].includes(v.impact)).map("
        "v => v.id + ': ' + v.nodes[0].html)"
    )
    return texts


def report_runs(tab: Steered, address: str) -> None:
    """In its sandbox the report draws its plots, and its model runs."""
    tab.call("Page.navigate", url=address.partition("?")[0] + "report")
    alive = "document.querySelector('.live') && document.querySelector('.live').psa"
    tab.until(f"{alive} && document.querySelector('.main-svg')")


def narrow(tab: Steered) -> None:
    """A phone need not scroll sideways."""
    tab.call("Emulation.setDeviceMetricsOverride", width=390, height=844,
             deviceScaleFactor=1, mobile=True)  # fmt: skip
    assert tab.run("document.documentElement.scrollWidth") <= 390


def of_another_layout(tab: Steered, path: Path, line: str) -> None:
    """Choose a file whose columns have other names, which are mapped for it alone."""
    rows = ["time [s],voltage [V],pos", *DEMO.read_text(encoding="utf-8").splitlines()[1:300]]
    path.write_text("\n".join(rows), encoding="utf-8")
    tab.choose("#pick", path)
    tab.until("document.querySelector('#layout1c2')")
    tab.run("s = document.querySelector('#layout1c2'); s.value = 'displacement'; s.onchange()")
    tab.until("document.querySelectorAll('#curves figure').length === 2")
    statement = "time=time:s", "voltage=voltage:V", "displacement=pos:um"
    both = ",".join([line, *(f"{path.name}@{part}" for part in statement)])
    assert tab.run("document.querySelector('#set-columns').value") == both
    tab.run(f"document.querySelector('[aria-label=\"Remove {path.name}\"]').click()")
    tab.until(f"document.querySelector('#set-columns').value === '{line}'")


def nothing_outside_nor_wrong(tab: Steered, address: str) -> None:
    """Every request went to the server itself, and the console has no error."""
    items = [(e.get("method"), e.get("params", {})) for e in tab.heard]
    requested = [p["request"]["url"] for m, p in items if m == "Network.requestWillBeSent"]
    item = (address.partition("?")[0], "data:", "blob:")
    assert requested
    assert [u for u in requested if not u.startswith(item)] == []
    words = [p["entry"] for m, p in items if m == "Log.entryAdded"]
    assert [w for w in words if w["level"] == "error"] == []


@slow
@posix
def test_a_record_is_dropped_and_its_verdict_read(address: str, tmp_path: Path) -> None:
    record = tmp_path / HOSTILE
    record.write_text(DEMO.read_text("utf-8").replace("displacement [um]", "CH2"), "utf-8")
    axe = files("axe_core_python").joinpath("axe.min.js").read_text(encoding="utf-8")
    browser = find_browser(tmp_path)
    with steered(browser) as tab:
        tab.call("Page.navigate", url=address)
        tab.until("location.search === '' && document.querySelector('#start')")
        drop(tab, record)
        tab.until("document.querySelector('.problems')")
        assert tab.run("document.querySelector('#files .name').textContent") == HOSTILE
        assert tab.run("document.querySelector('#start').disabled")
        tab.run("s = document.querySelector('#layout0c2'); s.value = 'displacement'; s.onchange()")
        tab.until("!document.querySelector('#start').disabled")
        line = "time=time:s,voltage=voltage:V,displacement=CH2:um"
        assert tab.run("document.querySelector('#set-columns').value") == line
        of_another_layout(tab, tmp_path / "b.csv", line)
        assert faults(tab, axe) == []
        tab.run("document.querySelector('#start').focus()")
        tab.press("Enter", 13, "\r")
        tab.until("document.querySelectorAll('#tree li').length > 2", 120)
        tab.call("Page.navigate", url=address)  # a tab that is opened anew sees the same run
        tab.until("document.querySelectorAll('#tree li').length > 2")
        tab.until("!document.querySelector('#result').hidden", 240)
        tab.until("document.querySelector('#verdict').textContent.startsWith('Verdict: cause')")
        assert "slow creep" in tab.run("document.querySelector('#verdict').textContent")
        assert "the answer" in tab.run("document.querySelector('.best').textContent")
        assert line in tab.run("document.querySelector('#command').textContent")
        names = "[...document.querySelectorAll('#downloads a[download]')].map(a => a.textContent)"
        assert {"report.html", "extended.json", "diagnosis.json"} <= set(tab.run(names))
        assert tab.run("document.title") == "Diagnose records"
        assert not tab.run("document.querySelector('img:not(.still)')")
        assert faults(tab, axe) == []
        narrow(tab)
        report_runs(tab, address)
        nothing_outside_nor_wrong(tab, address)
