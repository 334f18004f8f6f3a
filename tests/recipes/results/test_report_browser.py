"""Reports in headless Chromium: `make browser`, which needs Chromium and its driver."""

import os
import shutil
from itertools import pairwise

import pytest

from recipes.cli import main
from recipes.recipe_json import recipe_from_json
from tests.recipes.results.report_runs import write_run
from tests.recipes.untrained import untrained
from torchrl_tit.settings.networks import enhanced_tit

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif("BROWSER_TESTS" not in os.environ, reason="`make browser` runs it"),
]

CONTRAST = """
const parse = (colour) => colour.match(/[\\d.]+/g).map(Number);
const luminance = ([r, g, b]) => {
  const linear = (x) => ((x /= 255) <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4);
  return 0.2126 * linear(r) + 0.7152 * linear(g) + 0.0722 * linear(b);
};
const background = (element) => {
  for (let e = element; e; e = e.parentElement) {
    const colour = parse(getComputedStyle(e).backgroundColor);
    if (colour.length === 3 || colour[3] > 0.9) return colour;
  }
  return [255, 255, 255];
};
const found = [];
for (const element of document.querySelectorAll("body *")) {
  const words = [...element.childNodes].filter((n) => n.nodeType === 3 && n.data.trim());
  if (!words.length || !element.checkVisibility() || element.closest("script, style")) continue;
  const style = getComputedStyle(element);
  const front = parse(element.closest("svg") ? style.fill : style.color);
  const [low, high] = [luminance(front), luminance(background(element))].sort((a, b) => a - b);
  const ratio = (high + 0.05) / (low + 0.05);
  if (ratio < 4.5) found.push(`${ratio.toFixed(2)} ${element.tagName} ${words[0].data.trim()}`);
}
return found;
"""
VISIBLE = """
return Object.fromEntries(charts.map((chart) => [
  chart.column,
  chart.element.data.filter((trace) => trace.visible !== false).map((trace) => trace.meta),
]));
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A report of two experiments, one of which has a film."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        write_run(folder / "tit" / f"seed-{seed}", seed=seed, returns=[470 - seed, 480, 490, 500])
    network = enhanced_tit(2, patch_size="auto", embed_dim=8, num_blocks=1, features_dim=8)
    mine = write_run(folder / "mine", "ppo/cartpole/mlp", returns=[9, 10], backbone=network)
    run = untrained(
        folder / "weights" / "run", recipe_from_json((mine / "recipe.json").read_bytes(), "")
    )
    run.checkpoints.rename(mine / "checkpoints")
    out = folder / "report.html"
    main(["report", str(folder / "tit"), str(mine), "--out", str(out)])
    return out


def open_page(page, **phone):
    from selenium import webdriver

    chromium, driver = shutil.which("chromium"), shutil.which("chromedriver")
    assert chromium, "Debian: apt-get install chromium"
    assert driver, "Debian: apt-get install chromium-driver"
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for option in (
        "--headless=new",
        "--no-sandbox",
        "--window-size=1280,900",
        "--host-resolver-rules=MAP * ~NOTFOUND",
    ):
        options.add_argument(option)
    if phone:
        metrics = {"width": 390, "height": 844, "pixelRatio": 2, "touch": True}
        options.add_experimental_option("mobileEmulation", {"deviceMetrics": metrics})
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    browser = webdriver.Chrome(options, webdriver.ChromeService(driver))
    browser.set_script_timeout(60)
    browser.get(page.as_uri())
    wait_for(browser, "return document.documentElement.dataset.ready === 'true'")
    return browser


def wait_for(browser, script):
    from selenium.webdriver.support.ui import WebDriverWait

    return WebDriverWait(browser, 60).until(lambda driver: driver.execute_script(script))


@pytest.fixture(scope="module")
def desktop(page):
    browser = open_page(page)
    yield browser
    browser.quit()


@pytest.fixture
def browser(desktop):
    """The page as it is when it is opened."""
    desktop.refresh()
    wait_for(desktop, "return document.documentElement.dataset.ready === 'true'")
    yield desktop
    assert desktop.get_log("browser") == [], "the console is quiet"


def click(browser, selector):
    browser.execute_script("document.querySelector(arguments[0]).click()", selector)


def visible(browser):
    """What each chart shows, as (group, run, kind)."""
    found = browser.execute_script(VISIBLE)
    return {
        column: {(meta["group"], meta.get("run"), meta["kind"]) for meta in traces}
        for column, traces in found.items()
    }


def axis_type(browser, column, axis):
    script = "return document.getElementById(arguments[0])._fullLayout[arguments[1]].type"
    return browser.execute_script(script, f"chart-{column}", axis)


def test_every_chart_has_data(browser):
    lines = browser.execute_script("""
      return charts.map(({ column, element }) => [
        column,
        element.querySelectorAll(".scatterlayer path.js-line, .boxlayer path.box").length,
        element.calcdata.flat().length,
        element.getBoundingClientRect().height,
      ]);
    """)
    assert len(lines) >= 8
    for column, paths, points, height in lines:
        assert paths >= 1, column
        assert points >= (4 if column == "evaluation-episodes" else 6), column
        assert height >= 250, column
    assert (
        browser.execute_script(
            "return performance.getEntriesByType('resource').map(e => e.name)"
            ".filter(name => !name.startsWith('data:'))"
        )
        == []
    )


def test_experiments_and_runs_are_switched_on_and_off(browser):
    at_first = visible(browser)
    assert (0, 2, "run") in at_first["return_mean"]
    click(browser, "#group-0")
    for column, shown in visible(browser).items():
        assert {group for group, *_ in shown} == {1}, column
    click(browser, "#group-0")
    assert visible(browser) == at_first
    click(browser, "#run-0-2")
    for column, shown in visible(browser).items():
        assert at_first[column] - shown <= {(0, 2, "run"), (0, 2, "episodes")}, column
        assert (0, 2, "run") not in shown
    click(browser, "#singles")
    assert {kind for *_, kind in visible(browser)["return_mean"]} == {"middle", "band"}
    click(browser, "#bands")
    assert {kind for *_, kind in visible(browser)["return_mean"]} == {"middle"}


def test_axes_are_switched(browser):
    assert axis_type(browser, "kl_approx", "xaxis") == "linear"
    click(browser, "#log-steps")
    assert axis_type(browser, "kl_approx", "xaxis") == "log"
    assert axis_type(browser, "return_mean", "xaxis") == "log"
    assert axis_type(browser, "evaluation-episodes", "xaxis") == "multicategory"
    click(browser, "#log-steps")
    button = "[data-log=entropy]"
    click(browser, button)
    pressed = f"return document.querySelector('{button}').getAttribute('aria-pressed')"
    assert (axis_type(browser, "entropy", "yaxis"), browser.execute_script(pressed)) == (
        "log",
        "true",
    )
    assert axis_type(browser, "kl_approx", "yaxis") == "linear"
    click(browser, button)
    assert (axis_type(browser, "entropy", "yaxis"), browser.execute_script(pressed)) == (
        "linear",
        "false",
    )


def test_the_mouse_reads_and_zooms(browser):
    from selenium.webdriver import ActionChains

    chart = browser.find_element("id", "chart-return_mean")
    browser.execute_script("arguments[0].scrollIntoView({block: 'center'})", chart)
    plot = chart.find_element("css selector", ".nsewdrag")
    ActionChains(browser).move_to_element_with_offset(plot, 40, 20).perform()
    wait_for(browser, "return document.querySelector('#chart-return_mean .hoverlayer text')")
    words = chart.find_element("css selector", ".hoverlayer").get_attribute("textContent")
    assert "tit, seed 2" in words
    assert "[" in words, "the interval"
    full = "return document.getElementById('chart-return_mean')._fullLayout.xaxis.range"
    before = browser.execute_script(full)
    drag = ActionChains(browser).move_to_element_with_offset(plot, -100, -60).click_and_hold()
    drag.move_by_offset(150, 100).release().perform()
    narrow = wait_for(
        browser,
        f"const r = (() => {{ {full} }})(); "
        f"return r[1] - r[0] < {0.5 * (before[1] - before[0])} && r",
    )
    assert before[0] < narrow[0] < narrow[1] < before[1]
    chart.find_element("css selector", "[data-title^='Reset']").click()
    wait_for(browser, f"const r = (() => {{ {full} }})(); return Math.abs(r[1] - {before[1]}) < 1")


def test_nothing_sends_a_chart_away(browser):
    titles = browser.execute_script(
        "return [...document.querySelectorAll('#chart-entropy .modebar-btn')]"
        ".map((button) => button.dataset.title)"
    )
    assert len(titles) == 6
    assert not [
        t for t in titles if any(w in t.lower() for w in ("cloud", "share", "link", "edit"))
    ]


def test_text_can_be_read(browser):
    assert browser.execute_script(CONTRAST) == []


def test_headings_are_in_order(browser):
    levels = browser.execute_script(
        "return [...document.querySelectorAll('h1, h2, h3')].map(h => Number(h.tagName[1]))"
    )
    assert levels.count(1) == 1
    assert all(below - above <= 1 for above, below in pairwise(levels))
    unnamed = browser.execute_script(
        "return [...document.querySelectorAll('input, button, video, [role=img], [role=region]')]"
        ".filter(e => !(e.labels?.length || e.ariaLabel || e.textContent.trim())).length"
    )
    assert unnamed == 0


def test_the_film_plays(browser):
    length = wait_for(browser, "return document.querySelector('video').duration || 0")
    assert length > 0.5
    browser.execute_script("document.querySelector('video').play()")
    wait_for(browser, "return document.querySelector('video').currentTime > 0.1")


def test_on_paper(browser):
    import base64

    paper = browser.execute_cdp_cmd("Page.printToPDF", {"preferCSSPageSize": True})
    assert base64.b64decode(paper["data"]).startswith(b"%PDF")
    assert browser.execute_script(
        "return [...document.querySelectorAll('details.prints')].every(d => d.open)"
    )
    widths = "return charts.map(({ element }) => element._fullLayout.width)"
    screen = browser.execute_script(widths)
    browser.execute_script("dispatchEvent(new Event('beforeprint'))")
    assert set(browser.execute_script(widths)) == {700, 338}
    browser.execute_script("dispatchEvent(new Event('afterprint'))")
    assert browser.execute_script(widths) == pytest.approx(screen, abs=20)


def test_on_a_phone(page):
    phone = open_page(page, phone=True)
    try:
        sizes = "return [innerWidth, document.documentElement.scrollWidth]"
        assert phone.execute_script(sizes) == [390, 390]
        widths = phone.execute_script(
            "return charts.map(({ element }) => element.getBoundingClientRect().width)"
        )
        assert min(widths) > 330
        modes = phone.execute_script("return charts.map(c => c.element._fullLayout.dragmode)")
        assert set(modes) == {False}, "a finger scrolls the page"
        assert phone.execute_script(CONTRAST) == []
        assert phone.get_log("browser") == []
    finally:
        phone.quit()
