"""A real Prometheus scrapes a running pipeline: every metric of dashboard and alerts is there, every rule is healthy."""

import json
import re
import subprocess
import urllib.parse
import urllib.request

import pytest

from sdnator.testing.ports import free_port
from tests.end_to_end.test_up import Operator, until
from tests.requirements import optional_program
from tests.test_deploy import DEPLOY, PREFIXES, expressions

CONFIGURATION = """\
global:
  scrape_interval: 1s
  evaluation_interval: 1s
scrape_configs:
  - job_name: sdnator
    file_sd_configs:
      - files: [{targets}]
        refresh_interval: 1s
rule_files: [{rules}]
"""


def ask(port, path, **query):
    """The data of an answer of Prometheus; None while it is not ready."""
    url = f"http://127.0.0.1:{port}/api/v1/{path}?{urllib.parse.urlencode(query)}"
    try:
        with urllib.request.urlopen(url, timeout=30) as answer:
            said = json.load(answer)
    except (OSError, ValueError):
        return None
    assert said["status"] == "success"
    return said["data"]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_prometheus_finds_what_dashboard_and_alerts_name(tmp_path):
    """Targets come from the file that `up` writes; nothing is taken from a list of ours."""
    prometheus = optional_program("prometheus")
    targets, chosen, port = tmp_path / "targets.json", tmp_path / "sdnator.toml", free_port()
    chosen.write_text(f'[metrics]\ntargets = "{targets}"\n', encoding="utf-8")
    made = tmp_path / "prometheus.yml"
    text = CONFIGURATION.format(targets=targets, rules=DEPLOY / "alerts.yml")
    made.write_text(text, encoding="utf-8")
    operator = Operator(tmp_path)
    with operator.up("--config", str(chosen)):
        until(operator.well)
        log = (tmp_path / "prometheus.log").open("w", encoding="utf-8")
        command = [prometheus, f"--config.file={made}", f"--storage.tsdb.path={tmp_path / 'tsdb'}"]
        command.append(f"--web.listen-address=127.0.0.1:{port}")
        with log, subprocess.Popen(command, stdout=log, stderr=log) as process:
            try:
                look(port, targets)
            finally:
                process.terminate()


def look(port, targets):
    """Every target is up, every name is known, every expression and rule is understood."""
    wanted = len(json.loads(targets.read_text(encoding="utf-8")))
    assert wanted >= 6
    until(lambda: (ask(port, "query", query="sum(up)") or {}).get("result"))
    until(lambda: ask(port, "query", query="sum(up)")["result"][0]["value"][1] == str(wanted))
    named = set()
    for _, expression in expressions():
        bare = re.sub(r'"[^"]*"', "", expression)
        named |= set(re.findall(rf"\b(?:{PREFIXES})_\w+", bare))
        assert ask(port, "query", query=expression) is not None, expression
    known = until(lambda: complete(port, named))
    assert named <= known
    rules = until(lambda: evaluated(port))
    assert {rule["health"] for rule in rules} == {"ok"}
    assert not [rule["name"] for rule in rules if rule["state"] == "firing"]


def complete(port, named):
    """All names that Prometheus knows, as soon as all the named ones are among them."""
    known = set(ask(port, "label/__name__/values"))
    return known if named <= known else None


def evaluated(port):
    """The alerting rules, once each of them was evaluated."""
    rules = [rule for group in ask(port, "rules")["groups"] for rule in group["rules"]]
    return rules if all(rule["health"] != "unknown" for rule in rules) else None
