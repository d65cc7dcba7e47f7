"""The live Gantt page of a run, as a browser shows it."""

from manufacturing.core.orders import Scenario
from manufacturing.running.in_process import InProcessProduction
from manufacturing.running.page import GanttPage

from sdnator.testing.waiting import wait_for
from tests.end_to_end.test_dashboard import browser

SCENARIO = Scenario(name="ppe", seed=4, machines=3, orders=3, fraction=0.05)


def test_the_chart_fills_while_the_run_goes_on(tmp_path):
    """Bars come as prints end; at the end there is one for each print, and the page says that all is done."""
    from selenium.webdriver.common.by import By

    with (
        InProcessProduction(SCENARIO, "dynamic") as production,
        GanttPage(production.watcher.state) as page,
        browser() as driver,
    ):
        driver.get(page.url)

        def bars(kind=".print"):
            return len(driver.find_elements(By.CSS_SELECTOR, f"#chart rect{kind}"))

        def said(name):
            return driver.find_element(By.ID, name).text

        wait_for(bars, 60, lambda: driver.page_source)
        production.watcher.wait_done(60, 120)
        prints = [record for records in production.watcher.prints().values() for record in records]
        wait_for(lambda: said("link") == "all jobs done", 60, lambda: said("link"))
        assert said("done") == f"{len(prints)} of {len(prints)}"
        wait_for(lambda: bars() == len(prints), 30, bars)
        assert bars(".urgent") == sum(record.task.priority for record in prints)
        assert bars(".setup") == sum(record.setup > 0 for record in prints)
        # in one look: the page may draw its bars anew meanwhile
        words = (
            "return [...document.querySelectorAll('#chart rect.print title')].map(each => each.textContent)"
        )
        assert any("order 0: Finished" in title for title in driver.execute_script(words))
        driver.save_screenshot(str(tmp_path / "page.png"))
        assert [entry for entry in driver.get_log("browser") if entry["level"] == "SEVERE"] == []
