"""`sdnator blocks` and `sdnator allow` against a running firewall, and `panic` without one."""

import json
import time

import pytest
from typer.testing import CliRunner

from apps.messages import Confirmation, Exhibit
from due import Item
from due.backends import open_archive
from due.drivers.embedded_redis import EmbeddedServer
from sdnator.blocks.blocks_archive import lift_in_archive
from sdnator.cli import blocks_commands
from sdnator.cli.blocks_commands import allow, blocks
from sdnator.errors import BadInput, PipelineError, SdnatorError
from sdnator.supervisor import Child
from sdnator.testing.waiting import wait_for
from tests.apps.firewall.enforcement.test_eve import decision


@pytest.fixture
def firewall(tmp_path):
    """URLs of a running firewall's backends."""
    eve = tmp_path / "eve.json"
    settings = tmp_path / "firewall.json"
    settings.write_text(json.dumps({"eve_file": str(eve), "rules": {"allow": ["10.0.0.1"]}}))
    archive = f"sqlite:///{tmp_path / 'archive.db'}"
    with EmbeddedServer(tmp_path / "updates") as server:
        arguments = ("--updates", server.url, "--archive", archive, "--settings", str(settings))
        child = Child("firewall", ["apps.firewall.service", *arguments], tmp_path)
        try:
            child.wait_ready()
            yield ["--updates", server.url, "--archive", archive], ["--archive", archive], eve
        finally:
            child.stop()


def run(group, *arguments: str) -> str:
    done = CliRunner().invoke(group, arguments)
    if done.exception is not None:
        raise done.exception
    return done.stdout


def listed(text: str, archive: list[str]) -> str:
    """`blocks list`, as soon as the archive has it: the firewall answers before the archive is written."""
    for _ in range(3000):
        shown = run(blocks, "list", *archive)
        if text in shown:
            return shown
        time.sleep(0.02)
    raise AssertionError(shown)


def test_life_of_a_block_by_hand(firewall):
    """Add, list, explain, refuse what is allowed, lift by an allow-list entry, panic."""
    both, archive, eve = firewall
    answer = run(blocks, "add", "192.0.2.66", "--reason", "ticket 4711", *both)
    assert "of 192.0.2.66 for 600 s" in answer
    assert "192.0.2.66" in listed("ticket 4711", archive)
    (shown,) = json.loads(run(blocks, "list", "--json", *archive))
    why = run(blocks, "why", shown["id"], *archive)
    assert "network.instruction.operator.firewall: block 192.0.2.66: ticket 4711" in why
    assert "blocked before: never" in why
    life = json.loads(run(blocks, "why", shown["id"], "--json", *archive))
    assert [step["action"] for step in life["steps"]] == ["block"]
    assert life["evidence"][0]["reason_given"] == "ticket 4711"
    assert "elements = { 192.0.2.66 }" in run(blocks, "list", "--nft", *archive)
    with pytest.raises(BadInput, match="allow-list"):
        run(blocks, "add", "10.0.0.1", *both)
    assert "1 block lifted" in run(allow, "add", "192.0.2.0/24", *both)
    listed("nothing is blocked", archive)
    wait_for(lambda: run(allow, "list", *archive) == "192.0.2.0/24\n")  # archived by a thread of its own
    run(blocks, "add", "198.51.100.1", *both)
    run(blocks, "add", "203.0.113.77/24", *both)
    assert "203.0.113.0/24" in listed("203.0.113.0/24", archive)
    assert "2 lifted" in run(blocks, "panic", *both)
    listed("nothing is blocked", archive)
    categories = ["block", "unblock", "block", "block", "unblock", "unblock"]
    for _ in range(3000):  # lines are written by a thread of their own
        events = [json.loads(line)["alert"]["category"] for line in eve.read_text().splitlines()]
        if len(events) == len(categories):
            break
        time.sleep(0.02)
    assert events == categories


def test_unknown_id_is_named(tmp_path):
    """And where ids are to be seen."""
    with pytest.raises(BadInput, match=r"no decision has the id abc.*--all"):
        run(blocks, "why", "abc", "--archive", empty_archive(tmp_path))


def empty_archive(folder) -> str:
    """URL of an archive with nothing about blocks in it."""
    url = f"sqlite:///{folder / 'archive.db'}"
    driver = open_archive(url)
    driver.insert([Item("network.counts.a", 1, 1, 1, "a", "i", 1)])
    driver.close()
    return url


def test_empty_archive_has_nothing_to_lift(tmp_path):
    """Panic without a firewall is no error."""
    assert lift_in_archive(empty_archive(tmp_path)) == []


@pytest.mark.parametrize(
    "words", [["list"], ["why", "abc"], ["panic", "--direct", "--switch", "127.0.0.1:1"]]
)
def test_an_archive_that_is_not_there_is_an_error(tmp_path, words, capfd):
    """A slip in the path does not mean that nothing is blocked, and makes no file."""
    url = f"sqlite:///{tmp_path / 'typo.db'}"
    with pytest.raises(SdnatorError) as caught:
        run(blocks, *words, "--archive", url)
    assert "no such archive" in str(caught.value) + capfd.readouterr().err or words[0] == "panic"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("group", "words"),
    [(allow, ["add", "10.0.0.300"]), (blocks, ["add", "nobody"]), (allow, ["add", "10.0.0.1"])],
)
def test_what_cannot_be_done_is_said_at_once_and_leaves_nothing(monkeypatch, tmp_path, group, words):
    """A wrong address, or no pipeline: no request stays behind that the next start would carry out."""
    for variable in ("XDG_DATA_HOME", "XDG_STATE_HOME"):
        monkeypatch.setenv(variable, str(tmp_path))
    for variable in ("DUE_UPDATES", "DUE_ARCHIVE"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SdnatorError, match=r"not an IP address|no pipeline is running|10\.0\.0\.300"):
        run(group, *words)
    assert list(tmp_path.iterdir()) == []


def test_a_request_that_nobody_answered_is_not_carried_out_later(tmp_path):
    """The command fails without a firewall; the firewall that starts afterwards refuses what is too old."""
    archive = f"sqlite:///{tmp_path / 'archive.db'}"
    with EmbeddedServer(tmp_path / "updates") as server:
        both = ["--updates", server.url, "--archive", archive]
        with pytest.raises(PipelineError, match="the instruction is withdrawn"):
            blocks_commands._instruct("allow", "192.0.2.0/24", "", server.url, archive, patience=4)
        arguments = ("--updates", server.url, "--archive", archive)
        child = Child("firewall", ["apps.firewall.service", *arguments], tmp_path)
        try:
            child.wait_ready()
            assert "of 192.0.2.66 for 600 s" in run(blocks, "add", "192.0.2.66", *both)
            assert (
                run(allow, "list", "--archive", archive)
                == "the allow-list has no entries added by operators\n"
            )
        finally:
            child.stop()


def test_why_tells_what_switches_did(tmp_path):
    """Confirmations, drop counters, earlier offences and events, in the order of time."""
    url = f"sqlite://{tmp_path / 'archive.db'}"
    evidence = Exhibit(key="network.anomaly.kitsune.alert", timestamp=5, summary="hot")
    before = decision(id="d0", event_time=1)
    made = decision(evidence=(evidence,))
    said = Confirmation(
        id="d1", switch="s1", state="installed", action="block", handle="ingress.x[]", event_time=1
    )
    state = {"switch": "s1", "blocks": [{"id": "d1", "packets": 1234, "bytes": 5}, {"id": "x", "packets": 1}]}
    notice = {"kind": "resets", "text": "d1: half-open connections", "event_time": 1}
    values = [
        ("network.block.firewall.ipv4", before.to_value()),
        ("network.block.firewall.ipv4", made.to_value()),
        ("network.confirmation.p4runtime_ctrl.s1", said.to_value()),
        ("network.switch.p4runtime_ctrl.s1", state),
        ("network.event.firewall.resets", notice),
        ("network.block.firewall.ipv4", decision(action="unblock", reason="over").to_value()),
    ]
    driver = open_archive(url)
    driver.insert([Item(key, value, n, n, "a", "i", n) for n, (key, value) in enumerate(values, 10)])
    driver.close()
    five, life = run(blocks, "why", "d1", "--archive", url).split("\n\n")
    assert [line.partition(":")[0] for line in five.splitlines()] == [
        *("sum", "largest contributions", "remedy", "until", "undo")
    ]
    assert "hot" in five
    assert "nothing to undo" in five
    lines = life.splitlines()
    words = [
        "d1 block 192.0.2.1",
        "switch s1: installed",
        "half-open",
        "d1 unblock",
        "before: 1 time",
        "evidence:",
    ]
    words += ["hot (not kept in the archive)", "stopped by s1: 1,234 packets"]
    assert [word in line for word, line in zip(words, lines, strict=True)] == [True] * len(words)


def test_archive_of_a_machine_where_nothing_ran(monkeypatch, tmp_path):
    """Nothing is blocked, and no file is made."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.delenv("DUE_ARCHIVE", raising=False)
    assert run(blocks, "list") == "nothing is blocked, guarded or limited\n"
    assert list(tmp_path.iterdir()) == []
