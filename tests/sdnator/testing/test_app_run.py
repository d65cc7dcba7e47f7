"""An app's service runs in a test's own process, and the test sees what it does."""

import types

import msgspec
import numpy as np
import pytest

import apps.kitsune.service as kitsune
from apps.messages import sender_of
from apps.packets import PACKET_COLUMNS
from due import Capability, Interest, RecordBatch
from sdnator.errors import BadInput
from sdnator.testing import AppRun, NothingWritten
from sdnator.testing.packet_rows import blank
from tests.due.conftest import wait_for

PACKETS = "network.packets.p4runtime_ctrl.s1.all"


class EchoSettings(msgspec.Struct, frozen=True, kw_only=True):
    prefix: str = ""


class EchoService:
    """Writes what it hears."""

    def __init__(self, engine, settings):
        self.engine, self.settings, self.ticks = engine, settings, 0

    def start(self):
        self.engine.observe("lab.word.*.said").subscribe(
            lambda item: self.engine.write("lab.echo.echo.said", self.settings.prefix + item.value)
        )

    def tick(self):
        self.ticks += 1
        if self.settings.prefix == "broken":
            raise RuntimeError("a tick failed")

    def stop(self):
        self.engine.write("lab.echo.echo.last", "goodbye")

    def health(self):
        return {"ticks": self.ticks}


@pytest.fixture
def echo():
    module = types.ModuleType("echo")
    EchoService.__module__ = "echo"
    module.INTERESTS = (Interest("lab.word.*.said"),)
    module.CAPABILITIES = (Capability("lab.echo.echo.*"),)
    module.Settings, module.EchoService = EchoSettings, EchoService
    return module


def test_an_app_hears_what_it_is_fed_and_is_heard(echo):
    with AppRun(echo, prefix="> ") as app:
        app.feed("lab.word.somebody.said", "hello")
        (item,) = app.wait_for("lab.echo.**")
        assert (item.value, item.app_id) == ("> hello", "echo")
        assert app.written("lab.other.**") == []


def test_waiting_in_vain_says_what_came_instead(echo):
    with AppRun(echo) as app:
        app.feed("lab.word.somebody.said", "hello")
        app.wait_for("lab.echo.**")
        with pytest.raises(NothingWritten, match=r"lab\.echo\.echo\.said"):
            app.wait_for("lab.alert.**", seconds=0.01)


def test_a_tick_that_fails_fails_the_test(echo):
    app = AppRun(echo, prefix="broken").__enter__()
    wait_for(lambda: app.health()["ticks"])
    with pytest.raises(RuntimeError, match="a tick failed"):
        app.__exit__(None, None, None)


def test_settings_are_checked_like_those_of_a_file(echo):
    with pytest.raises(msgspec.ValidationError, match="prefix"):
        AppRun(echo, prefix=7)


def test_a_module_without_a_service_is_named(echo):
    del echo.EchoService
    with pytest.raises(BadInput, match="start, tick, stop, health"), AppRun(echo):
        pass


def test_kitsune_itself_runs_here():
    assert set(PACKET_COLUMNS)
    batch = blank(64)
    with AppRun(kitsune, reliable=[PACKETS], fm_grace=16, ad_grace=16) as app:
        app.feed(PACKETS, batch)
        (score,) = app.wait_for("network.anomaly.kitsune.score")
        assert len(score.value["score"]) == 64
        assert isinstance(batch, RecordBatch)
        assert np.isfinite(score.value["score"]).all()


def test_what_is_fed_is_written_by_the_app_that_its_key_names(echo):
    """Apps refuse messages under the key of another app, so a test must not write as a stranger."""
    echo.INTERESTS = (Interest("network.**"),)
    senders = []

    class Listener(EchoService):
        def start(self):
            self.engine.observe("network.**").subscribe(lambda item: senders.append(sender_of(item)))

    Listener.__module__ = "echo"
    echo.EchoService = Listener
    with AppRun(echo) as app:
        app.feed("network.packets.p4runtime_ctrl.s1.all", 1)
        app.feed("network.traffic_query.sonata.new_tcp", 2)
        app.feed("network.word.echo.said", 3)
        wait_for(lambda: len(senders) == 3)
        assert app.written() == []
    assert senders == ["p4runtime_ctrl", "sonata_adapter", "echo"]
