"""Instances of an app have spools of their own, and what a dead one left is archived by the others."""

import os
import signal
import subprocess
import sys
from pathlib import Path

from due.codec import pack
from due.drivers.base import Spool
from due.drivers.spool_slots import SlottedSpool
from due.messages import Item, PackedFrame
from tests.due.conftest import wait_for

ROOT = Path(__file__).parents[3]


def _frame(n: int, instance: str = "i") -> PackedFrame:
    return pack([Item("a", bytes(10), n, n, "app", instance, n)])


def test_instances_do_not_take_each_others_frames(tmp_path: Path) -> None:
    one: Spool = SlottedSpool(tmp_path, 1 << 20)
    two: Spool = SlottedSpool(tmp_path, 1 << 20)
    one.put([_frame(1)])
    two.put([_frame(2), _frame(3)])
    one.adopt()
    two.adopt()
    assert one.take(9) == [_frame(1)]
    assert two.take(9) == [_frame(2), _frame(3)]
    two.done(1)
    assert (len(one), len(two)) == (1, 1)
    one.close()
    two.close()


def test_a_restarted_app_goes_on_with_what_was_left(tmp_path: Path) -> None:
    one, two = SlottedSpool(tmp_path, 1 << 20), SlottedSpool(tmp_path, 1 << 20)
    one.put([_frame(1)])
    two.put([_frame(2)])
    one.close()
    two.close()
    again = SlottedSpool(tmp_path, 1 << 20)
    again.adopt()
    assert len(again) == 2
    found = []
    while len(again):
        found += again.take(9)
        again.done(1)
    assert sorted(found, key=lambda frame: frame.sequence) == [_frame(1), _frame(2)]
    again.close()
    assert list(tmp_path.glob("*.db*")) == [], "empty spools leave nothing behind"


def test_a_living_instance_adopts_from_one_that_was_killed(tmp_path: Path) -> None:
    living = SlottedSpool(tmp_path, 1 << 20)
    code = (
        "import os, signal, sys\n"
        "from pathlib import Path\n"
        "from tests.due.drivers.test_spool_slots import _frame, SlottedSpool\n"
        f"spool = SlottedSpool(Path({str(tmp_path)!r}), 1 << 20)\n"
        "spool.put([_frame(7)])\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    killed = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert killed.returncode == -signal.SIGKILL
    living.adopt()
    assert living.take(9) == [_frame(7)]
    living.close()


def test_the_next_start_archives_what_a_killed_app_could_not(tmp_path, server, make_engine) -> None:
    """Its archive was away, it spooled and was killed; nothing else is written after the restart."""
    code = (
        "import os, signal, sys, time\n"
        "from due import *\n"
        f"engine = Engine(Options(updates={server.url!r}, directory={str(tmp_path / 'due')!r}, coordinated=False,\n"
        "    archive='mongodb://127.0.0.1:9/x?serverSelectionTimeoutMS=50'))\n"
        "engine.init('left')\n"
        "for number in range(100):\n"
        "    engine.write('a.b.left.item', number, [DB_ONLY])\n"
        "engine.flush()\n"
        "assert engine.health()['archive']['spooled'] == 100\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    killed = subprocess.run([sys.executable, "-c", code], env=environment, check=False)
    assert killed.returncode == -signal.SIGKILL
    engine = make_engine("left")
    wait_for(lambda: engine.health().get("archive", {}).get("backlog") == 0, 60)
    assert [item.value for item in engine.get("a.b.left.item")] == list(range(100))
