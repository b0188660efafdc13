# Copyright 2026 fdi_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The pages: opened in a real browser, and what is in them."""

import base64
import importlib.util
import json
import re
import shutil
import tempfile
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from monitor.streams import output_of
from replay.summaries import summary_of

from fdi_ros.cli import command_line
from fdi_ros.model.geometry import Geometry
from fdi_ros.replay.episodes import Episode, Evidence, RateMeanwhile, Step, Story
from fdi_ros.replay.outcomes import FaultEffect, Outcome, Scores
from fdi_ros.replay.page import Report
from fdi_ros.report.layout import Section, html_of, html_table, page
from fdi_ros.system.text import shown

ROOT = Path(__file__).parents[2]
CHROMIUM = (
    shutil.which("chromium")
    or shutil.which("chromium-browser")
    or shutil.which("google-chrome")
)
DRIVER = shutil.which("chromedriver")
FAULTS = (
    "channel=g2 kind=bias size=0.2 start=20",
    "channel=g6 kind=drift size=0.05 start=30 stop=50",
)
REPLAY = [
    "replay",
    str(ROOT / "bags" / "cone_flight"),
    "--config",
    str(ROOT / "config" / "two_triads.yaml"),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def report(folder):
    path = folder / "report.html"
    words = [*REPLAY, "--detector", "likelihood_ratio"]
    assert (
        command_line.main(
            [*words, "--report", str(path), "--fault", FAULTS[0], "--fault", FAULTS[1]]
        )
        == 0
    )
    return path


@pytest.fixture(scope="module")
def driver():
    if not CHROMIUM or not DRIVER or importlib.util.find_spec("selenium") is None:
        pytest.skip("chromium, chromedriver or selenium is not installed")
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    switches = "headless no-sandbox disable-gpu disable-quic no-first-run disable-background-networking"
    switches += " disable-component-update disable-sync disable-dev-shm-usage window-size=1300,2600"
    with tempfile.TemporaryDirectory(
        prefix="fdi_browser_", ignore_cleanup_errors=True
    ) as profile:
        for switch in [*switches.split(), f"user-data-dir={profile}"]:
            options.add_argument(f"--{switch}")
        options.set_capability(
            "goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"}
        )
        driver = webdriver.Chrome(options=options, service=Service(DRIVER))
        try:
            yield driver
        finally:
            driver.quit()


def opened(driver, path):
    if driver.current_url != path.as_uri():
        driver.get(path.as_uri())
        wait(driver, "document.documentElement.dataset.ready === 'yes'")
    return driver


@pytest.fixture
def browser(driver, report):
    return opened(driver, report)


def ask(driver, expression):
    """What a page says of an expression."""
    return driver.execute_script(f"return {expression}")


def wait(driver, condition, seconds=60):
    end = time.monotonic() + seconds
    while not ask(driver, condition):
        assert time.monotonic() < end, condition
        time.sleep(0.02)


def complaints(driver):
    return [
        entry
        for entry in driver.get_log("browser")
        if entry["level"] in ("SEVERE", "WARNING")
    ]


def data_of(text):
    """What the scripts of a page draw."""
    return json.loads(
        re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.S)[1]
    )


@contextmanager
def phone(driver):
    """A screen of 390 dots."""
    size = {"width": 390, "height": 844, "deviceScaleFactor": 1, "mobile": True}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    try:
        yield
    finally:
        driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def plot(number, rest=""):
    return f"figure[data-figure='{number}'] {rest}"


def test_the_plots_are_drawn_with_the_faults_and_without_a_word_on_the_console_or_a_request(
    browser, report
):
    lines = (
        "f => [...f.querySelectorAll('path.line')].map(p => p.getAttribute('d').length)"
    )
    drawn = ask(browser, f"[...document.querySelectorAll('figure')].map({lines})")
    # Timeline, statistic, three axes of the rate, six residuals, spectrum, protection level.
    assert [len(figure) for figure in drawn[:2]] == [0, 2]
    assert sum(map(len, drawn[2:5])) >= 3 * (1 + 4)
    assert list(map(len, drawn[5:])) == [1] * 6 + [6, 3]
    assert min(length for figure in drawn for length in figure) > 20
    bars = ask(
        browser, f'document.querySelectorAll("{plot(0, "g[clip-path] rect")}").length'
    )
    assert bars >= 6 + 2
    assert complaints(browser) == []
    sent = [
        json.loads(entry["message"])["message"]
        for entry in browser.get_log("performance")
    ]
    asked = [
        one["params"]["request"]["url"]
        for one in sent
        if one["method"] == "Network.requestWillBeSent"
    ]
    # The browser asks itself for the parts of its own empty first page.
    own = ("chrome:", "chrome-untrusted:", "data:", "blob:")
    assert {url for url in asked if not url.startswith(own)} == {report.as_uri()}
    # Faults are shaded, and their detection is marked, in every plot over time.
    count = "n => [...document.querySelectorAll('figure')].map(f => f.querySelectorAll(n).length)"
    shaded, detected, isolated = (
        ask(browser, f"({count})('{name}')")
        for name in ("rect.fault", ".detected", ".isolated")
    )
    assert shaded == detected == isolated == [2] * 11 + [0, 2]
    told = ask(
        browser,
        "[...document.querySelectorAll('figure .mark title')].map(t => t.textContent)",
    )
    assert "bias on g2: detected at 20.030 s" in told


def test_a_drag_zooms_all_plots_and_a_double_click_returns(browser):
    from selenium.webdriver import ActionChains

    ranges = "links.time.charts.map(p => p.x.range)"
    whole = ask(browser, ranges)
    assert all(span == whole[0] for span in whole)
    area = browser.find_element("css selector", plot(1, ".stage"))
    width = area.size["width"]
    drag = (
        ActionChains(browser)
        .move_to_element_with_offset(area, -width // 4, 0)
        .click_and_hold()
    )
    drag.move_by_offset(width // 8, 0).move_by_offset(width // 8, 0).release().perform()
    wait(browser, "links.time.range[0] > 10")
    # The link of the page shows the same to whoever it is passed on to.
    low, high = map(float, ask(browser, "location.hash").removeprefix("#t=").split(","))
    assert [low, high] == pytest.approx(ask(browser, "links.time.range"), abs=1e-3)
    zoomed = ask(browser, ranges)
    assert all(span == zoomed[0] for span in zoomed)
    assert zoomed[0] == pytest.approx([14, 29], abs=1.5)
    # In the narrower view every sample is drawn.
    drawn = ask(
        browser, f'document.querySelector("{plot(5, "path.line")}").getAttribute("d")'
    )
    assert len(re.findall("[ML]", drawn)) <= 100 * (zoomed[0][1] - zoomed[0][0]) + 3
    ActionChains(browser).move_to_element(area).double_click().perform()
    wait(browser, "links.time.range[0] < 1")


def test_a_link_to_a_time_shows_it_and_contents_lead_to_all_sections(driver, report):
    driver.get(f"{report.as_uri()}#t=20,25")
    wait(driver, "document.documentElement.dataset.ready === 'yes'")
    assert ask(driver, "links.time.range") == [20, 25]
    lost = "[...document.querySelectorAll('nav a')].filter(a => !document.querySelector(a.getAttribute('href')))"
    assert ask(driver, f"{lost}.length") == 0
    assert ask(
        driver,
        "document.querySelectorAll('nav a').length === document.querySelectorAll('section').length",
    )
    driver.get("about:blank")


def test_the_cursor_is_in_all_plots_and_the_keyboard_moves_and_zooms(browser):
    area = browser.find_element("css selector", plot(2, ".stage"))
    browser.execute_script("arguments[0].focus()", area)
    area.send_keys("\ue014")  # to the right
    lines = "[...document.querySelectorAll('.cursor:not([hidden])')].map(l => +l.getAttribute('x1'))"
    placed = ask(browser, lines)
    assert len(placed) == 12
    assert max(placed) - min(placed) < 1
    said = ask(browser, f'document.querySelector("{plot(2, ".readout")}").textContent')
    assert re.match(r"30\.\d+ s, \d\d:\d\d:\d\d\.\d+ UTC *fused -?[\d.]+ *g", said)
    area.send_keys("+")
    wait(browser, "links.time.range[1] - links.time.range[0] < 31")
    area.send_keys("0")
    wait(browser, "links.time.range === links.time.all")
    browser.execute_script("arguments[0].blur()", area)
    assert ask(browser, lines) == []
    named = ask(
        browser, "[...document.querySelectorAll('.stage')].map(s => s.ariaLabel)"
    )
    assert all(len(words) > 20 for words in named)
    assert "g2" in named[6]


@pytest.fixture(scope="module")
def pages(folder, report):
    """A page of every kind, by the verb that makes it."""
    words = {
        "geometry": ["geometry", str(ROOT / "config" / "three_imus.yaml")],
        "setup": ["setup", REPLAY[1], "--output", str(folder / "setup.yaml")],
        "sweep": [
            "sweep",
            *REPLAY[1:],
            "--times",
            "1",
            "--within",
            "1",
            "--fault",
            "kind=bias size=0.3",
        ],
    }
    made = {"replay": report} | {name: folder / f"{name}.html" for name in words}
    for name, given in words.items():
        assert command_line.main([*given, "--report", str(made[name])]) == 0
    return made


def test_on_a_phone_nothing_is_wider_than_the_screen_and_no_word_is_broken(
    driver, pages
):
    lines = "const r = document.createRange(); r.selectNodeContents(c); return r.getClientRects().length"
    short = f"[...document.querySelectorAll('.scroll:not(.fold) td:not(.long)')].filter(c => {{ {lines} > 1 }})"
    cells = "[...document.querySelectorAll('.scroll td, .scroll th')]"
    over = f"{cells}.filter(c => c.scrollWidth > c.clientWidth + 1)"
    wide = "[...document.querySelectorAll('.stage svg')].map(s => s.getBoundingClientRect().right)"
    with phone(driver):
        for path in pages.values():
            opened(driver, path)
            assert ask(driver, "document.documentElement.scrollWidth") <= 390
            # A name or a figure stands in one line; so a table that is wider scrolls by itself.
            assert ask(driver, f"{short}.map(c => c.textContent)") == []
            assert ask(driver, f"{over}.map(c => c.textContent)") == []
            assert ask(driver, f"Math.max(...{wide})") <= 390
            assert complaints(driver) == []


def test_no_line_ends_between_a_number_and_its_unit():
    words = "12 of 12, 95 % of 3 hours: 0.1 rad/s"
    kept = "12 of 12, 95&nbsp;% of 3 hours: 0.1&nbsp;rad/s"
    for content in ([words], {"found": words}, (("found",), [(words,)])):
        assert kept in html_of(content)
    assert f"<li>{kept}</li>" in page("title", [words], [])


def test_every_page_stands_alone_is_small_and_has_its_verdict_at_the_top(pages):
    for path in pages.values():
        text = path.read_text()
        assert not re.search(r"""(src|href)\s*=\s*["'](?!data:|#)""", text)
        assert "http" not in text.replace("http-equiv", "")
        assert text.index('id="verdict"') < text.index("<section")
        assert path.stat().st_size < 600_000
    text = pages["replay"].read_text()
    assert "<li class=good>2 of 2 injected faults detected, 2 isolated.</li>" in text
    learning = r"<li>no fused rate in the first 300 of \d+ samples, while the biases were learned</li>"
    assert re.search(learning, text)


def test_a_plot_without_values_is_not_drawn():
    empty = {"data": [{"type": "scatter", "x": [1], "y": [None]}], "layout": {}}
    drawn = {"data": [{"type": "scatter", "x": [1], "y": [2.0]}], "layout": {}}
    text = page(
        "title",
        [],
        [
            Section("one", "Of it.", figures=[empty]),
            Section("two", figures=[empty, drawn]),
        ],
    )
    assert text.count("<figure") == 1
    assert (
        text.count("Nothing to draw")
        == text.count("Of it. Nothing to draw: there are no values.")
        == 1
    )


def made(geometry, time, residual, faults=(), episodes=(), bag="bag"):
    """The page of samples at these times, s, and with these residuals (N, n), and the faults and episodes of them."""
    random, drawn, count = (
        np.random.default_rng(0),
        Report(geometry, np.full(geometry.n, 0.01), 1 / np.diff(time).min()),
        len(time),
    )
    for rows in np.array_split(np.arange(count), max(2, count // 50_000)):
        figures = {
            "rate": random.normal(size=(len(rows), 3)),
            "statistic": np.abs(random.normal(size=len(rows))),
        }
        figures |= {
            "covariance": 1e-4 * np.eye(3),
            "residual": residual[rows],
            "threshold": 6.0,
            "valid": True,
        }
        drawn.add(
            None,
            output_of(
                geometry.n, stamp=np.round(1e9 * time[rows]).astype(np.int64), **figures
            ),
            None,
        )
    scores = Scores(
        count, time[-1], faults, (), FaultEffect(), 0.0, count, count, 0, ()
    )
    return drawn.html(
        replace(summary_of(scores, bag), story=Story((), episodes)), {"recording": bag}
    )


def noise(rows, n):
    return np.random.default_rng(1).normal(0, 0.01, (rows, n))


def test_no_curve_is_drawn_over_a_hole():
    # Holes of 2 s within what is handed on at once, and one between.
    time = 0.01 * np.arange(200) + 2.0 * np.searchsorted(
        [50, 100, 150], np.arange(200), side="right"
    )
    store = data_of(made(Geometry.cone(6), time, noise(200, 6)))["stores"][0]
    kind, series = store["series"]["residual.3"]
    values = np.frombuffer(base64.b64decode(series), dtype=f"<{kind}")
    time = np.frombuffer(base64.b64decode(store["time"]), dtype="<f8")
    long = np.flatnonzero(np.diff(time) > 1.0)
    assert len(long) == 3
    assert np.isnan(values[long]).all()


def test_names_stay_text_in_page_and_plots(driver, folder):
    nasty = '</script><img src=x onerror="document.title=1">\u202egpj'
    geometry = Geometry.from_axes(Geometry.cone(4).axes, [nasty, "b", "c", "&lt;"])
    path = folder / "nasty.html"
    fault = Outcome(nasty, (nasty,), nasty, None, 0.05, None, detected_at_s=0.06)
    step = Step(0.1, "FAULTY", (nasty,), nasty)
    evidence, rate = Evidence("", None, 0, None), RateMeanwhile(1.0, None, None, None)
    false = Episode(
        1,
        "FAULTY",
        (nasty,),
        nasty,
        0.1,
        0.1,
        0.2,
        True,
        (step,),
        (),
        None,
        evidence,
        rate,
    )
    path.write_text(
        made(geometry, 0.01 * np.arange(200), noise(200, 4), (fault,), (false,), nasty)
    )
    opened(driver, path)
    driver.execute_script(
        "links.time.over = links.time.charts[2]; links.time.point(0.1)"
    )
    assert ask(driver, "document.querySelectorAll('img').length") == 0
    for text in (".readout')", ".mark title')"):
        said = ask(
            driver,
            f"[...document.querySelectorAll('{text}].map(e => e.textContent).join(' ')",
        )
        assert shown(nasty) in said
    assert "\u202e" not in path.read_text()
    assert complaints(driver) == []


def test_a_short_shake_does_not_set_the_scale_until_asked(driver, folder):
    shaken, residual = folder / "shaken.html", noise(6000, 6)
    residual[5200:] *= 1000
    shaken.write_text(made(Geometry.cone(6), 0.01 * np.arange(6000), residual))
    opened(driver, shaken)
    figure = "sections.find(s => s.plots.length === 6)"
    high, noted = (
        f"{figure}.plots[2].y.range[1]",
        f"{figure}.element.querySelectorAll('.cut').length",
    )
    assert ask(driver, high) < 0.1
    assert ask(driver, noted) == 6
    driver.execute_script(f"{figure}.scale.click()")
    assert ask(driver, high) > 10
    assert ask(driver, noted) == 0


SORTED = {
    "name": [
        "2024-05-03.mcap",
        "2024-05-10.mcap",
        "2024-11-02.mcap",
        "2025-01-01.mcap",
    ],
    "log": ["9_59_01.ulg", "10_2_45.ulg", "10_23_45.ulg", "a"],
    "fault": ["bias 0.02 rad/s", "bias 0.1 rad/s", "bias 2 rad/s", "bias 10 rad/s"],
    "duration": ["0.7 min", "3.5 min", "12.0 min", "-"],
    "interval": ["9.1% to 13.0%", "93.2% to 98.1%", "100.0% to 100.0%", ""],
    "bias": ["-0.013", "-7.1e-05", "5.4e-05", "2"],
}
"""Cells of each column in their order."""


def test_a_click_on_a_head_sorts_figures_by_size_and_names_as_a_reader_would(
    driver, folder
):
    path = folder / "sorted.html"
    rows = [
        [cells[(k * 3 + shift) % 4] for shift, cells in enumerate(SORTED.values())]
        for k in range(4)
    ]
    path.write_text(
        page("sorted", [], [Section("", "", html_table(list(SORTED), rows, sort=True))])
    )
    opened(driver, path)
    for column, (name, cells) in enumerate(SORTED.items()):
        shown = f"""document.querySelectorAll("thead button")[{column}].click();
            return [...document.querySelectorAll("tbody tr")].map(row => row.cells[{column}].textContent)"""
        assert driver.execute_script(shown) == cells, name
        back = [cell for cell in reversed(cells) if cell not in ("-", "")]
        assert driver.execute_script(shown)[: len(back)] == back, name
    assert complaints(driver) == []


SAVED = """
const done = arguments[0];
const charts = sections.flatMap((s) => s.plots).filter((p) => p instanceof Chart);
const save = async () => {
  const picture = await pictureOf(charts[1]);
  return [picture.width / charts[1].width, picture.toDataURL("image/png").length, charts.map(csvOf)];
};
save().then(done, (error) => done(String(error)));
"""


def test_a_plot_is_saved_as_a_picture_and_as_a_table_of_what_is_shown(browser):
    browser.execute_script("links.time.zoom([19, 21])")
    scale, length, tables = browser.execute_async_script(SAVED)
    browser.execute_script("links.time.zoom(null)")
    assert (scale, length > 5_000) == (2, True)
    states, statistic = (text.split("\n") for text in tables[:2])
    assert states[0] == "from,to,name,state"
    assert any(line.endswith(",g2,FAULTY") for line in states)
    rows = [line.split(",") for line in statistic[1:]]
    assert {name for name, *_ in rows} == {"statistic", "threshold"}
    times = [float(time) for _, time, *_ in rows]
    assert 19 <= min(times) < 19.1
    assert 20.9 < max(times) <= 21
    assert complaints(browser) == []


def test_a_page_draws_temperatures_and_modes_of_a_log(folder):
    path = folder / "crash.html"
    words = ["replay", str(ROOT / "bags" / "copter_crash.tlog"), "--report", str(path)]
    assert command_line.main(words) == 3
    text = path.read_text()
    assert "Temperature of each IMU" in text
    assert '"label":"GUIDED"' in text
    data = json.loads(
        re.search(r'<script id="data"[^>]*>(.*?)</script>', text, re.DOTALL)[1]
    )
    titles = [one["layout"].get("yaxis", {}).get("title") for one in data["figures"]]
    drawn = data["figures"][titles.index({"text": "temperature, °C"})]["data"]
    assert [one["name"] for one in drawn] == ["imu_1", "imu_2", "imu_3"]
    assert 37.8 < min(drawn[0]["y"]) < max(drawn[0]["y"]) < 38.4


def test_two_replays_stand_side_by_side_over_the_same_axes(driver, folder, flight):
    path = folder / "both.html"
    other = folder / "other.json"
    words = [*REPLAY, "--fault", FAULTS[0], "--beside", str(flight)]
    words += ["--end", "40", "--report", str(path), "--json", str(other)]
    assert command_line.main(words) == 0
    figures = json.loads(other.read_text())
    assert figures["verdict"]["word"] == "FOUND"
    assert figures["beside"]["verdict"]["word"] == "HEALTHY"
    text = path.read_text()
    assert "<li class=good>A, cone_flight: 1 of 1 injected fault detected" in text
    assert "<li class=good>B, cone_flight: HEALTHY: " in text
    opened(driver, path)
    assert complaints(driver) == []
    charts = "sections.flatMap(s => s.plots)"
    titles = ask(driver, f"{charts}.map(c => c.title)")
    ranges = ask(driver, f"{charts}.map(c => [...c.x.range, ...c.y.range])")
    assert [title[0] for title in titles] == ["A", "B"] * (len(titles) // 2)
    assert len(titles) == 2 * 13
    for k in range(0, len(titles), 2):
        assert titles[k][1:] == titles[k + 1][1:]
        assert ranges[k] == ranges[k + 1], titles[k]
    # The fault of 0.2 rad/s shows on the left alone.
    offs = "columns([c.traces[0].curve], [25, 30], 1)[0]"
    left, right = ask(
        driver, f"{charts}.filter(c => c.title.includes('g2,')).map(c => {offs})"
    )
    assert left[0] > 0.1
    assert right[1] < 0.05
    across = "[...document.querySelectorAll('figure')].map(f => f.getBoundingClientRect().left)"
    columns = ask(driver, across)
    assert len({round(left) for left in columns}) == 2
    with phone(driver):
        wait(driver, f"new Set({across}).size === 1")
        assert ask(driver, "document.documentElement.scrollWidth") <= 390


def test_two_replays_of_different_gyros_stand_on_one_page(folder, root):
    path = folder / "unlike.html"
    table = folder / "still.csv"
    random = np.random.default_rng(3)
    names = [f"imu{k}_{axis}" for k in (1, 2) for axis in "xyz"]
    rows = np.column_stack([0.02 * np.arange(600), random.normal(0, 0.002, (600, 6))])
    head = ",".join(["time", *names])
    np.savetxt(table, rows, "%.6f", delimiter=",", header=head, comments="")
    crash = root / "bags" / "copter_crash.tlog"
    words = ["replay", str(table), "--beside", str(crash), "--report", str(path)]
    # The exit code is that of the worse verdict, here of the second.
    assert command_line.main(words) == 3
    layouts = [one["layout"] for one in data_of(path.read_text())["figures"]]
    assert {one["title"][0] for one in layouts} == {"A", "B"}
    in_degrees = [
        one["title"]
        for one in layouts
        if one.get("yaxis", {}).get("title", {}).get("text") == "temperature, °C"
    ]
    assert in_degrees == ["B"]
