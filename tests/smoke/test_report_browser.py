"""The report opened from disk in a real browser: no error, no request, charts drawn, switches work.

Pages of every kind are accessible, as axe-core finds them.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import consistency as cs
from consistency.bench.pages import write_reports
from consistency.commands import main
from consistency.referee.diagnostics.verdict_parts import STATUSES
from consistency.referee.pages.ratio_figures import monitor_drawing
from consistency.referee.pages.verdicts import MARKS
from consistency.referee.readers.formats.innovation_files import NisLog
from consistency.referee.show import as_html
from consistency.referee.show.blocks import Chapter, Document, Figure
from consistency.referee.verdicts.monitor_sources import make_monitor, monitor_document, watch

pytestmark = pytest.mark.browser
ROOT = Path(__file__).parents[2]

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--window-size=1200,1600",
)  # fmt: skip
OWN = ("data:", "blob:", "chrome:", "chrome-untrusted:")  # inline, or the browser's own first page
ODD = "<img src=x onerror=alert(1)> $$y$$"
# figures that have a size, and lines in them
DRAWN = """
return [...document.querySelectorAll('.chart svg')].filter((svg) =>
  svg.getBoundingClientRect().width > 100 && svg.querySelectorAll('path').length > 20).length;
"""
VISIBLE = """
const parts = [...document.querySelectorAll('.filter-' + arguments[0])];
return parts.map((part) => getComputedStyle(part).display !== 'none');
"""


@pytest.fixture(scope="module")
def report(small, tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "run"
    results = cs.run_trials(small("herath2007-stereo"), ["ekf-xyz", "ekf-uvd"], runs=12, seed=0, jobs=1)
    for table in (results.estimates, results.map):
        table["filter"] = table["filter"].replace("ekf-uvd", ODD)
    results.manifest["filters"] = ["ekf-xyz", ODD]
    results.write(folder)
    write_reports(folder, folder / "report.html", None, overwrite=False)
    return folder / "report.html"


@pytest.fixture(scope="module")
def browser(report, tmp_path_factory):
    if CHROMIUM is None or DRIVER is None:
        if os.environ.get("CONSISTENCY_REQUIRE_BROWSER") == "1":
            pytest.fail("CONSISTENCY_REQUIRE_BROWSER=1, but chromium and chromedriver are not both on the PATH")
        pytest.skip("chromium and chromedriver (Debian: chromium, chromium-driver) are not both on the PATH")
    webdriver = pytest.importorskip("selenium.webdriver")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('profile')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(executable_path=DRIVER))
    try:
        driver.get(report.as_uri())
        wait_for(lambda: driver.execute_script(DRAWN) >= 6)
        yield driver
    finally:
        driver.quit()


def wait_for(condition, seconds=30.0):
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail("the charts were not drawn in time")
        time.sleep(0.1)


def test_opens_without_an_error_and_without_the_network(browser, report):
    complaints = [entry for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    assert complaints == []
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    requested = {
        message["params"]["request"]["url"] for message in messages if message["method"] == "Network.requestWillBeSent"
    }
    assert {url for url in requested if not url.startswith(OWN)} == {report.as_uri()}


def test_a_checkbox_hides_a_filter_in_all_charts(browser):
    boxes = browser.find_elements("css selector", "fieldset input[type=checkbox]")
    assert len(boxes) == 2
    assert all(browser.execute_script(VISIBLE, "0-0"))
    assert len(browser.execute_script(VISIBLE, "0-0")) >= 6
    boxes[0].send_keys(" ")  # by keyboard
    assert not any(browser.execute_script(VISIBLE, "0-0"))
    assert all(browser.execute_script(VISIBLE, "0-1"))
    boxes[0].send_keys(" ")
    assert all(browser.execute_script(VISIBLE, "0-0"))


def test_the_diagnosis_is_drawn_for_every_filter(browser):
    owners = browser.execute_script(
        """
        const of = (figure) => ['0-0', '0-1'].filter((tag) => figure.querySelector('.filter-' + tag));
        return [...document.querySelectorAll('figure')].map((f) => [f.querySelector('h3, h4').textContent, of(f)]);
        """
    )
    drawn = dict(owners)
    for title in ("ANEES of the pose", "By axis", "Innovations", "Pose errors, run 0"):
        assert drawn[title] == ["0-0", "0-1"], title
    cells = browser.find_elements("css selector", "table.marks td")
    assert len(cells) >= 2 * 6
    assert all(cell.text[0] in MARKS for cell in cells)
    spoken = {cell.find_element("css selector", "span").get_attribute("aria-label") for cell in cells}
    assert spoken <= set(MARKS.values())
    assert {"found", "not found"} <= spoken
    assert {pill.text for pill in browser.find_elements("css selector", ".verdict")} <= set(STATUSES)


def test_the_odd_name_is_text(browser):
    texts = browser.execute_script("return [...document.querySelectorAll('svg text')].map((t) => t.textContent)")
    assert any(ODD[:12] in text for text in texts)
    assert not browser.find_elements("css selector", "main img")


@pytest.mark.parametrize("width", [1200, 400])
def test_nothing_runs_over_the_edge(browser, width):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        wait_for(lambda: browser.execute_script("return document.documentElement.scrollWidth") <= width, 10)
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


# --- accessibility ------------------------------------------------------------------------------------

GRAVE = (
    "moderate",
    "serious",
    "critical",
)  # of axe-core's four grades; some moderate ones are serious in later versions
GATE = """
import numpy as np
from consistency.testing import assert_consistent

def test_it():
    errors = 2.0 * np.random.default_rng(5).standard_normal((60, 10, 2))
    assert_consistent(errors, np.broadcast_to(np.eye(2), (60, 10, 2, 2)))
"""


def gate_page(at):
    (at / "test_gate.py").write_text(GATE)
    command = [sys.executable, "-m", "pytest", "-q", "--consistency-report", "gate.html", "test_gate.py"]
    subprocess.run(command, cwd=at, check=False, capture_output=True)
    return at / "gate.html"


def files_page(at):
    rng = np.random.default_rng(5)
    np.savez(
        at / "est.npz", errors=rng.standard_normal((60, 10, 2)), covariances=np.tile(2 * np.eye(2), (60, 10, 1, 1))
    )
    with pytest.raises(SystemExit):
        main(["analyse", str(at / "est.npz"), "--report", str(at / "look")])
    return at / "look" / "report.html"


def monitor_page(at):
    """What `monitor` prints and its plot; a notebook shows them as a page does."""
    nis = 3.0 * np.random.default_rng(5).chisquare(2, 200)
    step = np.arange(200.0)
    watched = watch(NisLog("fixes", step, 0.1 * step, nis, np.full(200, 2)), make_monitor("optimal"))
    shown = monitor_document("fixes", watched.monitor, watched.alarm, watched.alarm_t, watched.since_t)
    figure = Figure("NIS and evidence", "NIS over its degrees of freedom.", (partial(monitor_drawing, watched),))
    chapter = Chapter("fixes", "Innovations of fixes", "fixes", (*shown.opening, figure))
    page = at / "monitor.html"
    page.write_text(as_html.render(Document("Monitor", "", (chapter,))), encoding="utf-8")
    return page


def reproduce_page(at):
    """Two findings of the reference on the results of one world."""
    world = cs.load_scenario("herath2007-stereo").variant("small", truth__steps=60)
    results = cs.run_trials(world, ["ekf-uvd"], runs=4, seed=0, jobs=1)
    results.write(at / "all" / "small")
    reference = json.loads((ROOT / "reports/reference/findings.json").read_text("utf-8"))
    (at / "all" / "findings.json").write_text(json.dumps(reference[:2]))
    (at / "all" / "manifest.json").write_text(json.dumps(results.manifest | {"studies": ["small"]}))
    write_reports(at / "all", at / "report.html", None, overwrite=False)
    return at / "report.html"


PAGES = {"files": files_page, "monitor": monitor_page, "gate": gate_page, "reproduce": reproduce_page, "study": None}


@pytest.mark.parametrize("kind", PAGES)
def test_a_page_is_accessible(browser, report, kind, tmp_path):
    axe = pytest.importorskip("axe_core_python.selenium").Axe()
    make = PAGES[kind]
    page = report if make is None else make(tmp_path)
    first = browser.current_window_handle
    browser.switch_to.new_window("tab")
    try:
        size = {"width": 420, "height": 900, "deviceScaleFactor": 1, "mobile": True}
        browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)  # where regions scroll
        browser.get(page.as_uri())
        browser.execute_script("document.querySelectorAll('details').forEach((each) => { each.open = true; })")
        browser.set_script_timeout(110)
        found = [each for each in axe.run(browser)["violations"] if each["impact"] in GRAVE]
        assert [(each["id"], each["nodes"][0]["html"]) for each in found] == []
    finally:
        browser.close()
        browser.switch_to.window(first)
