"""A pipeline at its disk quota forgets measurements, and nothing that is in force."""

import time

from due.drivers.sqlite import SqliteArchive
from due.messages import Item
from tests.end_to_end.test_dashboard import in_switch
from tests.end_to_end.test_up import Operator, until

ADDRESS = "198.51.100.77"
CONFIGURATION = """
[up]
quota = 0.01
[coordinator]
retain_every_s = 1
"""
PIECES, PIECE = 600, 40_000


def test_a_block_outlives_the_quota_and_a_restart(tmp_path):
    file = tmp_path / "sdnator.toml"
    file.write_text(CONFIGURATION)
    operator = Operator(tmp_path)
    with operator.up("--config", str(file)) as (_, said):
        until(operator.well)
        done = operator.run("blocks", "add", ADDRESS, "--reason", "a test")
        assert done.returncode == 0, done.stderr
        until(lambda: in_switch(operator, "block_src", ADDRESS))
        archive = SqliteArchive(said["archive"])
        now = time.time_ns()
        archive.insert(
            [
                Item("test.weight", bytes(PIECE), now + n, now + n, "test", "t", n)
                for n in range(1, PIECES + 1)
            ]
        )
        newest = {"dataKey": "test.weight", "timestamp": {"$gt": now + PIECES - 20}}
        until(lambda: len(archive.find({"dataKey": "test.weight"})) < PIECES // 2)
        assert archive.find(newest)
        archive.close()
    with operator.up("--config", str(file)):
        until(operator.well)
        until(lambda: in_switch(operator, "block_src", ADDRESS))
