"""A real Prometheus scrapes a running pipeline: every expression of dashboard and alerts gives data, every rule is healthy."""

import json
import re
import subprocess
import urllib.parse
import urllib.request

import pytest

from sdnator.testing.ports import free_port
from tests.end_to_end.test_up import Operator, until
from tests.requirements import require_program
from tests.test_deploy import DEPLOY, PREFIXES, alerting_rules, expressions, panel_targets

CONFIGURATION = """\
global:
  scrape_interval: 1s
  evaluation_interval: 1s
scrape_configs:
  - job_name: with the token
    authorization: {{credentials_file: {token}}}
    file_sd_configs:
      - files: [{targets}]
        refresh_interval: 1s
  - job_name: without the token
    relabel_configs:
      - {{target_label: job, replacement: nobody}}
    file_sd_configs:
      - files: [{targets}]
        refresh_interval: 1s
rule_files: [{rules}]
"""
COMPARISON = re.compile(r"\s(==|<|>)\s\d+$")


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


def found(port, expression):
    """The series that an expression gives now, by their labels."""
    return [one["metric"] for one in (ask(port, "query", query=expression) or {}).get("result", ())]


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_prometheus_finds_what_dashboard_and_alerts_name(tmp_path):
    """Targets come from the file that `up` writes, and want a token; nothing is taken from a list of ours."""
    prometheus, promtool = require_program("prometheus"), require_program("promtool")
    targets, chosen, port = tmp_path / "targets.json", tmp_path / "sdnator.toml", free_port()
    token = tmp_path / "metrics.token"
    token.write_text("sixteen letters or more\n", encoding="utf-8")
    chosen.write_text(f'[metrics]\ntargets = "{targets}"\ntoken_file = "{token}"\n', encoding="utf-8")
    made = tmp_path / "prometheus.yml"
    text = CONFIGURATION.format(targets=targets, token=token, rules=DEPLOY / "alerts.yml")
    made.write_text(text, encoding="utf-8")
    operator = Operator(tmp_path)
    with operator.up("--config", str(chosen)):
        until(operator.well)
        subprocess.run([promtool, "check", "config", made], check=True, timeout=60)
        log = (tmp_path / "prometheus.log").open("w", encoding="utf-8")
        command = [prometheus, f"--config.file={made}", f"--storage.tsdb.path={tmp_path / 'tsdb'}"]
        command.append(f"--web.listen-address=127.0.0.1:{port}")
        with log, subprocess.Popen(command, stdout=log, stderr=log) as process:
            try:
                look(port, targets)
            finally:
                process.terminate()


def look(port, targets):
    """Every target is up, every name is known, every expression gives data, and no rule of a healthy pipeline fires."""
    wanted = len(json.loads(targets.read_text(encoding="utf-8")))
    assert wanted >= 6
    until(lambda: len(found(port, 'up{job="sdnator"} == 1')) == wanted)
    until(lambda: len(found(port, 'up{job="nobody"} == 0')) == wanted)
    assert not found(port, 'up{job="nobody"} == 1')
    named = set()
    for _, expression in expressions():
        named |= set(re.findall(rf"\b(?:{PREFIXES})_\w+", re.sub(r'"[^"]*"', "", expression)))
    assert named <= until(lambda: complete(port, named))
    for expression, legend in panel_targets():
        has_labels(port, expression, re.findall(r"{{\s*(\w+)\s*}}", legend))
    for rule in alerting_rules():
        summary = rule["annotations"]["summary"]
        has_labels(port, COMPARISON.sub("", rule["expr"]), re.findall(r"\$labels\.(\w+)", summary))
    rules = until(lambda: evaluated(port))
    assert {rule["health"] for rule in rules} == {"ok"}
    assert not [rule["name"] for rule in rules if rule["state"] == "firing"]


def has_labels(port, expression, labels):
    """It gives data, whatever a rate needs of time, and every series has the labels that a person will read."""
    given = until(lambda: found(port, expression))
    assert all(set(labels) <= series.keys() for series in given), (expression, labels, given)


def complete(port, named):
    """All names that Prometheus knows, as soon as all the named ones are among them."""
    known = set(ask(port, "label/__name__/values"))
    return known if named <= known else None


def evaluated(port):
    """The alerting rules, once each of them was evaluated."""
    rules = [rule for group in ask(port, "rules")["groups"] for rule in group["rules"]]
    return rules if all(rule["health"] != "unknown" for rule in rules) else None
