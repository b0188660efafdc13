"""The report: opened in a real browser, and what is in it."""

from __future__ import annotations

import base64
import importlib.util
import json
import re
import shutil
import tempfile
import time

import numpy as np
import pytest
from conftest import ROOT

from fdi_ros import cli
from fdi_ros.model.geometry import Geometry
from fdi_ros.monitor.output import Output
from fdi_ros.study.report import Report, plotly_script

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("plotly") is None, reason="plotly is not installed (extra: report)"
)
needs_browser = pytest.mark.skipif(
    not CHROMIUM or not DRIVER or importlib.util.find_spec("selenium") is None,
    reason="chromium, chromedriver or selenium is not installed",
)


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    words = ["replay", str(ROOT / "bags" / "cone_flight"), "--config", str(ROOT / "config" / "two_triads.yaml")]
    words += ["--detector", "likelihood_ratio"]
    faults = ["channel=g2 kind=bias size=0.2 start=20", "channel=g6 kind=drift size=0.05 start=30 stop=50"]
    assert cli.main([*words, "--report", str(path), "--fault", faults[0], "--fault", faults[1]]) == 0
    return path


@pytest.fixture(scope="module")
def browser(report):
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    switches = "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking"
    switches += " disable-component-update disable-sync disable-dev-shm-usage window-size=1300,2600"
    with tempfile.TemporaryDirectory(prefix="fdi_browser_", ignore_cleanup_errors=True) as profile:
        for switch in [*switches.split(), f"user-data-dir={profile}"]:
            options.add_argument(f"--{switch}")
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        driver = webdriver.Chrome(options=options, service=Service(DRIVER))
        try:
            driver.get(report.as_uri())
            wait(driver, "return document.documentElement.dataset.ready === 'yes'")
            yield driver
        finally:
            driver.quit()


def wait(driver, condition, seconds=60):
    end = time.monotonic() + seconds
    while not driver.execute_script(condition):
        assert time.monotonic() < end, condition
        time.sleep(0.05)


def ranges(driver):
    names = ("timeline", "statistic", "rate", "residual")
    return [driver.execute_script(f"return document.getElementById('{name}').layout.xaxis.range") for name in names]


@needs_browser
def test_the_plots_are_drawn_without_a_word_on_the_console(browser):
    drawn = {}
    for name in ("statistic", "rate", "residual"):
        lines = f"document.querySelectorAll('#{name} .scatterlayer .trace path.js-line')"
        drawn[name] = browser.execute_script(f"return [...{lines}].map(p => p.getAttribute('d').length)")
    assert len(drawn["statistic"]) == 2
    assert len(drawn["rate"]) >= 3 * (1 + 6)
    assert len(drawn["residual"]) == 6
    assert min(drawn["statistic"] + drawn["residual"]) > 20
    bars = browser.execute_script("return document.querySelectorAll('#timeline .barlayer .point path').length")
    assert bars >= 6 + 2
    assert [entry for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")] == []


@needs_browser
def test_no_request_leaves_the_file(browser, report):
    asked = []
    for entry in browser.get_log("performance"):
        message = json.loads(entry["message"])["message"]
        if message["method"] == "Network.requestWillBeSent":
            asked.append(message["params"]["request"]["url"])
    # The browser asks itself for the parts of its own empty first page.
    asked = [url for url in asked if not url.startswith(("chrome:", "data:", "blob:"))]
    assert set(asked) == {report.as_uri()}


@needs_browser
def test_a_drag_zooms_all_plots_and_a_double_click_returns(browser):
    from selenium.webdriver import ActionChains
    from selenium.webdriver.common.by import By

    whole = ranges(browser)
    assert all(span == whole[0] for span in whole)
    before = browser.execute_script("return document.getElementById('residual').data[0].x.length")
    area = browser.find_element(By.CSS_SELECTOR, "#statistic .nsewdrag")
    width = area.size["width"]
    drag = ActionChains(browser).move_to_element_with_offset(area, -width // 4, 0).click_and_hold()
    drag.move_by_offset(width // 8, 0).move_by_offset(width // 8, 0).release().perform()
    wait(browser, "return document.getElementById('residual').layout.xaxis.range[0] > 10")
    time.sleep(0.5)
    zoomed = ranges(browser)
    assert all(span == pytest.approx(zoomed[1]) for span in zoomed)
    assert zoomed[0] == pytest.approx([15, 30], abs=1.0)
    shown = browser.execute_script("return document.getElementById('residual').data[0].x")
    assert zoomed[0][0] - 0.1 <= shown[0] <= shown[-1] <= zoomed[0][1] + 0.1
    # In the narrower view every sample is drawn.
    assert len(shown) == pytest.approx(1500, abs=110)
    assert before > len(shown)
    ActionChains(browser).move_to_element(area).double_click().perform()
    wait(browser, "return document.getElementById('residual').layout.xaxis.range[0] < 1")


@needs_browser
def test_light_and_dark(browser):
    colour = "return getComputedStyle(document.body).backgroundColor"
    light = browser.execute_script(colour)
    browser.execute_script("document.getElementById('theme').click()")
    wait(browser, "return document.documentElement.classList.contains('dark')")
    dark = browser.execute_script(colour)
    assert (light, dark) == ("rgb(255, 255, 255)", "rgb(20, 23, 28)")
    ink = browser.execute_script("return document.getElementById('rate').layout.font.color")
    assert ink == "#e6e9ed"


def test_the_verdict_stands_at_the_top_and_nothing_is_fetched(report):
    page = report.read_text()
    assert "<li>2 of 2 injected faults detected, 2 isolated.</li>" in page
    head = page.split("<script>")[0]
    assert head.index('id="verdict"') < head.index('id="timeline"')
    own = page.replace(plotly_script(), "")
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", own)
    assert "http" not in own.replace("http-equiv", "")
    assert report.stat().st_size < 10_000_000
    assert "<li>300 samples without a fused rate; bias learned</li>" in page


def test_what_a_recording_names_is_shown_and_not_run(report):
    geometry = Geometry.cone(4)
    nasty = "</script><script>alert(1)</script>"
    made = Report(Geometry.from_axes(geometry.axes, [nasty, "b", "c", "d"]))
    page = made.html(summary(bag=nasty), {"recording": nasty})
    assert page.count("<script") == 3
    assert page.count("</script") == 3


SAME = {"configured_hz": 100.0, "recorded_hz": 100.0}


def summary(**changes):
    plain = {"bag": "bag", "faults": [], "events": [], "declared": [], "samples": 0, "samples_judged": 0}
    plain |= {"damage": [], "malformed": {}, "disordered": 0, "alignment": {}, "samples_with_rate": 0, "note": ""}
    return {**plain, "start_s": 0.0, "duration_s": 0.0, "bias": {"state": "fixed"}, "sample_rate": SAME, **changes}


def outputs(geometry, rows, spike):
    """Samples as a pipeline would give them, with one spike in one residual."""
    random = np.random.default_rng(0)
    for first in range(0, rows, 50_000):
        count = min(50_000, rows - first)
        residual = random.normal(0, 0.01, (count, geometry.n))
        if first <= spike < first + count:
            residual[spike - first, 3] = 77.0
        rate, covariance = random.normal(size=(count, 3)), np.broadcast_to(1e-4 * np.eye(3), (count, 3, 3))
        figures = {"rate": rate, "covariance": covariance, "residual": residual, "threshold": 6.0, "valid": True}
        figures["statistic"] = np.abs(random.normal(size=count))
        yield Output.from_arrays(geometry.n, stamp=1_000_000 * np.arange(first, first + count), **figures)


def test_a_long_recording_of_many_channels_stays_small_and_keeps_its_spike():
    geometry, rows, spike = Geometry.cone(12), 300_000, 123_457
    made = Report(geometry)
    for output in outputs(geometry, rows, spike):
        made.add(output.stamp * 1e-9, output)
    page = made.html(summary(samples=rows, samples_judged=rows, duration_s=rows / 1000), {})
    assert len(page) < 10_000_000
    data = json.loads(re.search(r'<script id="data"[^>]*>(.*?)</script>', page, re.S)[1])
    assert data["decimated"]
    series = np.frombuffer(base64.b64decode(data["series"]["residual.3"]), dtype="<f4").reshape(-1, 2)
    start = np.frombuffer(base64.b64decode(data["time"]), dtype="<f8")
    assert series.max() == 77.0
    span = int(np.argmax(series[:, 1]))
    assert start[span] <= spike / 1000 <= start[span + 1]
