"""Whatever goes wrong while an instruction is carried out is answered, and ends neither the service nor its next start."""

import time
from typing import Any

from apps.messages import Instruction
from due import Item
from due.errors import UnsupportedValue
from tests.apps.firewall.desk import Desk, FakeEngine

INSTRUCTION = "network.instruction.operator.firewall"
INSTRUCTIONS = "network.instruction.*.firewall"
ANSWER = "network.answer.firewall.operator"


class RefusingEngine(FakeEngine):
    """Cannot encode values of some keys."""

    def __init__(self, refused: str) -> None:
        super().__init__()
        self.refused = refused

    def write(self, key: str, value: Any, *_: object, **__: object) -> bool:
        if key.startswith(self.refused):
            raise UnsupportedValue("cannot be encoded")
        return super().write(key, value)


def test_an_instruction_that_cannot_be_carried_out_is_answered_and_leaves_no_block():
    """And later ones are carried out."""
    engine = RefusingEngine("network.block.")
    desk = Desk(engine=engine)
    for name in ("a", "b"):
        said = Instruction(id=name, verb="block", subject="192.0.2.66")
        desk.hand(INSTRUCTION, said.to_value(), pattern=INSTRUCTIONS)
        engine.refused = "none"
    first, second = desk.written(ANSWER)
    assert (first["done"], first["text"]) == (False, "failed: cannot be encoded")
    assert second["done"]
    assert (desk.blocked, desk.service.health()["blocks"]) == (["192.0.2.66"], 1)


def test_of_lifts_that_cannot_all_be_published_the_others_are():
    """Enforcers would go on with all of them, and nobody would know of them any more."""
    engine = RefusingEngine("none")
    desk = Desk(engine=engine)
    for number, address in enumerate(("192.0.2.66", "2001:db8::66", "192.0.2.67")):
        said = Instruction(id=f"b{number}", verb="block", subject=address)
        desk.hand(INSTRUCTION, said.to_value(), pattern=INSTRUCTIONS)
    engine.refused = "network.block.firewall.ipv6"
    panic = Instruction(id="p", verb="panic").to_value()
    desk.hand(INSTRUCTION, panic, pattern=INSTRUCTIONS)
    lifts = [each for each in desk.written("network.block.firewall.ipv4") if each["action"] == "unblock"]
    assert [each["target"]["address"] for each in lifts] == ["192.0.2.66", "192.0.2.67"]
    assert not desk.written(ANSWER)[-1]["done"]


def test_an_unanswered_instruction_cannot_end_the_start():
    """Each start would find it again."""
    engine, now = RefusingEngine(ANSWER), time.time_ns()
    said = Instruction(id="a", verb="unblock", subject="192.0.2.66").to_value()
    engine.archived.append(Item(INSTRUCTION, said, now, now, "operator", "cli", 1))
    desk = Desk(engine=engine)
    desk.service.tick()
    engine.refused = "none"
    desk.hand(INSTRUCTION, said | {"id": "b"}, pattern=INSTRUCTIONS)
    assert [each["id"] for each in desk.written(ANSWER)] == ["b"]
