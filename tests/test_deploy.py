"""What lies in `deploy/` fits the product: options, settings, addresses and metrics exist.

No container engine and no running systemd is needed: files are read, and checked against the code.
"""

import json
import os
import re
import shlex
import stat
import subprocess
import sys
import time
from importlib import import_module
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

import msgspec
import pytest

import coordinator.service
from coordinator import metrics as coordinator_metrics
from coordinator.registry import Registry
from dataplane.__main__ import options as switch_options
from due import Engine
from due import metrics as due_metrics
from due import service as due_service
from sdnator import __version__
from sdnator.cli.main import COMMANDS
from sdnator.p4_program import find
from sdnator.supervisor.metrics import part_metrics
from sdnator.up import metrics_targets
from tests.requirements import require_program

yaml = pytest.importorskip("yaml", reason="PyYAML, which comes with mkdocs, is not installed")

ROOT = Path(__file__).resolve().parent.parent
DEPLOY = ROOT / "deploy"
APPS = {
    "coordinator": ("coordinator.service", "CoordinatorService"),
    "kitsune": ("apps.kitsune.service", "KitsuneService"),
    "sonata_adapter": ("apps.sonata_adapter.service", "SonataAdapterService"),
    "firewall": ("apps.firewall.service", "FirewallService"),
    "p4runtime_ctrl": ("apps.p4runtime_ctrl.service", "P4RuntimeCtrlService"),
    "dashboard": ("sdnator.dashboard.service", "DashboardService"),
}
PREFIXES = "|".join(("sdnator", "due", *APPS))
UNIT_VARIABLES = {"%i": "kitsune", "${METRICS}": "127.0.0.1:9472", "$SWITCH_PORTS": "--port 1=null"}
UNITS = sorted((DEPLOY / "systemd").glob("*.service"))


def compose():
    """compose.yaml as data, anchors and merges resolved."""
    return yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))


def settings(app):
    """The settings of one app as `deploy/settings` has them."""
    kind = import_module(APPS[app][0] if app in APPS else f"apps.enforcers.{app}.service").Settings
    return msgspec.json.decode((DEPLOY / "settings" / f"{app}.json").read_bytes(), type=kind)


def app_commands():
    """(where, words) of every command that starts an app of ours, in compose.yaml and the units."""
    found = [
        (name, [str(word) for word in service["command"]])
        for name, service in compose()["services"].items()
        if service.get("image") == "sdnator"
    ]
    for unit in UNITS:
        for line in re.findall(r"^ExecStart=(.*)$", unit.read_text(encoding="utf-8"), re.MULTILINE):
            words = line.replace("/opt/sdnator/bin/", "")
            for variable, value in UNIT_VARIABLES.items():
                words = words.replace(variable, value)
            found.append((unit.name, shlex.split(words)))
    return found


@pytest.mark.parametrize("app", [*APPS, "nftables"])
def test_settings_are_those_of_the_app(app):
    """Every option in `deploy/settings` exists and has a value that the app takes."""
    settings(app)


@pytest.mark.parametrize(("where", "words"), app_commands(), ids=lambda value: str(value)[:40])
def test_commands_have_only_options_that_exist(where, words):
    """Modules can be found and their options parse; addresses to listen on are loopback."""
    program, rest = words[0], words[1:]
    if program == "sdnator":
        assert rest == ["up"]
        return
    if program == "start-switch":
        arguments = switch_options().parse_args(rest)
        assert arguments.grpc.startswith("127.0.0.1:")
        return
    if program == "python":
        assert rest[0] == "-m"
        assert find_spec(rest[1])
        rest = rest[2:]
    else:
        assert program == "start-controller"
    arguments = due_service._parser(where).parse_args(rest)
    assert arguments.metrics.startswith("127.0.0.1:")


def test_compose_names_only_what_exists():
    """Mounted files exist, named volumes are declared, and whom a part waits for is there."""
    document = compose()
    for name, service in document["services"].items():
        for volume in service.get("volumes", []):
            source = volume.split(":")[0]
            assert (DEPLOY / source).exists() if source.startswith(".") else source in document["volumes"], (
                name
            )
        assert set(service.get("depends_on", {})) <= set(document["services"]), name
    built = document["services"]["kitsune"]["build"]
    assert (DEPLOY / built["context"] / built["dockerfile"]).is_file()


def test_compose_keeps_everything_on_loopback():
    """Nothing is published, and every part of others is told to listen on 127.0.0.1."""
    services = compose()["services"]
    assert all(service["network_mode"] == "host" and "ports" not in service for service in services.values())
    for name in ("updates", "archive", "bmv2", "prometheus"):
        assert "127.0.0.1" in " ".join(services[name]["command"]), name
    assert services["grafana"]["environment"]["GF_SERVER_HTTP_ADDR"] == "127.0.0.1"
    assert settings("coordinator").http_host == "127.0.0.1"


def test_the_coordinators_api_wants_a_token_everywhere():
    """And the dashboard has it; on loopback every user of the machine could read frames otherwise."""
    for name in ("coordinator", "dashboard"):
        assert coordinator.service.TOKEN in compose()["services"][name]["environment"], name
        unit = (DEPLOY / "systemd" / f"sdnator-{name}.service").read_text(encoding="utf-8")
        assert "EnvironmentFile=/etc/sdnator/coordinator.env" in unit, name


def test_every_variable_of_compose_has_an_example():
    """What compose.yaml expects of `.env` stands in env.example."""
    wanted = set(re.findall(r"(?<!\$)\$\{([A-Z_]+)", (DEPLOY / "compose.yaml").read_text(encoding="utf-8")))
    given = re.findall(r"^([A-Z_]+)=", (DEPLOY / "env.example").read_text(encoding="utf-8"), re.MULTILINE)
    assert wanted <= set(given)


def test_docker_build_takes_what_it_copies():
    """Every COPY has its source in the checkout, and the ignore file lets it through."""
    text = (DEPLOY / "Dockerfile").read_text(encoding="utf-8")
    sources = [
        source
        for line in re.findall(r"^COPY (?!--from)(.*)$", text, re.MULTILINE)
        for source in line.split()[:-1]
    ]
    ignore = (DEPLOY / "Dockerfile.dockerignore").read_text(encoding="utf-8").split()
    for source in sources:
        assert (ROOT / source).exists()
        assert f"!{source}" in ignore
    packages = {path.parent.name for path in ROOT.glob("*/__init__.py")} - {"tests", "benchmarks"}
    assert packages <= set(sources)


def test_prometheus_scrapes_every_part():
    """Its targets are the metrics addresses of compose.yaml and the Coordinator's API."""
    told = {words[words.index("--metrics") + 1] for _, words in app_commands() if "--metrics" in words}
    chosen = settings("coordinator")
    told.add(f"{chosen.http_host}:{chosen.http_port}")
    read = yaml.safe_load((DEPLOY / "prometheus.yml").read_text(encoding="utf-8"))
    targets = {
        target
        for job in read["scrape_configs"]
        for config in job["static_configs"]
        for target in config["targets"]
    }
    assert targets == told
    assert all((DEPLOY / name).is_file() for name in read["rule_files"])


@pytest.fixture(scope="module")
def exported():
    """Names of all metrics that the Coordinator's API, the engine and each app export."""
    told = (*coordinator_metrics._COUNTERS, *coordinator_metrics._SIZES)
    registry, counters = Registry("here"), dict.fromkeys(told, 0)
    text, _ = coordinator_metrics.render(registry, {"active": True, **counters}, 0.0)
    names = set(re.findall(r"^# TYPE (\S+)", text.decode(), re.MULTILINE))
    names |= {f"{name}_total" for name in names}
    names |= set(re.findall(r"^# TYPE (\S+)", part_metrics((), {}), re.MULTILINE))
    names |= {family.name for family in due_metrics._ENGINE.values()}
    program = find()
    for app, (module, service) in APPS.items():
        if app in {"coordinator", "dashboard"}:
            continue  # the one is above, of the other no figure is drawn
        own = import_module(module)
        chosen = settings(app)
        if app == "p4runtime_ctrl":
            paths = {"program": str(program.bmv2_json), "p4info": str(program.p4info)}
            chosen = msgspec.structs.replace(chosen, **paths)
        health = getattr(own, service)(Engine(), chosen).health()
        names |= set(re.findall(r"^# TYPE (\S+)", due_metrics.render(app, {}, health), re.MULTILINE))
    return names


def expressions():
    """(where, PromQL) of every panel, every alerting rule, and what the operations page names."""
    page = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    for name in re.findall(rf"`((?:{PREFIXES})_[a-z_]+)`", page):
        if name not in APPS:
            yield "operations.md", name
    dashboard = json.loads((DEPLOY / "grafana/dashboards/sdnator.json").read_text(encoding="utf-8"))
    for panel in dashboard["panels"]:
        for target in panel.get("targets", []):
            yield panel["title"], target["expr"]
    for rule in alerting_rules():
        if not rule["expr"].startswith("up{"):  # Prometheus' own
            yield rule["alert"], rule["expr"]


def alerting_rules():
    """The rules of alerts.yml."""
    read = yaml.safe_load((DEPLOY / "alerts.yml").read_text(encoding="utf-8"))
    return [rule for group in read["groups"] for rule in group["rules"]]


def panel_targets():
    """(PromQL, legend) of every curve and figure of the Grafana dashboard."""
    dashboard = json.loads((DEPLOY / "grafana/dashboards/sdnator.json").read_text(encoding="utf-8"))
    return [
        (target["expr"], target.get("legendFormat", ""))
        for panel in dashboard["panels"]
        for target in panel.get("targets", [])
    ]


@pytest.mark.parametrize(("where", "expression"), list(expressions()), ids=lambda value: str(value)[:60])
def test_metrics_of_dashboard_and_alerts_exist(exported, where, expression):
    """Every metric that a panel or a rule names is exported."""
    named = re.findall(rf"\b(?:{PREFIXES})_\w+", re.sub(r'"[^"]*"', "", expression))
    assert named
    assert set(named) <= exported


def promtool(*words):
    """What the tool of Prometheus says of our files; it must find them good."""
    done = subprocess.run(
        [require_program("promtool"), *words],
        cwd=DEPLOY,
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_prometheus_takes_configuration_and_rules():
    """With the rules that the configuration names."""
    assert f"{len(alerting_rules())} rules found" in promtool("check", "config", "prometheus.yml")


def test_alerting_rules_fire_when_they_should():
    """Each of them is tried, in a case in which it fires with its text and in one in which it does not."""
    assert "SUCCESS" in promtool("test", "rules", "alerts.test.yml")
    tried = yaml.safe_load((DEPLOY / "alerts.test.yml").read_text(encoding="utf-8"))["tests"]
    fired = {
        case["alertname"] for test in tried for case in test.get("alert_rule_test", ()) if case["exp_alerts"]
    }
    assert fired == {rule["alert"] for rule in alerting_rules()}


def test_alerts_know_the_jobs_that_are_scraped():
    """`MetricsAway` looks at the jobs of prometheus.yml and at that of the file which `up` writes."""
    read = yaml.safe_load((DEPLOY / "prometheus.yml").read_text(encoding="utf-8"))
    jobs = {job["job_name"] for job in read["scrape_configs"]}
    jobs |= {group["labels"]["job"] for group in metrics_targets.targets({"kitsune": "127.0.0.1:9472"})}
    (looked,) = (rule["expr"] for rule in alerting_rules() if rule["alert"] == "MetricsAway")
    assert set(re.findall(r'=~"([^"]+)"', looked)[0].split("|")) == jobs


def test_dashboard_uses_the_provisioned_data_source():
    """Panels ask the data source that the provisioning file makes, and none overlaps another."""
    dashboard = json.loads((DEPLOY / "grafana/dashboards/sdnator.json").read_text(encoding="utf-8"))
    source = yaml.safe_load((DEPLOY / "grafana/provisioning/datasources/prometheus.yaml").read_text("utf-8"))
    uids = {one["uid"] for one in source["datasources"]}
    cells: set[tuple[int, int]] = set()
    for panel in dashboard["panels"]:
        place = panel["gridPos"]
        own = {
            (x, y)
            for x in range(place["x"], place["x"] + place["w"])
            for y in range(place["y"], place["y"] + place["h"])
        }
        assert not cells & own, panel["title"]
        cells |= own
        assert {target["datasource"]["uid"] for target in panel.get("targets", [])} <= uids


def test_controller_learns_when_the_clock_of_the_switch_began(tmp_path):
    """start-switch notes the time, start-controller puts it into the settings; a second start changes nothing."""
    python = tmp_path / "python"
    python.write_text('#!/bin/sh\necho "$@" >> said\n[ -t 0 ] || cat > given\n', encoding="utf-8")
    python.chmod(python.stat().st_mode | stat.S_IXUSR)
    folders = {"SDNATOR_RUN": str(tmp_path), "SDNATOR_ETC": str(DEPLOY / "settings")}
    environment = os.environ | folders | {"PATH": f"{tmp_path}:{os.environ['PATH']}"}
    switch = ("start-switch", "--grpc=127.0.0.1:0")
    for script, option in (switch, switch, ("start-controller", "--stay")):
        subprocess.run(
            [DEPLOY / script, option],
            env=environment, cwd=tmp_path, stdin=subprocess.DEVNULL, check=True, timeout=60,
        )  # fmt: skip
    said = (tmp_path / "said").read_text(encoding="utf-8").splitlines()
    assert said[0] == said[1]
    zero = re.fullmatch(r"-m dataplane --base-us (\d+) --grpc=127.0.0.1:0", said[0])
    assert zero
    assert 0 < int(zero[1]) <= time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1_000
    assert said[2] == "-m apps.p4runtime_ctrl.service --stay --settings /dev/stdin"
    given = json.loads((tmp_path / "given").read_text(encoding="utf-8"))
    noted = int((tmp_path / "base_us").read_text(encoding="utf-8"))
    assert given["switches"][0]["base_us"] == noted > 1_500_000_000_000_000


def test_nftables_has_the_right_that_it_needs_and_no_other_app_has_it():
    """As a unit, in the unit of the whole pipeline, and the program in the image."""
    texts = {unit.name: unit.read_text(encoding="utf-8") for unit in UNITS}
    may = {name for name, text in texts.items() if "CAP_NET_ADMIN" in text}
    assert may == {"sdnator-nftables.service", "sdnator-switch.service", "sdnator.service"}
    for name in ("sdnator-nftables.service", "sdnator.service"):
        assert re.search("^AmbientCapabilities=.*CAP_NET_ADMIN", texts[name], re.MULTILINE)
        assert re.search("^RestrictAddressFamilies=.*AF_NETLINK", texts[name], re.MULTILINE)
    assert " nftables " in (DEPLOY / "Dockerfile").read_text(encoding="utf-8")
    for enforcer in ("nftables", "webhook_enforcer"):
        assert find_spec(f"apps.enforcers.{enforcer}.service")


def script(name, monkeypatch):
    """A program of `deploy/` as a module, which finds its neighbours as when it runs."""
    monkeypatch.syspath_prepend(DEPLOY)
    loaded = spec_from_file_location(name, DEPLOY / f"{name}.py")
    module = module_from_spec(loaded)
    loaded.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("score", "differs"),
    [
        ("0.25", ""),
        ("0.25000000000000006", ""),
        ("0.2500000001", "scores.csv"),
        ("0.25", "features.npy"),
        ("0.25", "alerts.csv"),
    ],
)
def test_a_foreign_wheel_must_find_what_ours_finds(tmp_path, monkeypatch, score, differs):
    """Whichever of the files that are compared differs, the wheel is refused with its name; a score's last bit may."""
    trial = script("try_aarch64", monkeypatch)

    def run(_, program, *words, **__):
        if trial.SCORES in words:
            out, foreign = Path(words[-1]), program == "qemu-aarch64-static"
            out.mkdir()
            for name in trial.EQUAL:
                (out / name).write_text(f"{foreign and name == differs}")
            (out / trial.SCORES_FILE).write_text(f"index,score\n0,{score if foreign else 0.25}\n")
        return "aarch64 3.11.2\n"

    monkeypatch.setattr(trial, "_run", run)
    monkeypatch.setattr(trial, "_foreign_root", lambda folder: folder / "usr/bin/python3.11")
    arguments = (tmp_path / "a.whl", Path("here"), tmp_path)
    if not differs:
        trial.try_aarch64(*arguments)
        return
    with pytest.raises(trial.TrialFailed, match=f"{differs} of aarch64 differs"):
        trial.try_aarch64(*arguments)


def test_a_compiler_without_headers_is_none(tmp_path, monkeypatch):
    """Debian's cross compiler comes without those of the C library, which are a package of their own."""
    make_dist = script("make_dist", monkeypatch)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    for code, works in ((0, True), (1, False)):
        (tmp_path / "some-gcc").write_text(f"#!/bin/sh\nexit {code}\n", encoding="utf-8")
        (tmp_path / "some-gcc").chmod(0o755)
        assert make_dist.compiles("some-gcc") is works
    assert make_dist.compiles("no-such-gcc") is False


def test_the_bill_of_materials_is_about_this_release(tmp_path, monkeypatch):
    """Its main component has the version, which the project's file does not hold."""
    make_dist = script("make_dist", monkeypatch)

    def written(*words):
        told = {"metadata": {"component": {"name": "sdnator"}}, "components": []}
        Path(words[-1]).write_text(json.dumps(told), encoding="utf-8")

    monkeypatch.setattr(make_dist, "run", written)
    make_dist.bill_of(Path(sys.executable), tmp_path / "bill.json")
    told = json.loads((tmp_path / "bill.json").read_text(encoding="utf-8"))
    assert told["metadata"]["component"] == {"name": "sdnator", "version": __version__}


def test_units_of_the_documents_exist_with_what_they_read():
    """Each unit that an operator is told to enable is there, its settings too, and its files are in the table."""
    page = (ROOT / "docs" / "operations.md").read_text(encoding="utf-8")
    told = {
        unit
        for line in re.findall(r"^# systemctl enable --now (.*)$", page, re.MULTILINE)
        for unit in line.split()
    }
    files = {unit.name.partition(".service")[0]: unit.read_text(encoding="utf-8") for unit in UNITS}
    assert {unit.partition("@")[0] + "@" * ("@" in unit) for unit in told} == files.keys() - {"sdnator"}
    for unit in told:
        name, _, instance = unit.partition("@")
        text = files[name + "@" * bool(instance)].replace("%i", instance)
        for file in re.findall(r"^EnvironmentFile=-?/etc/sdnator/(\S+)$", text, re.MULTILINE):
            assert f"`{file}`" in page, file
        for file in re.findall(r"--settings /etc/sdnator/(\S+)", text):
            assert (DEPLOY / "settings" / file).is_file()
        for module in re.findall(r"python -m (\S+)", text):
            assert find_spec(module), module


def test_units_are_what_systemd_understands(tmp_path):
    """`systemd-analyze verify` finds nothing to say, with our programs where they are here."""
    analyze = require_program("systemd-analyze")
    programs = str(Path(sys.executable).parent)
    for unit in UNITS:
        text = unit.read_text(encoding="utf-8").replace("/opt/sdnator/bin/start-", f"{DEPLOY}/start-")
        (tmp_path / unit.name).write_text(text.replace("=/opt/sdnator/bin", f"={programs}"), encoding="utf-8")
    names = [f"{tmp_path}/{unit.name}" for unit in UNITS]
    done = subprocess.run(
        [analyze, "verify", *names], capture_output=True, text=True, check=False, timeout=120
    )
    ours = [line for line in done.stderr.splitlines() if "sdnator" in line]
    assert not ours


def test_the_man_page_is_one():
    """mandoc misses nothing but a date, which a page made from the code has not, and shows every command."""
    said = {}
    for form in ("lint", "ascii"):
        done = subprocess.run(
            [require_program("mandoc"), "-T", form, "-W", "warning", "sdnator.1"],
            cwd=ROOT / "docs" / "reference", capture_output=True, text=True, check=False, timeout=60,
        )  # fmt: skip
        said[form] = done.stdout
    assert [line for line in said["lint"].splitlines() if "missing date" not in line] == []
    shown = re.sub(".\b", "", said["ascii"])
    assert [name for name in COMMANDS if f"sdnator {name}" not in shown] == []
