"""The harness for hostile inputs finds what is planted, and the product's decoders are clean."""

import io
import random
import threading

import pytest

from apps.enforcers import arrivals as enforcers
from apps.firewall import arrivals as firewall
from apps.kitsune import service as kitsune
from apps.p4runtime_ctrl import arrivals as controller
from apps.sonata_adapter import arrivals as adapter
from benchmarks import hostile, hostile_messages
from benchmarks.hostile import attack_all
from benchmarks.hostile_child import Attacker, SharedProgress
from benchmarks.hostile_job import Figures, Job
from benchmarks.hostile_mutation import message_fields, mutate_protobuf
from benchmarks.hostile_pool import Attack, shares
from benchmarks.hostile_worker import targets_of
from tests.benchmarks import planted

PLANTED = planted.__name__
INPUTS = 150
SLOW_INPUTS = 6
SLOW = {"bmv2 json", "p4info", "controller p4info", "kitsune model", "sdnator.toml", "settings in variables"}
"""Milliseconds an input."""
SANITIZED = "benchmarks.hostile_native"


def attack(name, inputs=60):
    return attack_all({PLANTED: [name]}, inputs=inputs, seconds=60, workers=1, attack=Attack(1, 1.0))


def test_a_sound_decoder_is_clean():
    found = attack("sound")
    assert (found["crashes"], found["hangs"], found["findings"]) == (0, 0, [])
    assert found["inputs"] >= 60
    assert set(found["targets"]["sound"]) == {
        *(
            "inputs",
            "guided",
            "crashes",
            "hangs",
            "rss_first_mb",
            "rss_last_mb",
            "peak_mb",
            "inputs_per_s",
            "cpu_s",
        ),
    }
    assert isinstance(found["cpu_s"], float)
    assert found["grown"] == []


def test_memory_that_grows_is_found():
    """A target that keeps what it is given is told apart from one that makes something once."""
    assert attack("hoard", 400)["grown"] == ["hoard"]


def test_inputs_of_a_corpus_are_mutated_too(monkeypatch):
    """What the guided loop has found is a seed for the other one; damaged ones must not end it."""
    job = Job("sound", 0, 200, corpus=(b'{"found": 1}'.hex(), b"\xff{".hex()))
    seen: list[bytes] = []
    monkeypatch.setattr(
        threading, "excepthook", threading.excepthook
    )  # it takes that, in a process of its own
    target = planted.TARGETS[0]._replace(decode=seen.append)
    place = SharedProgress()
    Attacker(target, job, place, io.BytesIO()).run()
    place.close()
    assert len(seen) == 200
    assert any(b"found" in one for one in seen)


def test_every_decoder_of_messages_is_attacked():
    """Whoever adds one adds a target."""
    attacked = {target.name for target in hostile_messages.TARGETS}
    for app, module in (
        ("firewall", firewall),
        ("kitsune", kitsune),
        ("controller", controller),
        ("sonata", adapter),
        ("enforcers", enforcers),
    ):
        for name in vars(module):
            if (
                name.endswith("_in")
                and not name.startswith("_")
                and module.__name__ == getattr(module, name).__module__
            ):
                short = f"{app} {name.removesuffix('_in')} "
                assert any(each.startswith(short) for each in attacked), (
                    f"no target for {module.__name__}.{name}"
                )


def test_a_wrong_exception_is_found_with_its_input():
    """The input alone shows it again."""
    found = attack("wrong exception")
    assert found["crashes"] > 0
    assert found["hangs"] == 0
    one = next(each for each in found["findings"] if each["kind"] == "exception")
    assert "planted.py" in one["traceback"]
    target = next(each for each in planted.TARGETS if each.name == "wrong exception")
    with pytest.raises((KeyError, TypeError)):
        target.attack(bytes.fromhex(one["input"]))


def test_a_death_of_the_process_is_found_and_the_rest_goes_on():
    found = attack("death", 60)
    assert found["crashes"] > 0
    assert any("SIGSEGV" in each["error"] for each in found["findings"])
    assert found["inputs"] >= 60


def test_a_hang_is_found_and_the_rest_goes_on():
    found = attack("hang", 70)
    assert found["hangs"] > 0
    assert found["crashes"] == 0
    assert found["inputs"] >= 60
    assert all(bytes.fromhex(each["input"]).endswith(b"\xff") for each in found["findings"])


def test_exit_code_and_file(tmp_path, monkeypatch, capsys):
    """1 where something is found; the file says where."""
    monkeypatch.setattr(hostile, "MODULES", (PLANTED,))
    path = tmp_path / "figures.json"
    words = ["--json", str(path), "--inputs", "40", "--seconds", "60", "--workers", "1"]
    monkeypatch.setattr(hostile, "chosen", lambda only: {PLANTED: list(only)})
    assert hostile.main([*words, "--only", "wrong exception"]) == 1
    assert '"crashes"' in path.read_text()
    assert hostile.main([*words, "--only", "sound"]) == 0
    assert "0 crashes" in capsys.readouterr().out


def test_a_target_that_there_is_not_is_said():
    with pytest.raises(SystemExit, match="there are sound"):
        hostile.chosen(["nothing"], (PLANTED,))


def test_fast_targets_get_more_inputs_the_less_time_there_is():
    results = {"fast": Figures(inputs=100, seconds=0.1), "slow": Figures(inputs=100, seconds=10.0)}
    plenty = shares(results, 10_000, 10_000.0)
    little = shares(results, 10_000, 50.0)
    assert plenty["fast"] >= plenty["slow"] > little["slow"] > 0
    assert little["fast"] / 1000 + little["slow"] / 10 <= 50
    assert shares(results, 150, 100.0) == {}


def test_the_same_seed_makes_the_same_inputs():
    for module in hostile.MODULES:
        for target in targets_of(module) if module != SANITIZED else ():
            if target.name not in SLOW:
                made = [[target.input(seed, index) for index in range(60, 66)] for seed in (1, 1, 2)]
                assert made[0] == made[1] != made[2]


def test_mutated_messages_are_mostly_messages():
    """Else nothing behind the parser would be reached."""
    seed = bytes.fromhex("0a03616263120408011002")
    made = [mutate_protobuf(random.Random(n), (seed,)) for n in range(200)]
    assert sum(bool(message_fields(one)) for one in made) > 100


@pytest.mark.parametrize("module", [module for module in hostile.MODULES if module != SANITIZED])
def test_the_products_decoders_are_clean(module):
    """Genuine inputs and mutated ones: a value, or the declared error."""
    for target in targets_of(module):
        for index in range(SLOW_INPUTS if target.name in SLOW else INPUTS):
            data = target.input(7, index)
            try:
                target.attack(data)
            except Exception as error:
                raise AssertionError(f"{target.name}: {data[:500].hex()}") from error
