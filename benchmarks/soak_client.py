"""What a soak run has beside packets: a reader of scores and of a query, and an operator who blocks now and then."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

from apps.messages import Decision, Instruction
from due import CONSUMER, PRODUCER, Capability, DueError, Engine, Item, Options
from sdnator.blocks.blocks_archive import INSTRUCTION

_SCORES = "network.anomaly.kitsune.score"
_QUERY = "network.traffic_query.sonata.new_tcp:threshold=5,window=3s"
_DECISIONS = "network.block.firewall.*"
_ANSWERS = "network.answer.firewall.soak_operator"
_INSTRUCTION = INSTRUCTION.replace(".operator.", ".soak_operator.")
_EVERY_S = 10.0
_HASTY_S = 0.3
_STANDING = 12
"""Blocks at a time: each ends as so many others have begun."""
_ADDRESSES = 60_000


class SoakClient:
    """An app that observes what a page and a SIEM would, and gives an instruction every ten seconds, or more often.

    Args:
        folder: of its spool.
        updates: Data Updates.
        archive: Data Archives.
    """

    def __init__(self, folder: Path, updates: str, archive: str) -> None:
        self.scores = self.results = self.asked = self.answered = self.refused = self.decisions = 0
        self.errors: list[str] = []
        self.every_s = _EVERY_S
        """Seconds between two instructions."""
        self._blocked: dict[str, None] = {}
        self._ended = threading.Event()
        self._engine = Engine(Options(directory=str(folder), updates=updates, archive=archive))
        self._engine.init(
            "soak_operator",
            PRODUCER | CONSUMER,
            capabilities=[Capability(_INSTRUCTION, delivery="reliable", archive="always")],
        )
        self._thread = threading.Thread(target=self._instruct, daemon=True)

    def start(self) -> None:
        """Observe, then instruct."""
        for key, callback in (
            (_SCORES, self._on_scores),
            (_QUERY, self._on_result),
            (_DECISIONS, self._on_decision),
            (_ANSWERS, self._on_answer),
        ):
            self._engine.observe(key).subscribe(callback)
        self._thread.start()

    def close(self) -> None:
        """No more instructions."""
        self._ended.set()
        self._thread.join()
        self._engine.close()

    @contextmanager
    def hasty(self) -> Iterator[None]:
        """Many instructions meanwhile: what apps remember of the last thousand would take hours to fill."""
        self.every_s = _HASTY_S
        try:
            yield
        finally:
            self.every_s = _EVERY_S

    def blocked(self) -> list[str]:
        """Addresses and MACs that decisions say are blocked."""
        return list(self._blocked)

    def _instruct(self) -> None:
        while not self._ended.wait(self.every_s):
            # benchmark addresses of RFC 2544: nobody in the traffic has one
            number = self.asked % _ADDRESSES
            said = Instruction(
                id=uuid4().hex[:12],
                verb="block",
                subject=f"198.18.{number // 250}.{1 + number % 250}",
                seconds=round(_STANDING * self.every_s),
            )
            try:
                self._engine.write(_INSTRUCTION, said.to_value())
                self._engine.flush(60)
                self.asked += 1
            except DueError as error:
                self.errors.append(f"{time.strftime('%H:%M:%S')} {type(error).__name__}: {error}")

    def _on_scores(self, item: Item) -> None:
        self.scores += len(item.value["score"]) if "score" in item.value else 1

    def _on_result(self, _: Item) -> None:
        self.results += 1

    def _on_decision(self, item: Item) -> None:
        decision = Decision.from_value(item.value)
        self.decisions += 1
        if decision.action == "block":
            self._blocked[decision.target.address] = None
        else:
            self._blocked.pop(decision.target.address, None)

    def _on_answer(self, item: Item) -> None:
        self.answered += 1
        self.refused += not item.value["done"]
