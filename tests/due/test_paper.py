"""The listings of the paper run as they stand: in a fresh process, with nothing configured."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

LISTINGS = {
    "first app": """
        from sdnator_due import *
        key = "network.traffic.MyNewAppId.item"
        due.init("MyNewAppId", PRODUCER | CONSUMER)
        seen = []
        observer = due.observe(key)
        observer.subscribe(lambda data: seen.append(data.value))
        due.write(key, {"some": "value"}, [PUB_ONLY])
        due.flush()
        wait(lambda: seen == [{"some": "value"}])
    """,
    "archive": """
        from sdnator_due import *
        import datetime
        due.init("MyNewAppId", PRODUCER | CONSUMER)
        key = "network.traffic.MyNewAppId.item"
        some_date = datetime.datetime.now(datetime.timezone.utc)
        due.write(key, 1)
        due.write(key, 2, [DB_ONLY])
        due.write(key, 3, [PUB_ONLY])
        assert [data.value for data in due.get(key)] == [1, 2]
        found = due.get({"dataKey": key, "timestamp": {"$gt": some_date}})
        assert [data.value for data in found] == [1, 2]
        assert due.get({"dataKey": key, "timestamp": {"$lt": some_date}}) == []
        assert [data.value for data in due.get("network.*.MyNewAppId.**")] == [1, 2]
    """,
    "flags": """
        from sdnator_due import *
        due.init("MyNewAppId", PRODUCER | CONSUMER)
        seen = []
        due.observe("a.b.*").subscribe(lambda data: seen.append((data.key, data.value)))
        due.write("a.b.c", 1, [PUB_ONLY, NO_WAIT])
        wait(lambda: seen == [("a.b.c", 1)])
    """,
    "declarations": """
        from sdnator_due import *
        due.init(
            "MyNewAppId",
            PRODUCER | CONSUMER,
            interests=[Interest("a.b.*", frequency=1)],
            capabilities=[Capability("c.d.MyNewAppId:window=*", frequency=10, delivery="reliable")],
        )
        seen = []
        due.observe("c.d.*:window=3s").subscribe(lambda data: seen.append(data.value))
        assert due.write("c.d.MyNewAppId:window=3s", 5)
        wait(lambda: seen == [5])
    """,
    "urls": """
        from sdnator_due import *
        import os
        due.set_db("sqlite:///" + os.environ["DUE_DIRECTORY"].lstrip("/") + "/mine.db")
        due.set_pubsub(os.environ["SERVER"])
        due.init("MyNewAppId", PRODUCER)
        due.write("a.b.MyNewAppId", 1)
        due.flush()
        due.close()
        assert os.path.exists(os.environ["DUE_DIRECTORY"] + "/mine.db")
    """,
}
WAIT = """
import time
def wait(condition):
    end = time.monotonic() + 20
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)
"""


@pytest.mark.parametrize("listing", LISTINGS)
def test_listing(listing, tmp_path, server):
    environment = {
        **os.environ,
        "DUE_DIRECTORY": str(tmp_path),
        "PYTHONPATH": str(ROOT),
        "SERVER": server.url,
    }
    environment.pop("DUE_UPDATES", None)
    environment.pop("DUE_ARCHIVE", None)
    code = WAIT + textwrap.dedent(LISTINGS[listing])
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60, check=False
    )
    assert run.returncode == 0, run.stderr
    assert "Traceback" not in run.stderr


def test_two_scripts_without_configuration_meet(tmp_path):
    """The first starts the embedded server, the second joins it."""
    environment = {**os.environ, "DUE_DIRECTORY": str(tmp_path), "PYTHONPATH": str(ROOT)}
    observer = """
        from sdnator_due import *
        due.init("reader", CONSUMER)
        due.observe("a.b").subscribe(lambda data: print("got", data.value, flush=True))
        print("ready", flush=True)
        input()
    """
    writer = """
        from sdnator_due import *
        due.init("writer", PRODUCER)
        due.write("a.b", 42)
        due.close()
    """
    command = [sys.executable, "-c"]
    with subprocess.Popen(
        [*command, textwrap.dedent(observer)],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as first:
        assert first.stdout is not None
        assert first.stdout.readline() == "ready\n"
        subprocess.run([*command, textwrap.dedent(writer)], env=environment, timeout=60, check=True)
        assert first.stdout.readline() == "got 42\n"
        first.communicate("\n", timeout=30)
    assert first.returncode == 0


ALONE = """
import sys
NEEDED = {"due", "sdnator_due", "redis", "hiredis", "msgspec", "numpy", "reactivex", "typing_extensions"}
if sys.version_info < (3, 11, 3):
    NEEDED.add("async_timeout")  # redis-py brings it there

class NothingElse:
    def find_spec(self, name, path=None, target=None):
        top = name.partition(".")[0]
        if top not in NEEDED | sys.stdlib_module_names and not top.startswith("_"):
            raise ModuleNotFoundError(f"No module named {name!r} on this lean machine", name=name)

sys.meta_path.insert(0, NothingElse())
from sdnator_due import *
due.init("lean", PRODUCER | CONSUMER)
due.write("a.b.lean.item", {"some": [1, 2.5, b"x"]})
assert [item.value for item in due.get("a.b.**")] == [{"some": [1, 2.5, b"x"]}]
due.close()
print("works")
"""


def test_due_works_with_its_four_packages_and_nothing_else(tmp_path, server):
    """All other modules are hidden: an extra that creeps into the core fails here."""
    environment = {**os.environ, "DUE_DIRECTORY": str(tmp_path), "DUE_UPDATES": server.url}
    run = subprocess.run(
        [sys.executable, "-c", ALONE], capture_output=True, text=True, cwd=ROOT, env=environment, check=False
    )
    assert run.stdout == "works\n", run.stderr


def test_the_public_face_is_this_list():
    import due

    assert sorted(due.__all__) == sorted(
        [
            "CONSUMER", "DB_ONLY", "NO_WAIT", "PRODUCER", "PUB_ONLY", "Assignment", "Capability", "DueError", "Engine",
            "Interest", "Item", "Key", "Observation", "Options", "RecordBatch", "Role",
        ]
    )  # fmt: skip
    assert all(hasattr(due, name) for name in due.__all__)
