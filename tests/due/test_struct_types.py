"""msgspec 0.22 dies of two threads that are the first to use a type: an engine has all types used before."""

import subprocess
import sys

RACE = """
import sys, threading
from typing import Annotated
import msgspec
from due import Engine, Options

Text = Annotated[str, msgspec.Meta(max_length=9)]
fields = [(f"f{n}", Text) for n in range(5)]
kinds = [msgspec.defstruct(f"C{n}", [*fields, ("t", tuple[Text, ...])]) for n in range(1_500)]
engine = Engine(Options(updates="memory://", archive="memory://", coordinated=False))
engine.init("first")
sys.setswitchinterval(1e-6)
value = {**{f"f{n}": "x" for n in range(5)}, "t": ["y"]}
for kind in kinds:
    begin = threading.Barrier(2)
    def use():
        begin.wait()
        msgspec.convert(value, kind)
    both = [threading.Thread(target=use) for _ in range(2)]
    for thread in both: thread.start()
    for thread in both: thread.join()
engine.close()
print("alive")
"""


def test_two_threads_may_be_the_first_to_read_a_message():
    command = [sys.executable, "-c", RACE]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "alive"), done.stderr[-2000:]
