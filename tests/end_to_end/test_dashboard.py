"""The dashboard as people use it: a real browser signs in, undoes a block, releases a guard, and their rules are gone."""

import json
import time
from pathlib import Path

import pytest

from apps.messages import Decision, Target
from due import DB_ONLY, PRODUCER, Capability, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from tests.end_to_end.test_bad_input import processes_of
from tests.end_to_end.test_up import Operator, until
from tests.requirements import missing, require_program

ADDRESS = "198.51.100.66"
GUARDED = "192.0.2.80"


def browser():
    """A headless Chromium under the driver's hand."""
    chromium, driver = require_program("chromium"), require_program("chromedriver")
    try:
        from selenium import webdriver
    except ImportError:
        missing("selenium is not installed")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(word)
    options.add_argument("--window-size=1280,900")
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))


def soon(condition):
    """Whether it comes about in a while; if not, the step before it is done again."""
    deadline = time.monotonic() + 15
    while time.monotonic() < deadline:
        if condition():
            return True
        time.sleep(0.1)
    return False


class Page:
    """What a person does with the page."""

    def __init__(self, driver, url):
        self.driver = driver
        self.obstacle = "nothing like it is shown"
        driver.get(url)

    def seen(self, selector, text=""):
        """The first visible element, None where there is none now; a page may change under one's eyes.

        The driver says so in several ways: mostly that an element is stale, now and then in the browser's words.
        """
        from selenium.common.exceptions import WebDriverException
        from selenium.webdriver.common.by import By

        try:
            for found in self.driver.find_elements(By.CSS_SELECTOR, selector):
                if found.is_displayed() and text in found.text:
                    return found
        except WebDriverException:
            pass
        return None

    def find(self, selector, text=""):
        """The first visible element, waited for."""
        return until(lambda: self.seen(selector, text))

    def click_now(self, selector, text=""):
        """Whether it was there to be clicked."""
        from selenium.common.exceptions import WebDriverException

        found = self.seen(selector, text)
        try:
            if found is not None:
                # the driver takes what lies under the fixed header for visible, and does not scroll by itself
                self.driver.execute_script("arguments[0].scrollIntoView({block: 'center'})", found)
                found.click()
        except WebDriverException as fault:  # something lies before it, or it is gone
            self.obstacle = str(fault)
            return False
        return found is not None

    def click(self, selector, text=""):
        until(lambda: self.click_now(selector, text), why=lambda: (selector, text, self.obstacle))

    def type_now(self, selector, text):
        """Over what is there; whether the field says so: the page may bring it up to date meanwhile."""
        from selenium.common.exceptions import WebDriverException
        from selenium.webdriver.common.keys import Keys

        field = self.seen(selector)
        try:
            if field is None:
                return False
            field.send_keys(Keys.CONTROL, "a")
            field.send_keys(text)
            return field.get_attribute("value") == text
        except WebDriverException:
            return False

    def sign_in(self, token, done, name=""):
        """Fill in the form; once more where a slow machine had the page loaded anew."""

        def attempt():
            if done():
                return True
            if self.type_now(".name input", name) and self.type_now(".token input", token):
                self.click_now(".sign-in-now")
                soon(done)
            return done()

        until(attempt)

    def shows(self, selector):
        from selenium.webdriver.common.by import By

        return bool(self.driver.find_elements(By.CSS_SELECTOR, selector))

    def text(self):
        return self.driver.execute_script("return document.body.innerText")


@pytest.fixture
def running(tmp_path):
    """An operator's pipeline with the page on a free port."""
    operator = Operator(tmp_path)
    operator.environment["SDNATOR_DASHBOARD_PORT"] = "0"
    guarded_before(tmp_path)
    with operator.up(page=()) as (_, said):
        yield operator, said
    assert processes_of(operator.mark) == []


def guarded_before(folder):
    """A guard in the archive, as a firewall leaves it that a flood made guard a service."""
    key, now = "network.protect.firewall.ipv4", time.time_ns()
    target = Target(kind="ip", address=GUARDED, port=80)
    guard = Decision(
        id="g1", action="protect", switch="*", target=target, reason="a flood", event_time=now,
        expires=now + 3_600 * 10**9,
    )  # fmt: skip
    archive = folder / "data" / "sdnator" / "archive.db"
    archive.parent.mkdir(parents=True)
    with EmbeddedServer(folder / "before") as server:
        places = {"updates": server.url, "archive": f"sqlite://{archive}", "directory": str(folder / "due")}
        engine = Engine(Options(**places, coordinated=False))
        engine.init(
            "firewall", PRODUCER, capabilities=[Capability(key, delivery="reliable", archive="always")]
        )
        engine.write(key, guard.to_value(), [DB_ONLY], event_time=now)
        engine.close()


def in_switch(operator, table, address):
    entries = operator.figures("tables", "s1", "--table", table)["entries"]
    return any(address in one["entry"] for one in entries)


@pytest.mark.timeout(480)
def test_who_has_signed_in_undoes_a_block_and_the_rule_is_gone(running):
    operator, said = running
    token = Path(said["token_file"]).read_text().strip()
    until(lambda: operator.figures("status")["apps"].get("firewall") == "active")

    def told():
        done = operator.run("blocks", "add", ADDRESS, "--reason", "a test")
        return done.returncode == 0 or "already blocked" in done.stderr

    until(told)
    until(lambda: in_switch(operator, "block_src", ADDRESS))
    until(lambda: in_switch(operator, "protect", GUARDED))
    driver = browser()
    try:
        page = Page(driver, said["dashboard"])
        page.find(".sign-in-now")
        assert not page.shows(".decisions"), "who has not signed in sees nothing"
        assert page.driver.execute_script(NAMELESS) == []
        assert unreadable(page) == []
        page.sign_in("not the token, but as long", lambda: page.seen(".fault", "wrong name and password"))
        as_a_viewer(operator, page)
        page.sign_in(token, lambda: page.seen(".sign-out"))
        page.driver.get_log("browser")  # it holds that the wrong password was refused

        for label, table, address in (("Undo", "block_src", ADDRESS), ("Release", "protect", GUARDED)):

            def gone(table=table, address=address):
                return not in_switch(operator, table, address)

            # what the page shows is no proof: it is empty for a moment after signing in
            until(lambda label=label, gone=gone: gone() or (page.click_now(".undo", label) and soon(gone)))
        page.find(".decisions", "nothing is blocked")
        look_around(page)
        for_everybody(page)
        who_did_what(operator, page)
        without_a_mouse(page)
        by_a_link(operator, page)
    finally:
        driver.quit()


def as_a_viewer(operator, page):
    """Who may only look sees the block and no way to undo it, and is out as soon as the user is removed."""
    password = "correct horse battery"  # noqa: S105
    done = operator.run("user", "add", "vera", "--password-stdin", given=password + "\n")
    assert done.returncode == 0, done.stderr
    page.sign_in(password, lambda: page.seen(".sign-out"), "vera")
    page.find(".who", "vera, viewer")
    page.find(".decisions", ADDRESS)
    page.find(".health", "uarding 1 switch")  # it was connected before the page was there
    assert not page.shows(".undo"), "who is no operator may only look"
    assert operator.run("user", "remove", "vera").returncode == 0
    page.find(".sign-in-now")


CONTRAST = """
const parse = (text) => { const n = text.match(/[0-9.]+/g).map(Number); return n.length < 4 ? [...n, 1] : n }
const over = (top, below) => [0, 1, 2].map((i) => top[i] * top[3] + below[i] * (1 - top[3]))
const light = (rgb) => rgb.map((v) => v / 255).map((v) => v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4)
  .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0)
const found = []
const paper = document.body.classList.contains('body--dark') ? [18, 18, 18] : [255, 255, 255]
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT)
while (walker.nextNode()) {
  const one = walker.currentNode.parentElement, style = getComputedStyle(one)
  if (!walker.currentNode.nodeValue.trim() || !one.checkVisibility({opacityProperty: true})) continue
  if (one.closest('[disabled], [aria-disabled=true]')) continue
  const layers = []
  let alpha = 1
  for (let at = one; at; at = at.parentElement) {
    layers.unshift(parse(getComputedStyle(at).backgroundColor))
    alpha *= Number(getComputedStyle(at).opacity)
  }
  const ground = layers.reduce((below, top) => over(top, below), paper)
  const ink = parse(one instanceof SVGElement ? style.fill : style.color)
  const text = over([...ink.slice(0, 3), ink[3] * alpha], ground)
  const [high, low] = [light(text), light(ground)].sort((a, b) => b - a)
  const ratio = (high + 0.05) / (low + 0.05), large = parseFloat(style.fontSize) >= 24 || one.matches('.q-icon')
  if (ratio < (large ? 3 : 4.5)) found.push(`${walker.currentNode.nodeValue.trim()}: ${ratio.toFixed(2)}`)
}
return found
"""
"""Texts, and icons, whose contrast with what is behind them is below WCAG's level AA."""


def unreadable(page):
    """Texts that people with weak eyes cannot read."""
    return page.driver.execute_script(CONTRAST)


TABS = ("Overview", "Machinery", "Queries", "Switches", "Archive")
NAMELESS = """
return [...document.querySelectorAll('button, a, input, [tabindex="0"], [role=tab]')]
  .filter((one) => one.checkVisibility({opacityProperty: true}))
  .filter((one) => !(one.innerText || one.getAttribute('aria-label') || one.labels?.[0]?.innerText || '').trim())
  .map((one) => one.outerHTML.slice(0, 200))
"""
"""What a screen reader has no word for."""


def for_everybody(page):
    """Every tab, light and dark, wide and on a phone: readable, nothing beyond the edge, a name for every control."""
    for scheme in ("light", "dark"):
        media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
        page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
        for width in (1280, 390):
            size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 600}
            page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
            page.driver.refresh()
            page.find(".health", "uarding 1 switch")
            assert page.driver.execute_script("return document.body.classList.contains('body--dark')") == (
                scheme == "dark"
            )
            for tab in TABS:
                page.click(".q-tab", tab)
                page.find(".q-tab--active", tab)
                where = f"{tab}, {scheme}, {width} wide"
                # a page that is just being drawn has texts between two colours
                assert soon(lambda: not unreadable(page)), (where, unreadable(page))
                assert page.driver.execute_script(
                    "return document.documentElement.scrollWidth <= innerWidth"
                ), where
                assert page.driver.execute_script(NAMELESS) == [], where
    page.driver.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


def without_a_mouse(page):
    """Tab, arrows and Enter reach the tabs, a query's plan and the sign-out."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    def press(*keys):
        ActionChains(page.driver).send_keys(*keys).perform()

    def on(selector):
        return page.driver.execute_script("return document.activeElement.matches(arguments[0])", selector)

    def reach(selector):
        for _ in range(60):
            if on(selector):
                return
            press(Keys.TAB)
        raise AssertionError(f"Tab never reaches {selector}")

    page.driver.refresh()
    page.find(".health", "uarding 1 switch")
    reach(".q-tab")
    press(Keys.ARROW_RIGHT, Keys.ENTER)
    page.find(".q-tab--active", "Machinery")
    press(Keys.ARROW_RIGHT, Keys.ENTER)
    page.find(".q-tab--active", "Queries")
    reach(".explain-now, .explain-now *")
    press(Keys.ENTER)
    page.find(".plan-said", "this is where it would run")
    reach(".sign-out")
    press(Keys.ENTER)
    page.find(".sign-in-now")


def who_did_what(operator, page):
    """The page's archive and the command line tell of the sign-ins and of what was undone."""
    page.click(".q-tab", "Archive")
    page.click(".audit-now")
    page.find(".found", "signed in")
    deeds = [(one["who"], one["deed"].split()[0]) for one in operator.figures("audit")["deeds"]]
    assert {("owner", "refused"), ("vera", "signed"), ("owner", "signed"), ("owner", "unblock")} <= set(deeds)


def by_a_link(operator, page):
    """It signs in at once, and only once."""
    link = operator.run("user", "link").stdout.strip()
    page.driver.get(link)
    page.find(".who", "owner, operator")
    page.driver.delete_all_cookies()
    page.driver.get(link)
    page.find(".fault", "has been used")


def look_around(page):
    """The other tabs show the parts, the switch, the archive; nothing comes from elsewhere."""
    page.click(".q-tab", "Machinery")
    until(lambda: all(name in page.text() for name in ("kitsune", "sonata_adapter", "active")))
    page.click(".q-tab", "Queries")
    # the firewall wants this one from the start
    page.find(".queries", "network.traffic_query.sonata.new_tcp")
    page.click(".explain-now")
    page.find(".plan-said", "this is where it would run")
    page.find(".operators", "counting stage")
    until(lambda: page.type_now(".query-key input", "network.traffic_query.sonata.new_tcp:window=1ms"))
    page.click(".explain-now")
    page.find(".plan-said", "100ms to 1h")
    page.click(".q-tab", "Switches")
    page.find(".tables", "block_src")
    page.click(".q-tab", "Archive")
    page.find(".said", "item")  # it opens with the incidents of the last day
    until(lambda: page.type_now(".search-key input", "network.block.firewall.*"))
    page.click(".search-now")
    page.find(".found", ADDRESS)
    names = page.driver.execute_script("return performance.getEntriesByType('resource').map(one => one.name)")
    origin = page.driver.execute_script("return location.origin")
    assert names
    assert [name for name in names if not name.startswith((origin, "data:", "blob:"))] == []
    faults = [one for one in page.driver.get_log("browser") if one["level"] == "SEVERE"]
    assert faults == [], json.dumps(faults)[:2000]
