"""The dashboard under load: score summaries and alerts in, frames and memory out, in a headless Chromium.

    python -m benchmarks.dashboard --json dashboard.json                    half a minute
    python -m benchmarks.dashboard --json dashboard.json --seconds 600      the long run: is memory flat?

A producer writes updates at a fixed rate into an embedded server; the dashboard takes them and one page is
open.  Measured: updates taken a second; frames of the page by requestAnimationFrame, which headless Chromium
caps at 60, and the longest wait for one; updates of the figures that reach the page; memory of the dashboard
and of the page over time.
"""

import argparse
import json
import multiprocessing
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from apps.messages import Alert, Sender
from due import PRODUCER, Capability, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.rights.sign_in_link import new_link
from sdnator.supervisor import Child

SCORE, ALERT = "network.anomaly.kitsune.score", "network.anomaly.kitsune.alert"
_PACKETS = 16
_LOOK_SECONDS = 5.0
_FRAMES = """
if (window.frames_seen !== undefined) return false;
window.frames_seen = 0; window.plots_seen = 0; window.longest_gap = 0;
let before = performance.now();
const step = (now) => {
  window.frames_seen += 1; window.longest_gap = Math.max(window.longest_gap, now - before); before = now;
  requestAnimationFrame(step);
};
requestAnimationFrame(step);
new MutationObserver(() => { window.plots_seen += 1; })
  .observe(document.querySelector('.figures'), {subtree: true, childList: true, characterData: true});
return true;
"""
_SEEN = """
const gap = window.longest_gap; window.longest_gap = 0;
return [window.frames_seen, window.plots_seen, performance.memory.usedJSHeapSize, gap];
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--json", type=Path, required=True, metavar="FILE", help="where the figures go")
    parser.add_argument("--seconds", type=float, default=30.0, help="how long updates come")
    parser.add_argument("--rate", type=int, default=2_000, help="updates a second")
    chosen = parser.parse_args(argv)
    with tempfile.TemporaryDirectory(prefix="sdnator-dashboard-") as folder:
        found = measure(Path(folder), chosen.rate, chosen.seconds)
    chosen.json.write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")
    print(json.dumps({name: value for name, value in found.items() if name != "memory"}, indent=2))
    return 0


def measure(folder: Path, rate: int, seconds: float) -> dict[str, Any]:
    """One run."""
    with EmbeddedServer(folder / "server") as server:
        settings = folder / "settings.json"
        settings.write_text(json.dumps({"port": 0, "state": str(folder)}), encoding="utf-8")
        places = ("--updates", server.url, "--archive", f"sqlite://{folder}/archive.db")
        rest = ("--directory", str(folder / "due"), "--settings", str(settings), "--metrics", "127.0.0.1:0")
        child = Child("dashboard", ("sdnator.dashboard", *places, *rest), folder)
        try:
            ready = child.wait_ready(120)
            producer = multiprocessing.get_context("spawn").Process(
                target=produce, args=(server.url, str(folder), rate, seconds), daemon=True
            )
            with browser(new_link(folder, str(ready["dashboard"]))) as driver:
                producer.start()
                return watch(driver, child.pid, str(ready["metrics"]), seconds, rate)
        finally:
            child.stop()


def produce(url: str, folder: str, rate: int, seconds: float) -> None:
    """Write as Kitsune does: summaries, and one alert for twenty of them."""
    engine = Engine(
        Options(updates=url, archive=f"sqlite://{folder}/none.db", directory=f"{folder}/p", coordinated=False)
    )
    engine.init(
        "kitsune", PRODUCER, capabilities=[Capability(key, delivery="reliable") for key in (SCORE, ALERT)]
    )
    random, began, written = np.random.default_rng(1), time.monotonic(), 0
    while (now := time.monotonic() - began) < seconds:
        while written < now * rate:
            if written % 20:
                engine.write(SCORE, _summary(random, written))
            else:
                engine.write(ALERT, _alert(written).to_value())
            written += 1
        time.sleep(0.005)
    engine.flush()
    engine.close()


def _summary(random: np.random.Generator, number: int) -> dict[str, Any]:
    scores = random.lognormal(-4.0, 1.0, _PACKETS)
    return {
        "switch": "s1", "count": _PACKETS, "trained": 0, "over": int((scores >= 1).sum()),
        "max": float(scores.max()), "first_arrival": number * _PACKETS,
        "last_arrival": (number + 1) * _PACKETS - 1, "score": scores,
    }  # fmt: skip


def _alert(number: int) -> Alert:
    sender = Sender(switch="s1", port=1, mac="02:00:00:00:00:01", ip=f"192.0.2.{number % 250}")
    return Alert(
        id=str(number), sender=sender, event_time=time.time_ns(), first_packet=number, packets=100, over=60,
        peak_score=9.0, anomalous_seconds=3, rate=100.0, training_rate=5.0, mac_addresses=1,
        reason=f"60 of 100 packets of {sender.ip} scored over 1.0",
    )  # fmt: skip


@contextmanager
def browser(url: str) -> Iterator[Any]:
    """A headless Chromium on the page."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for word in ("--headless=new", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"):
        options.add_argument(word)
    options.add_argument("--enable-precise-memory-info")
    options.add_argument("--window-size=1280,900")
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(shutil.which("chromedriver")))
    try:
        driver.get(url)
        deadline = time.monotonic() + 60
        while not driver.execute_script("return !!document.querySelector('.figures')"):
            if time.monotonic() > deadline:
                raise TimeoutError(f"the page at {url} did not come")
            time.sleep(0.1)
        yield driver
    finally:
        driver.quit()


def watch(driver: Any, pid: int, metrics: str, seconds: float, rate: int) -> dict[str, Any]:
    """Look every few seconds until the producer is done."""
    looks: list[dict[str, float]] = []
    loads, frames_before, plots_before, frames, plots = 0, 0.0, 0.0, 0.0, 0.0
    began = time.monotonic()
    while time.monotonic() - began < seconds:
        if driver.execute_script(_FRAMES):  # a page that was loaded anew counts from 0
            loads, frames_before, plots_before = loads + 1, frames, plots
        time.sleep(min(_LOOK_SECONDS, seconds / 4))
        seen, drawn, heap, gap = (float(each or 0) for each in driver.execute_script(_SEEN))
        frames, plots = frames_before + seen, plots_before + drawn
        looks.append(
            {
                "at": time.monotonic() - began,
                "frames": frames,
                "longest_frame_ms": round(gap, 1),
                "page_updates": plots,
                "page_mib": round(heap / 2**20, 1),
                "dashboard_mib": resident_mib(pid),
                "dashboard_cpu_s": cpu_seconds(pid),
                "taken": taken(metrics),
            }
        )
    about = {"page_reloads": loads - 1, "seconds": seconds, "load": os.getloadavg()[0]}
    return {"updates_wanted_per_s": rate, **figures(looks), **about, "memory": looks}


def figures(looks: list[dict[str, float]]) -> dict[str, Any]:
    """What all looks together say; the page settles until the first."""
    first, last, third = looks[0], looks[-1], max(1, len(looks) // 3)
    span = last["at"] - first["at"]

    def grown(name: str) -> float:
        return last[name] - first[name]

    def mean(name: str, some: list[dict[str, float]]) -> float:
        return round(statistics.mean(each[name] for each in some), 1)

    return {
        "updates_taken_per_s": round(grown("taken") / span, 1),
        "dashboard_cores": round(grown("dashboard_cpu_s") / span, 3),
        "dashboard_cpu_us_per_update": round(1e6 * grown("dashboard_cpu_s") / max(1.0, grown("taken"))),
        "frames_per_s": round(grown("frames") / span, 1),
        "longest_frame_ms": max(each["longest_frame_ms"] for each in looks[1:]),
        "page_updates_per_s": round(grown("page_updates") / span, 1),
        "dashboard_mib_first_third": mean("dashboard_mib", looks[:third]),
        "dashboard_mib_last_third": mean("dashboard_mib", looks[-third:]),
        "page_mib_first_third": mean("page_mib", looks[:third]),
        "page_mib_last_third": mean("page_mib", looks[-third:]),
        "page_mib_least_last_third": min(each["page_mib"] for each in looks[-third:]),
    }


def resident_mib(pid: int) -> float:
    """Memory that a process holds."""
    pages = int(Path(f"/proc/{pid}/statm").read_text(encoding="ascii").split()[1])
    return round(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, 1)


def cpu_seconds(pid: int) -> float:
    """Processor time that a process has taken."""
    fields = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def taken(metrics: str) -> float:
    """Items that the dashboard has received, by its own metrics."""
    from urllib.request import urlopen

    with urlopen(f"http://{metrics}/metrics", timeout=10) as answer:
        text = answer.read().decode()
    lines = (line for line in text.splitlines() if line.startswith("due_received_items_total"))
    return sum(float(line.rpartition(" ")[2]) for line in lines)


if __name__ == "__main__":
    sys.exit(main())
