"""The pictures of the dashboard in docs/images: a house is attacked on live ports, and a browser looks on.

Nothing in them is cut, covered or empty. `SDNATOR_PICTURES=docs/images pytest` on this file takes them anew.
"""

import base64
import os
import threading
import time
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

import pytest

from sdnator.capture.interfaces import VethPair, WireFeed
from sdnator.datasets.mirai_like import MiraiLikeOptions, generate
from tests.end_to_end.test_bad_input import processes_of
from tests.end_to_end.test_dashboard import TABS, Page, browser, soon, unreadable
from tests.end_to_end.test_up import Operator, until
from tests.requirements import require_netns

TRAIN = 5_000
SPEED = 8
"""The house lives so many times faster than its clock says."""
HOUSE = MiraiLikeOptions(seed=4, benign_seconds=240, attack_seconds=2_400)
DESKTOP, PHONE = (1280, 1000), (390, 844)

PANELS = """
return [...document.querySelectorAll('.q-tab-panel .panel')].filter((one) => one.checkVisibility())
  .filter((one) => [...one.querySelectorAll('.nothing')].some((said) => said.checkVisibility()))
  .map((one) => one.innerText.split('\\n')[0])
"""
"""Panels that show nothing but words that there is nothing."""

WIDER = """
return [...document.querySelectorAll('.q-table__middle')].filter((one) => one.checkVisibility())
  .filter((one) => one.scrollWidth > one.clientWidth + 1).map((one) => one.innerText.split('\\n')[0])
"""
"""Tables of which a part lies beyond their edge, where nobody looks for it."""

NARROW = """
return [...document.querySelectorAll('.panel svg')].filter((one) => one.checkVisibility() && one.closest('.scores, .flow'))
  .filter((one) => one.getBoundingClientRect().width < one.closest('.scores, .flow').clientWidth - 1).length
"""
"""Charts that do not fill their place."""

CUT = """
return [...document.querySelectorAll('body *')]
  .filter((one) => one.checkVisibility({opacityProperty: true}) && !one.closest('svg, .q-tabs, i, input'))
  .filter((one) => [...one.childNodes].some((part) => part.nodeType === 3 && part.nodeValue.trim()))
  .filter((one) => ['hidden', 'clip'].includes(getComputedStyle(one).overflowX) && one.scrollWidth > one.clientWidth + 1)
  .map((one) => one.innerText)
"""
"""Texts of which an end is hidden."""

COVERED = """
const found = []
const seen = []
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT)
while (walker.nextNode()) {
  const one = walker.currentNode.parentElement
  if (!walker.currentNode.nodeValue.trim() || !one.checkVisibility({opacityProperty: true})) continue
  if (one.closest('i, svg')) continue
  const range = document.createRange()
  range.selectNodeContents(walker.currentNode)
  for (const box of range.getClientRects()) {
    if (box.width < 2 || box.height < 2) continue
    for (const [text, other] of seen) {
      const wide = Math.min(box.right, other.right) - Math.max(box.left, other.left)
      const high = Math.min(box.bottom, other.bottom) - Math.max(box.top, other.top)
      if (wide > 2 && high > 4) found.push(`${text} / ${walker.currentNode.nodeValue.trim()}`)
    }
    seen.push([walker.currentNode.nodeValue.trim(), box])
  }
}
return found
"""
"""Texts that lie over each other; a chart places its own."""


class House(threading.Thread):
    """Sends the frames of an infected house into an interface, until it is told to end."""

    def __init__(self, interface: str) -> None:
        super().__init__(daemon=True)
        self._feed = WireFeed(interface)
        self.ended = threading.Event()

    def run(self) -> None:
        began = time.monotonic()
        for frame in generate(HOUSE):
            wait = began + frame.time / 1e6 / SPEED - time.monotonic()
            if self.ended.wait(max(0.0, wait)):
                break
            self._feed.send((), (frame.length,), (frame.data,))
        self._feed.close()

    def end(self) -> None:
        self.ended.set()
        self.join()


@pytest.fixture
def attacked(tmp_path):
    """An operator whose pipeline learns what a house does, and then blocks its infected camera; traffic goes on."""
    require_netns()
    operator = Operator(tmp_path)
    operator.environment["SDNATOR_DASHBOARD_PORT"] = "0"
    with ExitStack() as stack:
        left, right = VethPair.make(stack, "picl"), VethPair.make(stack, "picr")
        ports = ("--port", f"1=veth:{left.far}", "--port", f"2=veth:{right.far}", "--train", str(TRAIN))
        _, said = stack.enter_context(operator.up(*ports, page=()))
        until(operator.well)
        house = House(left.near)
        house.start()
        stack.callback(house.end)
        yield operator, said
    assert processes_of(operator.mark) == []


def wait_for_a_block(operator):
    """Training alone may take longer, on a busy machine, than what `until` waits for."""
    deadline = time.monotonic() + 900
    while not operator.figures("blocks", "list"):
        assert time.monotonic() < deadline, operator.run("status").stdout
        time.sleep(1)


@pytest.mark.slow
@pytest.mark.timeout(1_800)
def test_pictures_show_everything_and_hide_nothing(attacked, tmp_path):
    """Each tab as a desktop and a phone show it, light and dark."""
    operator, _ = attacked
    folder = Path(os.environ.get("SDNATOR_PICTURES", tmp_path)).absolute()
    wait_for_a_block(operator)
    driver = browser()
    try:
        page = Page(driver, operator.run("user", "link").stdout.strip())
        page.find(".incidents", "blocked")
        page.find(".alerts .entry")
        page.find(".talkers td")
        assert soon(lambda: not driver.execute_script(PANELS)), driver.execute_script(PANELS)
        look_at(page, DESKTOP, "light", tmp_path)
        picture(page, folder / "dashboard-wide-light.png", DESKTOP)
        picture(page, folder / "dashboard-overview.png", DESKTOP, whole=True)
        look_at(page, PHONE, "dark", tmp_path)
        picture(page, folder / "dashboard-phone-dark.png", PHONE)
        for name in ("wide-light", "overview", "phone-dark"):
            assert (folder / f"dashboard-{name}.png").stat().st_size > 10_000
    finally:
        driver.quit()


def look_at(page, size, scheme, folder):
    """Every tab, without a flaw; in the end the first one is on show."""
    width, height = size
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    page.driver.execute_cdp_cmd("Emulation.setEmulatedMedia", media)
    resize(page, width, height)
    page.driver.refresh()
    page.find(".health", "uarding 1 switch")
    for tab in chain(TABS[1:], TABS[:1]):
        page.click(".q-tab", tab)
        page.find(".q-tab--active", tab)
        if tab == "Queries":
            page.click(".explain-now")
            page.find(".operators", "counting stage")
        picture(page, folder / f"{tab}-{width}-{scheme}.png".lower(), size, whole=True)
        where = f"{tab}, {scheme}, {width} wide"
        for flaws in (PANELS, WIDER, CUT, COVERED):
            assert soon(lambda flaws=flaws: not page.driver.execute_script(flaws)), (
                where,
                page.driver.execute_script(flaws),
            )
        assert soon(lambda: not unreadable(page)), (where, unreadable(page))


def resize(page, width, height):
    """The window's size; charts follow it."""
    metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    page.driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", metrics)


def picture(page, file, size, *, whole=False):
    """What the window shows, or the whole page in a window that is as high."""
    width, height = size
    page.driver.execute_script("scrollTo(0, 0); document.activeElement.blur()")
    page.driver.execute_cdp_cmd("Emulation.setScrollbarsHidden", {"hidden": True})
    page.driver.execute_cdp_cmd("Input.dispatchMouseEvent", {"type": "mouseMoved", "x": 400, "y": 5})
    if whole:
        resize(page, width, page.driver.execute_script("return document.documentElement.scrollHeight"))
    assert soon(lambda: not page.driver.execute_script(NARROW)), (
        file.name,
        "a chart does not fill its panel",
    )
    shot = page.driver.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})
    file.write_bytes(base64.b64decode(shot["data"]))
    if whole:
        resize(page, width, height)
