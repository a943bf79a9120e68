"""The report opened from disk in a real browser: no error, no request, charts drawn, switches work."""

from __future__ import annotations

import json
import os
import shutil
import time
from pathlib import Path

import pytest

import consistency as cs
from consistency.bench.pages import write_reports
from consistency.referee.diagnostics.verdict.parts import STATUSES
from consistency.referee.pages.questions import MARKS

pytestmark = pytest.mark.browser

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--window-size=1200,1600",
)  # fmt: skip
OWN = ("data:", "blob:", "chrome:", "chrome-untrusted:")  # inline, or the browser's own first page
ODD = "<img src=x onerror=alert(1)> $$y$$"
# one pixel column after the other: has anything been painted?
PAINTED = """
const canvases = [];
const visit = (root) => { for (const e of root.querySelectorAll('*')) {
  if (e.tagName === 'CANVAS') canvases.push(e);
  if (e.shadowRoot) visit(e.shadowRoot);
} };
visit(document);
return canvases.filter((c) => c.width && c.height &&
  c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some((v) => v)).length;
"""
VISIBLE = """
const found = [];
for (const doc of Bokeh.documents) for (const chart of doc.roots())
  for (const glyph of chart.renderers) if (glyph.tags.includes(arguments[0])) found.push(glyph.visible);
return found;
"""


@pytest.fixture(scope="module")
def report(small, tmp_path_factory) -> Path:
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
        wait_for(lambda: driver.execute_script(PAINTED) >= 6)
        yield driver
    finally:
        driver.quit()


def wait_for(condition, seconds: float = 30.0) -> None:
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
    assert all(browser.execute_script(VISIBLE, "0:0"))
    assert len(browser.execute_script(VISIBLE, "0:0")) >= 6
    boxes[0].send_keys(" ")  # by keyboard
    assert not any(browser.execute_script(VISIBLE, "0:0"))
    assert all(browser.execute_script(VISIBLE, "0:1"))
    assert browser.find_elements("css selector", "li.off")
    boxes[0].send_keys(" ")
    assert all(browser.execute_script(VISIBLE, "0:0"))


def test_the_diagnosis_is_drawn_for_every_filter(browser):
    marks = browser.execute_script(
        """
        const of = (chart) => [chart.below[0].axis_label,
          [...new Set(chart.renderers.flatMap((r) => r.tags))].sort()];
        return Bokeh.documents[0].roots().map(of);
        """
    )
    drawn = dict(marks)
    for label in ("covariance ratio (truth / stated)", "within 2 sigma (%)", "lag (steps)"):
        assert drawn[label] == ["0:0", "0:1"], label
    cells = browser.find_elements("css selector", "table.marks td")
    assert len(cells) >= 2 * 6
    assert all(cell.text[0] in MARKS for cell in cells)
    spoken = {cell.find_element("css selector", "span").get_attribute("aria-label") for cell in cells}
    assert spoken <= set(MARKS.values())
    assert {"found", "not found"} <= spoken
    assert {pill.text for pill in browser.find_elements("css selector", ".verdict")} <= set(STATUSES)


def test_the_innovations_of_the_filters_left_fill_the_chart(browser):
    reach = """
    const chart = Bokeh.documents[0].roots().find((c) => c.left[0].axis_label === 'NIS / dof');
    return [chart.y_range.start, chart.y_range.end];
    """
    boxes = browser.find_elements("css selector", "fieldset input[type=checkbox]")
    low, high = browser.execute_script(reach)
    boxes[1].send_keys(" ")
    try:
        wait_for(lambda: browser.execute_script(reach) != [low, high], 10)
        less = browser.execute_script(reach)
        assert low <= less[0] < less[1] <= high
    finally:
        boxes[1].send_keys(" ")
    wait_for(lambda: browser.execute_script(reach) == [low, high], 10)


@pytest.mark.parametrize("width", [1200, 400])
def test_nothing_runs_over_the_edge(browser, width):
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        wait_for(lambda: browser.execute_script("return document.documentElement.scrollWidth") <= width, 10)
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def test_hovering_shows_step_and_the_odd_name_as_text(browser):
    from selenium.webdriver import ActionChains

    place = "[...document.querySelectorAll('.chart')].find((e) => e.ariaLabel.startsWith('ANEES of'))"
    chart = browser.execute_script(f"const chart = {place}; chart.scrollIntoView({{block: 'center'}}); return chart")
    spot = browser.execute_script(
        """
        const chart = Bokeh.documents[0].roots().find((c) => c.left[0].axis_label === 'ANEES of the pose');
        const line = chart.renderers.find((r) => r.tags.includes('0:1') && 'most' in r.data_source.data);
        const view = Bokeh.index.get_by_id ? Bokeh.index.get_by_id(chart.id) : Bokeh.index[chart.id];
        const data = line.data_source.data, i = 30;
        const frame = view.frame;
        const box = view.el.getBoundingClientRect();
        return [box.x + frame.x_scale.compute(data.x[i]), box.y + frame.y_scale.compute(data.y[i])];
        """
    )
    box = browser.execute_script(
        "const b = arguments[0].getBoundingClientRect(); return [b.x, b.y, b.width, b.height]", chart
    )
    x, y = (int(spot[i] - box[i] - box[i + 2] / 2) for i in (0, 1))
    ActionChains(browser).move_to_element_with_offset(chart, x, y).perform()
    tip = """
    let text = '', images = 0;
    const visit = (root) => { for (const e of root.querySelectorAll('*')) {
      if (e.className.startsWith?.('bk-tooltip-row')) text += e.textContent + '|';
      if (e.tagName === 'IMG') images += 1;
      if (e.shadowRoot) visit(e.shadowRoot);
    } };
    visit(document);
    return [text, images];
    """
    wait_for(lambda: "step" in browser.execute_script(tip)[0], 10)
    text, images = browser.execute_script(tip)
    assert ODD in text
    assert images == 0
