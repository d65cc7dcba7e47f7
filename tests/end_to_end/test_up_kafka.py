"""`sdnator up` on Kafka with TLS: a user for each app, all parts active, an enrolled app."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from sdnator.rights.identities import Identities
from sdnator.testing.kafka_servers import KafkaMissing, KafkaServers
from tests.end_to_end.test_up import APPS, Operator, until
from tests.requirements import missing

_GUEST = """
from sdnator_due import due, CONSUMER, PRODUCER
import sys, time
due.init("guest", PRODUCER | CONSUMER)
heard = []
due.observe("network.anomaly.guest.score").subscribe(lambda item: heard.append(item.value))
while not heard:
    due.write("network.anomaly.guest.score", 7)
    due.flush()
    time.sleep(0.2)
print(heard[0])
"""


@pytest.fixture(scope="module")
def kafka(tmp_path_factory):
    try:
        servers = KafkaServers(tmp_path_factory.mktemp("kafka"), secured=True).start()
    except KafkaMissing as reason:
        missing(str(reason))
    yield servers
    servers.stop()


def test_up_runs_on_kafka_with_a_user_for_each_app(kafka, tmp_path):
    operator = Operator(tmp_path)
    config = Path(operator.environment["XDG_CONFIG_HOME"]) / "sdnator" / "sdnator.toml"
    config.parent.mkdir(mode=0o700, parents=True)
    config.touch(mode=0o600)
    config.write_text(f'[up]\nupdates = "{kafka.admin_url}"\n')
    with operator.up() as (_, said):
        found = until(operator.well)
        assert {found["apps"][app] for app in APPS} == {"active"}
        state = Path(operator.environment["XDG_STATE_HOME"]) / "sdnator"
        identities = Identities(state)
        for app in ("firewall", "kitsune"):
            options = json.loads((state / f"{app}.engine.json").read_bytes())
            assert f"{identities.prefix}{app}:" in options["updates"], "no part has the super user"
        told = json.dumps(said) + operator.run("status").stdout
        assert kafka.admin_url not in told
        credential = tmp_path / "guest.json"
        keys = ("--publish", "network.anomaly.guest.*", "--observe", "network.anomaly.guest.*")
        done = operator.run("app", "enrol", "guest", *keys, "--out", str(credential))
        assert done.returncode == 0, done.stderr
        environment = {**os.environ, "DUE_CREDENTIAL": str(credential), "DUE_DIRECTORY": str(tmp_path / "g")}
        guest = subprocess.run(
            [sys.executable, "-c", _GUEST],
            env=environment,
            capture_output=True,
            text=True,
            timeout=100,
            check=False,
        )
        assert guest.stdout == "7\n", guest.stderr[-2000:]
        until(operator.well)
