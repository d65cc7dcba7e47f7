"""Errors that come without end do not fill the disk, and none is forgotten; no line has a password in it."""

import logging
import re
from types import SimpleNamespace

import pytest

from due import NO_WAIT, PUB_ONLY
from due.logs import ConsoleFormatter, JsonFormatter, LogLimit
from tests.due.conftest import wait_for


def test_a_burst_is_logged_and_the_rest_counted(caplog, monkeypatch):
    now = 0.0
    monkeypatch.setattr("due.logs.time", SimpleNamespace(monotonic=lambda: now))
    limit = LogLimit(logging.getLogger("flood"), burst=3)
    for number in range(100):
        limit.error("number %d", number)
    assert caplog.messages == ["number 0", "number 1", "number 2"]
    now = 1.0
    limit.error("number %d", 100)
    assert caplog.messages[-1] == "number 100 (97 such errors before it are only counted)"


def test_a_callback_that_always_fails_writes_few_lines(make_engine, caplog):
    engine = make_engine("flooded")
    engine.observe("flood.all").subscribe(lambda item: 1 / item.value)
    for _ in range(500):
        engine.write("flood.all", 0, [PUB_ONLY])
    engine.write("flood.all", 0, [PUB_ONLY, NO_WAIT])
    wait_for(lambda: engine.health()["receiving"]["callback_errors"] == 501)
    told = len(re.findall("ZeroDivisionError: ", caplog.text))
    assert 0 < told < 100


@pytest.mark.parametrize("formatter", [ConsoleFormatter("kitsune"), JsonFormatter("kitsune")])
def test_passwords_of_urls_are_in_no_line(formatter):
    with pytest.raises(ConnectionError) as caught:
        raise ConnectionError("mongodb://me:hunter2'@there/db is away")
    trace = (caught.type, caught.value, caught.tb)
    record = logging.LogRecord(
        "due", logging.WARNING, "", 0, "lost %s", ("rediss://:p@ss:hunter2@10.0.0.5:6379/0",), trace
    )
    line = formatter.format(record)
    assert "hunter2" not in line
    assert "rediss://…@10.0.0.5:6379/0" in line
    assert "mongodb://…@there/db" in line
