"""What is not plausible, or too much, never reaches the registry: it is counted and told."""

from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from coordinator import admission
from coordinator.admission import EPOCH_STEP, MOST_EPOCH, Admission
from coordinator.registry import Checkpoint, Registry
from due.membership import Heartbeat, Registration
from due.messages import Capability, Interest

NOW = 100.0


class Door:
    """A registry behind its guard, as the service uses them."""

    def __init__(self) -> None:
        self.registry = Registry("c1", first_epoch=1000)
        self.registry.activate()
        self.admission = Admission(self.registry)

    def join(self, app: str = "app", name: str = "i1", said_by: str | None = None, **fields: Any) -> bool:
        fields = {"revision": 1, "heartbeat": 1.0, "started": 1} | fields
        message = Registration(app_id=app, instance_id=name, **fields)
        taken = self.admission.registration(message, app if said_by is None else said_by)
        if taken:
            self.registry.registered(message, NOW)
        return taken

    def beat(self, app: str = "app", **fields: Any) -> bool:
        message = Heartbeat(app_id=app, instance_id="i1", **({"revision": 1} | fields))
        taken = self.admission.heartbeat(message, app)
        if taken:
            self.registry.beat(message, NOW)
        return taken


@pytest.mark.parametrize("epoch", [2**64 - 1, MOST_EPOCH + 1, EPOCH_STEP + 1001, -1])
def test_an_absurd_epoch_does_not_stay_in_the_checkpoint(epoch: int) -> None:
    door = Door()
    assert door.join()
    assert not door.beat(epoch=epoch)
    door.registry.outgoing()
    assert door.registry.checkpoint().epochs["app"] <= 1001
    assert "epoch" in door.admission.last[-1].reason
    assert door.beat(epoch=5000), "it lives on"


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"app": "a b"}, "app id"),
        ({"app": "<b>x</b>"}, "app id"),
        ({"app": ""}, "app id"),
        ({"name": "x" * 1000}, "instance id"),
        ({"said_by": "other"}, "came from"),
        ({"heartbeat": float("nan")}, "heartbeat"),
        ({"heartbeat": 1e300}, "heartbeat"),
        ({"heartbeat": -1.0}, "heartbeat"),
        ({"revision": -1}, "revision"),
        ({"host": "h" * 1000}, "host"),
    ],
)
def test_what_is_not_plausible_is_refused(fields: dict[str, Any], reason: str) -> None:
    door = Door()
    assert not door.join(**fields)
    assert door.admission.refused == 1
    assert reason in door.admission.last[-1].reason
    assert door.registry.app_count() == 0


def test_names_of_shards_are_limited() -> None:
    door = Door()
    assert door.join(instances="sharded")
    assert door.beat(offered=("a.b",), held={"a.b": 1})
    assert not door.beat(offered=tuple(f"{number}.{'x' * 1000}" for number in range(1100)))


def test_apps_instances_and_keys_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(admission, "MOST_APPS", 2)
    monkeypatch.setattr(admission, "MOST_INSTANCES", 2)
    monkeypatch.setattr(admission, "MOST_KEYS", 3)
    door = Door()
    keys = (Capability("a"), Capability("b"))
    assert [door.join("p", name) for name in ("i1", "i2", "i3")] == [True, True, False]
    assert [door.join("q", capabilities=keys), door.join("r")] == [True, False]
    assert not door.beat("s")
    assert not door.join("p", "i2", interests=(Interest("a"), Interest("b")))
    assert door.join("q", revision=2, interests=(Interest("a"), Interest("b"), Interest("c")))
    assert door.admission.refused == 4


def test_epochs_of_apps_that_are_gone_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("coordinator.registry._MOST_EPOCHS", 3)
    registry = Registry("c1")
    for n in range(10):
        registry.beat(Heartbeat(app_id=f"a{n}", instance_id="i", revision=1, epoch=n), NOW)
        registry.outgoing()
        registry.expire(NOW)
    assert registry.epochs() == {"a7": 7, "a8": 8, "a9": 9}


def test_of_a_checkpoint_only_what_is_plausible_is_taken() -> None:
    door = Door()
    good = Registration(app_id="app", instance_id="i1", revision=1, heartbeat=1.0, started=1)
    bad = msgspec.structs.replace(good, instance_id="i2", heartbeat=float("nan"))
    found = Checkpoint(
        epochs={"app": 1234, "high": 2**64 - 1, "a b": 5}, active={"app": "i1"}, registrations=(good, bad)
    )
    taken = door.admission.checkpoint(found)
    assert taken == Checkpoint(epochs={"app": 1234}, active={"app": "i1"}, registrations=(good,))


_INTEGERS = st.integers() | st.sampled_from([2**53, 2**63, 2**64 - 1, -(2**63)])
_TEXTS = st.text(max_size=5) | st.sampled_from(["app", "x" * 300, "a.b", "\x00"])


@given(app=_TEXTS, name=_TEXTS, heartbeat=st.floats(), revision=_INTEGERS, epoch=_INTEGERS)
def test_whatever_is_said_the_registry_goes_on(
    app: str, name: str, heartbeat: float, revision: int, epoch: int
) -> None:
    door = Door()
    door.join(app, name, heartbeat=heartbeat, revision=revision)
    door.beat(app, epoch=epoch, revision=revision)
    door.registry.expire(NOW)
    for message in door.registry.outgoing():
        assert 0 <= message.epoch <= MOST_EPOCH
    msgspec.msgpack.encode(door.registry.checkpoint())
