"""A damaged checkpoint is said in the log, and the Coordinator starts without it."""

from typing import Any

import numpy as np
import pytest

from coordinator.checkpoint import KEY, Checkpoints
from coordinator.registry import Checkpoint
from due import DB_ONLY, Engine, Options
from due.drivers.embedded_redis import EmbeddedServer

DAMAGED: list[Any] = [
    "garbage",
    None,
    {"epochs": {"app": "many"}, "active": {}, "registrations": []},
    {"epochs": {}, "active": {"a": 1}, "registrations": []},
    {"epochs": {}, "active": {}, "registrations": [{"app_id": "a"}]},
    {},
    {"epochs": {}, "active": {}, "registrations": [np.ones(3)]},
    {"epochs": np.ones(2), "active": {}, "registrations": []},
]


@pytest.mark.parametrize("value", DAMAGED)
def test_a_damaged_checkpoint_is_left_out(tmp_path, caplog: pytest.LogCaptureFixture, value: Any) -> None:
    with EmbeddedServer(tmp_path / "u") as server:
        engine = Engine(Options(coordinated=False, directory=str(tmp_path)))
        engine.set_pubsub(server.url)
        engine.set_db(f"sqlite://{tmp_path}/a.db")
        engine.init("coordinator")
        engine.write(KEY, value, [DB_ONLY])
        found: list[Checkpoint] = []
        Checkpoints(engine)._find(found.append)
        engine.close()
    assert not found
    assert f"started without the checkpoint {KEY}" in caplog.text
