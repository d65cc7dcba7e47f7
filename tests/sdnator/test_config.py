"""A configuration is read once, checked as a whole, and every fault is named with its line and a remedy."""

import json
import tomllib

import pytest
from typer.testing import CliRunner

from sdnator.cli.config_commands import example_lines
from sdnator.cli.main import app
from sdnator.config import config_file
from sdnator.config.config_file import WrongConfiguration, load, option_paths, variable
from sdnator.config.config_lines import lines_of
from sdnator.config.config_model import LISTS, fields, sections
from sdnator.config.config_texts import texts


def run(*words, **environment):
    return CliRunner().invoke(app, ["config", *words], env=environment)


def faults(tmp_path, text, environment=None):
    path = tmp_path / "sdnator.toml"
    path.write_text(text)
    with pytest.raises(WrongConfiguration) as caught:
        load(path, environment or {})
    return [str(fault).replace(str(path), "FILE") for fault in caught.value.faults]


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("[kitsune]\nthreshhold = 1.5", "FILE:2: kitsune.threshhold: there is no such option; did you mean threshold?"),
        ("[kitsune]\n\nmax_ae = 0", "FILE:3: kitsune.max_ae: max_ae=0: must be at least 1"),
        ('[kitsune]\nfm_grace = "5"', 'FILE:2: kitsune.fm_grace: "5": give a whole number'),
        ("[kitsune]\nfm_grace = true", "FILE:2: kitsune.fm_grace: true: give a whole number"),
        ("[firewal]\nx = 1", "FILE:1: firewal: there is no such section; did you mean firewall?"),
        ('[log]\nlevel = "loud"', "FILE:2: log.level: \"loud\" is none of 'debug', 'info', 'warning' or 'error'"),
        ("[firewall.rules]\ndry_rum = true", "FILE:2: firewall.rules.dry_rum: there is no such option; did you mean dry_run?"),
        ("[up]\nquota = 0", "FILE:2: up.quota: quota=0.0: must be at least 0.01 GiB"),
        ("[up]\nprocesses = { kitsune = 0 }", "FILE:2: up.processes: processes={kitsune: 0}: must be 1 to 64 of each app"),
        ("[up]\nretain_every_s = 5", "FILE:2: up.retain_every_s: there is no such option; it belongs to coordinator.retain_every_s"),
        ('[coordinator]\nlasting_keys = ["a..b"]', "FILE:2: coordinator.lasting_keys: lasting_keys=a..b: invalid key 'a..b' at position 2: a segment is '*', '**' or one or more of A-Z a-z 0-9 _ -"),
        ("schema = 2", "FILE:1: schema: 2 is not supported; this version reads 1: see CHANGELOG for what changed"),
        ('[[switches]]\n[[switches]]\nname = "s1"', "FILE:3: switches[1].name: there are two switches named s1"),
        ('[[switches]]\nkind = "there"', "FILE:1: switches[0]: --switch there: give embedded, bmv2, HOST:PORT or unix:/PATH"),
        ("[p4runtime_ctrl]\nswitches = []", "FILE:2: p4runtime_ctrl.switches: there is no such option; see `sdnator config example`"),
    ],
)  # fmt: skip
def test_each_fault_is_named_with_its_line_and_what_would_do(tmp_path, text, fault):
    assert faults(tmp_path, text) == [fault]


def test_all_faults_are_named_at_once(tmp_path):
    found = faults(tmp_path, "[kitsune]\nmax_a = 1\nad_grace = 1.5\n[logs]\n")
    assert [fault.split(": ")[1] for fault in found] == ["kitsune.max_a", "kitsune.ad_grace", "logs"]


def test_a_misspelt_option_hides_no_fault_of_another_section(tmp_path):
    found = faults(tmp_path, '[kitsune]\nmax_a = 1\n[up]\nquota = 0\n[[switches]]\nname = "a b"\n')
    assert [fault.split(": ")[1] for fault in found] == ["kitsune.max_a", "up.quota", "switches[0].name"]


def test_what_a_part_says_of_its_values_is_said_before_it_starts(tmp_path):
    (fault,) = faults(tmp_path, '[firewall]\nrules.allow = [\n "10.0.0.0/24",\n "nonsense"]')
    assert fault.startswith("FILE:2: firewall.rules.allow: allow-list entry 'nonsense'")


def test_broken_toml_is_told_with_its_line(tmp_path):
    (fault,) = faults(tmp_path, "[kitsune]\nthreshold = = 1")
    assert fault.startswith("FILE:2: this is not TOML")


def test_variables_go_before_the_file(tmp_path):
    path = tmp_path / "sdnator.toml"
    path.write_text("[kitsune]\nthreshold = 1.5\nmax_ae = 7")
    given = load(
        path,
        {
            "SDNATOR_KITSUNE_THRESHOLD": "2.5",
            "SDNATOR_FIREWALL_RULES_DRY_RUN": "true",
            "SDNATOR_FIREWALL_RULES_ALLOW": "10.0.0.1, 10.0.0.2",
            "SDNATOR_UP_UPDATES": "redis://somewhere",
            "SDNATOR_COORDINATOR": "http://another.use.of.the.name",
        },
    )
    assert given.struct("kitsune").threshold == 2.5
    assert given.struct("kitsune").max_ae == 7
    assert given.struct("firewall").rules.dry_run is True
    assert given.struct("firewall").rules.allow == ("10.0.0.1", "10.0.0.2")
    assert given.struct("up").updates == "redis://somewhere"


def test_wrong_variables_are_named(tmp_path):
    assert faults(tmp_path, "", {"SDNATOR_KITSUNE_THRESOLD": "1"}) == [
        "$SDNATOR_KITSUNE_THRESOLD: there is no such option; did you mean SDNATOR_KITSUNE_THRESHOLD?"
    ]
    (fault,) = faults(tmp_path, "", {"SDNATOR_KITSUNE_THRESHOLD": "high"})
    assert fault == '$SDNATOR_KITSUNE_THRESHOLD: kitsune.threshold: "high": give a number'


def test_a_variable_with_too_many_digits_is_named(tmp_path):
    (fault,) = faults(tmp_path, "", {"SDNATOR_KITSUNE_THRESHOLD": "9" * 5_000})
    assert fault.startswith("$SDNATOR_KITSUNE_THRESHOLD: kitsune.threshold: ")
    assert len(fault) < 300


def test_nothing_given_costs_nothing_and_means_the_defaults():
    given = load(None, {})
    assert given.given == {}
    assert [each.kind for each in given.switches()] == ["embedded"]
    assert given.section("firewall") == {"allow_surroundings": True}


def test_every_option_has_a_text():
    """Where it is declared, and nowhere else."""
    bare = [f"{name}.{option}" for name, one in sections().items() for option in fields(name)
            if not texts(one.kind()).get(option) and not hasattr(fields(name)[option].type, "__struct_fields__")]  # fmt: skip
    assert [path for path in bare if not path.startswith("p4runtime_ctrl.")] == []


def test_every_option_has_a_variable_of_its_own():
    names = [variable(path) for path, _ in option_paths()]
    assert len(names) == len(set(names))


def test_the_example_says_nothing_but_the_defaults(tmp_path):
    """As printed, and with every option taken in."""
    lines = list(example_lines())
    path = tmp_path / "sdnator.toml"
    path.write_text("\n".join(lines))
    assert load(path, {}).struct("kitsune") == load(None, {}).struct("kitsune")
    options = [
        line[2:] if " = " in line and line.startswith("# ") and line[2:].split(" ")[1] == "=" else line
        for line in lines
    ]
    path.write_text("\n".join(options).replace("# [[", "[["))
    given = load(path, {})
    assert len(given.given["firewall"]) > 5
    for name in sections():
        if name not in LISTS:
            assert given.struct(name) == load(None, {}).struct(name)


def test_lines_of_statements_that_go_over_several_lines():
    text = '# c\na = 1\n[b]\nc = [\n  1,\n]\nd.e = """x\n[no]\n"""\n[[f]]\ng = {h = 1}\n[[f]]\ng = 2\n'
    found = lines_of(text)
    assert tomllib.loads(text)["f"][1] == {"g": 2}
    assert found[("a",)] == 2
    assert found[("b", "c")] == 4
    assert found[("b", "d", "e")] == 7
    assert found[("f", 0, "g", "h")] == 11
    assert found[("f", 1, "g")] == 13


def test_check_as_a_command(tmp_path):
    path = tmp_path / "sdnator.toml"
    path.write_text("[kitsune]\nthreshold = 2.0\n")
    done = run("check", str(path))
    assert (done.exit_code, done.stdout) == (0, f"{path}: nothing is wrong\n")
    path.write_text("[kitsune]\nthreshold = 0\nx = 1\n")
    assert run("check", str(path)).exit_code == 2
    found = json.loads(run("check", str(path), "--json").stdout)
    assert (found["well"], found["faults"][0]["place"]) == (False, f"{path}:3")
    assert run("check", str(tmp_path / "none.toml")).exit_code != 0


def test_show_tells_values_and_where_they_come_from(tmp_path):
    path = tmp_path / "sdnator.toml"
    path.write_text('[up]\nupdates = "redis://:secret@there"\n')
    done = run("show", str(path), "--json", SDNATOR_KITSUNE_THRESHOLD="3.5")
    found = json.loads(done.stdout)
    assert found["up.updates"] == {"value": "redis://…@there", "source": f"{path}:2"}
    assert found["kitsune.threshold"] == {"value": 3.5, "source": "$SDNATOR_KITSUNE_THRESHOLD"}
    assert found["switches[0].name"] == {"value": "s1", "source": ""}
    assert "kitsune.threshold = 1.0" in run("show", str(path)).stdout


def test_the_file_here_goes_before_that_of_the_user(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    assert config_file.find() is None
    users = tmp_path / "config" / "sdnator" / "sdnator.toml"
    users.parent.mkdir(parents=True)
    users.write_text("")
    assert config_file.find() == users
    (tmp_path / "sdnator.toml").write_text("")
    assert config_file.find() == tmp_path / "sdnator.toml"
