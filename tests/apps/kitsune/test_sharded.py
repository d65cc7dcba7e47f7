"""Kitsune by switch: detectors move with their checkpoints, and every packet keeps its score."""

import msgspec
import numpy as np
import pytest

from apps.kitsune.checkpoint import dump
from apps.kitsune.checkpoint_store import PART_BYTES, CheckpointStore
from apps.kitsune.detector import Detector, DetectorSettings
from apps.kitsune.model_instructions import ANSWER, INSTRUCTIONS
from apps.kitsune.packed_arrays import CheckpointError
from apps.kitsune.service import BLOCKS, KitsuneService, Settings
from apps.kitsune.sharded import CHECKPOINT, ShardedKitsune
from benchmarks.cluster_shards import (
    PACKETS_KEY,
    ROWS,
    SETTINGS,
    ShardStage,
    difference,
    disturbed,
    traffic,
)
from benchmarks.cluster_shards import SWITCHES as BOTH
from due import Item
from due.errors import ArchiveUnavailable
from tests.apps.firewall.enforcement.test_eve import decision
from tests.apps.hostile import Hands

PATHS = tuple(PACKETS_KEY.format(switch) for switch in BOTH)
PLACE = {"number": 3, "next": []}


def scores_without_moves():
    """By switch and first arrival, as one detector for each gives them."""
    wanted = {}
    for switch in BOTH:
        detector = Detector(DetectorSettings(**SETTINGS))
        for batch in traffic(switch):
            scored, _ = detector.process(batch, switch)
            wanted[switch, int(batch["arrival"][0])] = [scored.scores]
    return wanted


def test_kills_and_joins_change_no_score(tmp_path):
    """Real processes: kill -9 in training and afterwards; packets may be scored twice, always with the same score."""
    batches = {switch: list(traffic(switch)) for switch in BOTH}
    wanted = scores_without_moves()
    assert any(each[0].max() > 0 for each in wanted.values())
    found = disturbed(tmp_path, batches)
    assert found.scores.keys() == wanted.keys()
    assert difference(found.scores, wanted) == 0.0
    assert len(found.pauses_ms) >= 1, "the killed instances had a switch"
    assert found.checkpoints


def test_a_switch_moves_to_an_instance_that_joins_and_back_when_that_ends(tmp_path):
    batches = {switch: list(traffic(switch)) for switch in BOTH}
    with ShardStage(tmp_path) as stage:
        stage.member()
        stage.wait_wanted()
        stage.write(batches, 0, 10)
        stage.wait_scored(10)
        second = stage.member()
        at = 10
        while len(set(stage.writers.values())) < 2:
            stage.write(batches, at, at + 1)
            at += 1
            stage.wait_scored(at)
        second.process.terminate()
        assert second.process.wait(60) == 0
        stage.write(batches, at, at + 5)
        stage.wait_scored(at + 5)
        part = {key: each for key, each in scores_without_moves().items() if key[1] < (at + 5) * ROWS}
        assert difference(stage.scores, part) == 0.0


class ArchivingHands(Hands):
    """Hands with an archive in memory."""

    instance_id = "i1"

    def __init__(self):
        super().__init__()
        self.items, self.away, self.spooled = [], False, 0

    def keep_state(self, state, *, every):
        self.kept, self.every = state, every

    def write(self, key, value, *_, event_time=None):
        self.items.append(
            Item(key, value, len(self.items) + 1, event_time or 0, "kitsune", self.instance_id, 1)
        )
        self.spooled += self.away
        return True

    def flush(self, *_):
        """As an engine's: what is spooled is flushed."""

    def health(self):
        backlog = self.spooled if self.away else 0
        archive = {"spooled": self.spooled, "away": self.away, "backlog": backlog}
        return {**super().health(), "refused": 0, "archive": archive}

    def get(self, query, *, limit=None):
        if isinstance(query, str):
            query = {"dataKey": query}
        found = [
            item
            for item in self.items
            if (
                item.key == query["dataKey"]
                or (query["dataKey"] == BLOCKS and item.key.startswith(BLOCKS[:-1]))
            )
            and query.get("eventTime", item.event_time) == item.event_time
            and query.get("instanceId", item.instance_id) == item.instance_id
            and item.timestamp > query.get("timestamp", {}).get("$gt", -1)
            and item.timestamp < query.get("timestamp", {}).get("$lt", 1 << 63)
        ]
        return found[-limit:] if limit else found


def instance(engine, **settings):
    made = ShardedKitsune(engine, Settings(**SETTINGS, instances="sharded", **settings))
    made.start()
    return made


def score(made, switch, batches):
    for batch in batches:
        made._score(Item(PACKETS_KEY.format(switch), batch, 1, 1, "p4runtime_ctrl", "i", 1), batch)


def test_each_switch_has_a_detector_and_its_state_comes_back():
    engine = ArchivingHands()
    made = instance(engine, checkpoint_seconds=3.0)
    assert (engine.kept, engine.every) == (made, 3.0)
    assert [made.load(path) for path in PATHS] == [None, None]
    score(made, "s1", list(traffic("s1"))[:30])
    health = made.health()
    assert (health["packets"], health["switches"]) == (30 * ROWS, ["s1", "s2"])
    assert (health["models"]["s1"]["done"], health["models"]["s2"]["done"]) == (True, False)
    made.save(PATHS[0], PLACE)
    made.drop(PATHS[0])
    assert made.health()["switches"] == ["s2"]
    other = instance(engine)
    assert other.load(PATHS[0]) == PLACE
    assert other.health()["models"]["s1"] == health["models"]["s1"]


@pytest.mark.parametrize("damage", ["parts", "length", "bytes", "settings", "value"])
def test_a_checkpoint_that_cannot_be_used_is_logged_and_training_begins_again(damage, caplog):
    engine = ArchivingHands()
    made = instance(engine)
    made.load(PATHS[0])
    score(made, "s1", list(traffic("s1"))[:3])
    made.save(PATHS[0], PLACE)
    part, whole = engine.items = [item for item in engine.items if item.key.startswith(CHECKPOINT)]
    if damage == "parts":
        engine.items = [whole]
    elif damage == "settings":
        other = ShardedKitsune(engine, Settings(**SETTINGS | {"fm_grace": 501}, instances="sharded"))
        assert other.load(PATHS[0]) == PLACE
        assert "fm_grace=500, not 501" in caplog.text
        return
    elif damage == "value":
        engine.items[1] = msgspec.structs.replace(whole, value={"state": [1], "place": PLACE})
    elif damage == "length":
        whole.value["state"]["length"] += 1
    else:
        engine.items[0] = msgspec.structs.replace(part, value={"data": b"x" * len(part.value["data"])})
    other = instance(engine)
    assert other.load(PATHS[0]) == PLACE, "frames that the lost state contained are not sent again"
    assert "s1: its checkpoint cannot be used, training again" in caplog.text
    assert other.health()["packets"] == 0


def test_long_checkpoints_are_divided_and_while_the_archive_is_away_only_one_is_written():
    engine = ArchivingHands()
    store = CheckpointStore(engine, "network.checkpoint.kitsune")
    data = np.random.default_rng(1).bytes(2 * PART_BYTES + 5)
    store.save("a.b", data, PLACE)
    assert [len(item.value["data"]) for item in engine.items[:-1]] == [PART_BYTES, PART_BYTES, 5]
    assert store.load("a.b") == (data, PLACE)
    engine.away = True
    for _ in range(3):
        with pytest.raises(ArchiveUnavailable):
            store.save("a.b", b"later", PLACE)
    assert len(engine.items) == 5, "no whole without its parts"
    engine.away = False
    store.save("a.b", b"last", PLACE)
    assert store.load("a.b") == (b"last", PLACE)


def test_every_instance_heeds_all_blocks():
    engine = ArchivingHands()
    engine.write("network.block.firewall.ipv4", decision().to_value())
    engine.items[-1] = msgspec.structs.replace(engine.items[-1], app_id="firewall")
    made = instance(engine)
    made.load(PATHS[0])
    assert made.health()["blocked"] == 1
    assert made._works[PATHS[0]]._detector.senders.blocked is made._blocked


def test_instructions_about_the_model_are_refused_with_the_reason():
    engine = ArchivingHands()
    instance(engine)
    engine.hand(INSTRUCTIONS, INSTRUCTIONS, {"id": "o1", "verb": "retrain"})
    (answer,) = [item.value for item in engine.items if item.key == ANSWER]
    assert not answer["done"]
    assert 'instances = "standby"' in answer["text"]


def test_the_place_of_a_path_without_packets_is_kept():
    made = instance(ArchivingHands())
    assert made.load(INSTRUCTIONS) is None
    made.save(INSTRUCTIONS, PLACE)
    assert made.load(INSTRUCTIONS) == PLACE
    made.drop(INSTRUCTIONS)


def test_a_service_refuses_what_is_no_checkpoint_of_one():
    service = KitsuneService(Hands(), Settings(**SETTINGS))
    for beside in (None, [], [1], [1, [], [], []], ["x", *([[]] * 3)]):
        with pytest.raises(CheckpointError):
            KitsuneService.continued(Hands(), Settings(**SETTINGS), dump(service._detector, beside))


@pytest.mark.parametrize("seconds", [0, -1, float("nan"), 3601])
def test_seconds_between_checkpoints_have_limits(seconds):
    with pytest.raises(ValueError, match="checkpoint_seconds"):
        Settings(checkpoint_seconds=seconds)


def test_each_switch_has_a_model_file_of_its_own(tmp_path):
    made = instance(ArchivingHands(), save_model=str(tmp_path / "model.npz"))
    made.load(PATHS[1])
    score(made, "s2", list(traffic("s2"))[:30])
    made.stop()
    assert [file.name for file in tmp_path.iterdir()] == ["model.s2.npz"]
