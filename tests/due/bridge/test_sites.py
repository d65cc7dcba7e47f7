"""Two sites with servers and Coordinators of their own: a cut link and a killed bridge lose nothing reliable."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks.chaos_links import UnixLink
from due import CONSUMER, PRODUCER, PUB_ONLY, Capability, Interest
from due.drivers.embedded_redis import EmbeddedServer
from tests.coordinator.test_service import Site, until

ROOT = Path(__file__).parents[3]
KEY, LOCAL = "plant.state.maker.temperature", "plant.state.maker.secret"
COUNT = 2_000


class TwoSites:
    """Near and far, and a bridge over a link that can be cut."""

    def __init__(self, folder: Path, near: EmbeddedServer, far: EmbeddedServer) -> None:
        self.near, self.far = (
            Site(folder / name, server.url) for name, server in (("near", near), ("far", far))
        )
        for site in (self.near, self.far):
            site.folder.mkdir()
            site.coordinator("coordinator")
        self.link = UnixLink(folder / "link.sock", Path(far.url.removeprefix("unix://")))
        self._credential = folder / "far.credential.json"
        self._credential.write_text(json.dumps({"updates": self.link.url}))
        self._credential.chmod(0o600)
        self.bridges: list[subprocess.Popen[str]] = []

    def bridge(self, **settings) -> subprocess.Popen[str]:
        """Start one."""
        file = self.near.folder / "bridge.json"
        file.write_text(json.dumps({"far": str(self._credential), **settings}))
        places = ["--updates", self.near.updates, "--archive", "memory://bridge"]
        command = [sys.executable, "-m", "due.bridge", "--settings", str(file), *places]
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        self.bridges.append(process)
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["ready"] is True
        return process

    def close(self) -> None:
        for process in self.bridges:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        self.link.close()
        self.near.close()
        self.far.close()


@pytest.fixture
def sites(tmp_path):
    with EmbeddedServer(tmp_path / "n") as near, EmbeddedServer(tmp_path / "f") as far:
        both = TwoSites(tmp_path, near, far)
        yield both
        both.close()


def maker(site):
    """Writes reliably what somebody wants."""
    engine = site.engine()
    capabilities = [Capability(key, delivery="reliable") for key in (KEY, LOCAL)]
    engine.init("maker", PRODUCER, capabilities=capabilities)
    return engine


def reader(site, key=KEY):
    engine, found = site.engine(), []
    engine.init("reader", CONSUMER, interests=[Interest(key)])
    engine.observe(key).subscribe(found.append)
    return found


def test_only_what_the_far_site_wants_crosses(sites):
    sites.bridge(to_far=["plant.state.**"])
    producer, found = maker(sites.near), reader(sites.far)
    until(lambda: producer.wanted(KEY))
    assert not producer.wanted(LOCAL)
    for number in range(COUNT):
        assert producer.write(KEY, number, [PUB_ONLY])
    until(lambda: len(found) == COUNT)
    assert [item.value for item in found] == list(range(COUNT))
    assert {item.app_id for item in found} == {"maker"}


def test_a_cut_link_and_a_killed_bridge_lose_nothing_reliable(sites):
    bridge = sites.bridge(to_far=["plant.state.**"])
    producer, found = maker(sites.near), reader(sites.far)
    until(lambda: producer.wanted(KEY))
    written = []
    for number in range(COUNT):
        written += [number] * producer.write(KEY, number, [PUB_ONLY])
        if number == COUNT // 4:
            until(lambda: found)
            sites.link.cut()
        if number == COUNT // 2:
            sites.link.mend()
        if number == 3 * COUNT // 4:
            producer.flush()
            bridge.kill()
            bridge.wait()
            sites.bridge(to_far=["plant.state.**"])
            until(lambda: producer.wanted(KEY))
    producer.flush()
    until(lambda: len(found) >= len(written))
    assert [item.value for item in found] == written
    assert len(written) == COUNT


def test_what_could_go_round_is_refused_at_the_start(sites):
    file = sites.near.folder / "bridge.json"
    file.write_text(json.dumps({"far": str(sites._credential), "to_far": ["a.**"], "to_near": ["a.b"]}))
    run = subprocess.run(
        [sys.executable, "-m", "due.bridge", "--settings", str(file), "--updates", sites.near.updates],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert run.returncode == 1
    assert "go round for ever" in run.stderr
