"""`sdnator up` behind Valkey's sentinels: a user for each app, also on the server that becomes the primary."""

import json

from sdnator.testing.sentinel_servers import SentinelServers
from tests.end_to_end.test_up import APPS, Operator, until


def test_up_goes_on_when_the_primary_is_killed(tmp_path):
    operator = Operator(tmp_path)
    with SentinelServers(tmp_path / "servers") as servers:
        checks = json.loads(operator.run("doctor", "--json", "--updates", servers.url).stdout)["checks"]
        assert {one["name"]: one["state"] for one in checks}["--updates"] == "ok"
        with operator.up("--updates", servers.url) as (_, said):
            found = until(operator.well)
            assert {found["apps"][app] for app in APPS} == {"active"}
            assert said["updates"] == servers.url.replace("://", "://…@"), "as a user of its own"
            assert "updates" not in said["parts"]
            old = servers.primary
            servers.kill(old)
            servers.wait_for_other(old)
            until(lambda: operator.run("observe", "due.health.firewall", "--count", "1").stdout.count("\n"))
            now = until(operator.well)
            assert {now["apps"][app] for app in APPS} == {"active"}
            pids = {name: part["pid"] for name, part in found["parts"].items()}
            assert {name: part["pid"] for name, part in now["parts"].items()} == pids, "none was restarted"
