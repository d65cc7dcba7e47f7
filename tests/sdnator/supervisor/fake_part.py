"""A part that does as it is told: get ready or not, beat or not, live or not."""

import json
import os
import signal
import sys
import time
from pathlib import Path

how, note, *rest = sys.argv[1:]
beats = int(rest[1]) if rest else -1
# so that a test sees the order of all starts and ends
with Path(note).open("a") as file:
    file.write(f"{how} started\n")


def end(*_):
    with Path(note).open("a") as file:
        file.write(f"{how} ended\n")
    os._exit(0)


signal.signal(signal.SIGTERM, end)
if how == "broken":
    sys.exit("no such interface veth9")
if how == "slow" and Path(note).read_text().count("slow started") > 1:
    time.sleep(600)
print(json.dumps({"ready": True, "how": how}), flush=True)
if how == "short":
    sys.exit(0)
if how == "silent":
    time.sleep(600)
while True:
    if beats >= 0:
        os.write(beats, b".")
    time.sleep(0.05)
